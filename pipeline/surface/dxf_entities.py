"""One entity of a DXF drawing: its pairs of group code and value, and numbers out of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from pipeline.errors import SurfaceError


@dataclass(slots=True)
class Entity:
    """A 3DFACE, POLYLINE, LINE and so on, in the unit of its drawing."""

    kind: str
    tags: list[tuple[int, bytes]] = field(default_factory=list)
    """In the order of the file; codes may repeat."""
    vertices: list[Entity] = field(default_factory=list)
    """Of a POLYLINE."""

    def first(self, code: int, default: float, source: str) -> float:
        """The first value of a group code as a number."""
        for own, value in self.tags:
            if own == code:
                return number_of(value, self.kind, source)
        return default

    def whole(self, code: int, source: str) -> int:
        """The first value of a group code as a whole number, 0 where it is not given."""
        return int(self.first(code, 0.0, source))

    def point(self, code: int, source: str) -> tuple[float, float, float]:
        """The point whose x has a group code, y the code 10 above and z 20 above."""
        values = dict(self.tags)
        try:
            x, y = values[code], values[code + 10]
        except KeyError:
            raise SurfaceError(
                f"{source}: a {self.kind} without coordinates; save the drawing again"
            ) from None
        z = values.get(code + 20, b"0")
        return (
            number_of(x, self.kind, source),
            number_of(y, self.kind, source),
            number_of(z, self.kind, source),
        )

    def is_mirrored(self, source: str) -> bool:
        """Whether it is drawn as seen from below. Raises SurfaceError where it is drawn in a slanting plane."""
        axis = self.first(210, 0.0, source), self.first(220, 0.0, source), self.first(230, 1.0, source)
        if abs(axis[0]) > 1e-6 or abs(axis[1]) > 1e-6 or axis[2] == 0:
            raise SurfaceError(
                f"{source}: a {self.kind} is drawn in a slanting plane; draw it in plan, or as a 3D polyline"
            )
        return axis[2] < 0


def number_of(value: bytes, kind: str, source: str) -> float:
    """A finite number. Raises SurfaceError."""
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        found = value[:40].decode("ascii", "replace")
        raise SurfaceError(f"{source}: a {kind}: expected a number, found '{found}'; save the drawing again")
    return number
