"""What the parts of a LandXML file have in common: hearing elements, keeping bounded text, telling numbers."""

from __future__ import annotations

import math

from pipeline.errors import SurfaceError

MAX_TEXT = 10_000
"""Characters of one element that we read; a point has under a hundred."""
MAX_LIST_TEXT = 20_000_000
"""Of one list of points: half a million of them."""
MAX_RECORDS = 1_000_000
"""Alignments' elements, profiles' vertices, pipes and structures of one file; jobs have hundreds."""


class Section:
    """One part of the file; it hears the elements inside it, outermost first."""

    def __init__(self, source: str):
        self.source = source
        self._records = 0

    def start(self, name: str, attributes: dict[str, str], path: list[str]) -> int:
        """An element begins; `path` ends with it. Returns how many characters of its text are wanted, 0 for none."""
        raise NotImplementedError

    def end(self, name: str, text: str, path: list[str]) -> None:
        """An element ends; `path` no longer holds it. `text` is empty unless it was wanted."""
        raise NotImplementedError

    def numbers(self, text: str, least: int, where: str) -> list[float]:
        """All numbers of a text. Raises SurfaceError unless there are at least so many, and finite ones only."""
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) < least or not all(map(math.isfinite, numbers)):
            raise SurfaceError(
                f"{self.source}: {where}: expected {least} number{'s' if least > 1 else ''}, "
                f"found '{text.strip()[:60]}'"
            )
        return numbers

    def number(self, attributes: dict[str, str], key: str, where: str) -> float | None:
        """An attribute as a number, None where it is not given. Raises SurfaceError."""
        text = attributes.get(key)
        return None if text is None else self.numbers(text, 1, f"{key} of {where}")[0]

    def count(self, what: str) -> None:
        """One more record. Raises SurfaceError beyond `MAX_RECORDS`."""
        self._records += 1
        if self._records > MAX_RECORDS:
            raise SurfaceError(f"{self.source}: more than {MAX_RECORDS} {what}; cut the file down to the job")


Place = tuple[float, float] | str
"""Easting and northing, or the name of the point that has them."""


MAX_REFERENCES = 16
"""From point to point until one has coordinates; files have one."""


class PointSection(Section):
    """CgPoints: points with names, to which other parts refer."""

    def __init__(self, source: str):
        super().__init__(source)
        self._places: dict[str, Place] = {}
        self._twice: set[str] = set()
        self._attributes: dict[str, str] = {}

    def start(self, name: str, attributes: dict[str, str], path: list[str]) -> int:
        if name != "CgPoint":
            return 0
        self._attributes = attributes
        return MAX_TEXT

    def end(self, name: str, text: str, path: list[str]) -> None:
        if name != "CgPoint":
            return
        own = self._attributes.get("name", "")
        place = place_of(self, text, self._attributes, f"point '{own}'")
        if place is None or not own:
            return
        if self._places.setdefault(own, place) != place:
            self._twice.add(own)
        elif len(self._places) > MAX_RECORDS:
            raise SurfaceError(f"{self.source}: more than {MAX_RECORDS} points with names; cut the file down")

    def resolve(self, place: Place, where: str) -> tuple[float, float]:
        """Easting and northing of a place. Raises SurfaceError for a point that is not there, or there twice."""
        seen: set[str] = set()
        while isinstance(place, str):
            if place in self._twice:
                raise SurfaceError(
                    f"{self.source}: {where} refers to point '{place}', of which there are several; export the "
                    "coordinates themselves"
                )
            if place not in self._places or place in seen or len(seen) >= MAX_REFERENCES:
                raise SurfaceError(
                    f"{self.source}: {where} refers to point '{place}', which the file does not hold; export the "
                    "points with it"
                )
            seen.add(place)
            place = self._places[place]
        return place


def place_of(section: Section, text: str, attributes: dict[str, str], where: str) -> Place | None:
    """What an element for a point says: coordinates, or the name of a point; None where it says neither."""
    if text.strip():
        numbers = section.numbers(text, 2, where)
        return numbers[1], numbers[0]
    return attributes.get("pntRef") or None
