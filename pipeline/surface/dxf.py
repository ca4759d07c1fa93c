"""A DXF drawing as it comes: the faces of one layer as a surface and the lines of another as an alignment.

A drawing is pairs of lines, a group code and a value. We read the pairs ourselves, in one pass, and keep the entities
of two layers: ezdxf builds every object of a drawing, which takes 2.6 s for 30,000 faces, 5.1 s where it also mends,
against 0.55 s here, and a hostile file can make it build far more. ezdxf writes the drawings that the tests read.
Nothing that a drawing names is opened: no reference, no picture, no block of another file.

Easting is x and northing is y of the drawing's world. What stands in blocks is not read; a sentence says so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from pipeline.errors import SurfaceError
from pipeline.surface.dxf_entities import Entity
from pipeline.surface.dxf_faces import FACES, Faces
from pipeline.surface.dxf_lines import LINES, MAX_LINES, line_of
from pipeline.surface.landxml_alignments import XmlAlignment
from pipeline.surface.landxml_surfaces import TinSurface

MAX_BYTES = 200_000_000
MAX_TAGS = 4_000_000
"""Pairs of one entity; a mesh of 100,000 faces has one million."""
MAX_NAMES = 1000
UNITS = {2: "international_foot", 6: "m", 21: "us_survey_foot"}
_UNIT_WORDS = {
    1: "inches",
    3: "miles",
    4: "millimetres",
    5: "centimetres",
    7: "kilometres",
    10: "yards",
    14: "decimetres",
}
_OTHERS = {
    b"AutoCAD Binary DXF": "a binary DXF: save it as a text (ASCII) DXF",
    b"AC1": "a DWG: save it as a DXF",
}


@dataclass(frozen=True)
class Drawing:
    """What two layers of a drawing hold; coordinates in the unit of the file."""

    source: str
    unit_code: int
    """$INSUNITS: 0 says nothing."""
    surface: TinSurface
    """Named after its layer."""
    alignment: XmlAlignment | None
    """Named after its layer; None where no layer was asked for."""

    @property
    def unit(self) -> str | None:
        """m, international_foot, us_survey_foot; None where the drawing says nothing, or another unit."""
        return UNITS.get(self.unit_code)

    @property
    def unit_as_written(self) -> str:
        """In words, for messages."""
        name = self.unit or _UNIT_WORDS.get(self.unit_code, "another one")
        return f"{name} ($INSUNITS {self.unit_code})"


def read_dxf(path: Path, layer: str, alignment_layer: str | None, start_station: float = 0.0) -> Drawing:
    """The surface on a layer of a drawing, and the alignment on another.

    Raises
    ------
    SurfaceError
        No such file, no drawing as text, out of bounds, nothing usable on a layer, or lines that are no single line.
    """
    source = path.name
    heard = _Heard(source, layer, alignment_layer, Faces(layer, source))
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise SurfaceError(
                f"{source}: {size / 1e6:.0f} MB, at most {MAX_BYTES / 1e6:.0f} MB are read; "
                "cut the design down to the job"
            )
        with path.open("rb") as stream:
            _check_kind(stream, source)
            heard.listen(stream)
    except OSError as error:
        raise SurfaceError(f"{source}: cannot be read ({error.strerror}); is it beside site.toml?") from None
    if not heard.whole:
        raise SurfaceError(f"{source}: ends in the middle of a drawing; save it again")
    surface = heard.faces.surface(heard.told_of(layer))
    alignment = None
    if alignment_layer is not None:
        alignment = line_of(
            heard.lines, alignment_layer, source, heard.told_of(alignment_layer), start_station
        )
    return Drawing(source, heard.unit_code, surface, alignment)


def check_drawing_unit(drawing: Drawing, said: str | None, unit: str) -> None:
    """Raise SurfaceError unless the drawing is in the grid's unit.

    Parameters
    ----------
    drawing : Drawing
        What its header says counts, if it says anything.
    said : str, optional
        ``design.unit`` in site.toml; needed where the header says nothing.
    unit : str
        ``grid.unit``.
    """
    if said is not None and said != unit:
        raise SurfaceError(
            f"design.unit in site.toml is '{said}', but grid.unit is '{unit}'; save the drawing in the unit of the grid"
        )
    if drawing.unit_code == 0:
        if said is None:
            raise SurfaceError(
                f"{drawing.source}: does not say its unit ($INSUNITS is 0); if it is drawn in the unit of the grid, "
                f'write unit = "{unit}" under [design] in site.toml'
            )
    elif drawing.unit != unit:
        raise SurfaceError(
            f"{drawing.source}: its unit is {drawing.unit_as_written}, but grid.unit in site.toml is '{unit}'; save "
            "the drawing in the unit of the grid, with $INSUNITS set to it or to 0, or mend grid.unit"
        )


def _check_kind(stream: BinaryIO, source: str) -> None:
    head = stream.read(64)
    stream.seek(0)
    if not head.strip():
        raise SurfaceError(f"{source}: is empty; save the drawing again")
    for begin, kind in _OTHERS.items():
        if head.startswith(begin):
            raise SurfaceError(f"{source}: is {kind}")


def _tags(stream: BinaryIO, source: str) -> Iterator[tuple[int, bytes]]:
    """Group code and value of each pair of lines."""
    number = 1
    for line in stream:
        try:
            code = int(line)
        except ValueError:
            if not line.strip(b"\x1a\r\n\t "):
                return  # the mark with which old systems end a file
            found = line.strip()[:40].decode("ascii", "replace")
            raise SurfaceError(
                f"{source}:{number}: expected a group code of a DXF, found '{found}'; save the drawing as a text DXF"
            ) from None
        yield code, stream.readline().strip()
        number += 2


@dataclass
class _Heard:
    """What is kept of a drawing while it is read."""

    source: str
    layer: str
    alignment_layer: str | None
    faces: Faces
    unit_code: int = 0
    whole: bool = False
    lines: list[Entity] = field(default_factory=list)
    _kinds: dict[str, Counter[str]] = field(default_factory=dict)
    _in_blocks: set[str] = field(default_factory=set)
    _encoding: str = "cp1252"
    _version: bytes = b""
    _names: dict[bytes, str] = field(default_factory=dict)

    def listen(self, stream: BinaryIO) -> None:
        """Hear all sections that concern us."""
        tags = _tags(stream, self.source)
        section, variable = b"", b""
        for code, value in tags:
            if code == 0:
                if value == b"EOF":
                    return
                section = b""
                if value == b"SECTION":
                    code, section = next(tags, (2, b""))
                    if section == b"ENTITIES":
                        self._entities(tags)
                elif value == b"ENDSEC":
                    continue
                else:
                    section = b"other"
            elif section == b"HEADER":
                if code == 9:
                    variable = value
                else:
                    self._header(variable, value)
            elif code == 8 and section == b"other":
                # Outside of ENTITIES a layer is that of something in a block; only for a sentence.
                self._in_blocks.add(self._name(value))
                if len(self._in_blocks) > MAX_NAMES:
                    self._in_blocks.clear()

    def told_of(self, layer: str) -> str:
        """What stands on a layer, or on which layers something stands: for the sentence that nothing usable does."""
        kinds = self._kinds.get(layer.casefold())
        if kinds:
            listed = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(5))
            return f"it holds {listed}"
        if layer.casefold() in self._in_blocks:
            return "what it holds stands inside blocks: explode them"
        names = sorted(self._kinds)[:8]
        return (
            f"there are entities on {', '.join(repr(name) for name in names)}"
            if names
            else "it has no entities"
        )

    def _header(self, variable: bytes, value: bytes) -> None:
        if variable == b"$INSUNITS":
            try:
                self.unit_code = int(value)
            except ValueError:
                raise SurfaceError(
                    f"{self.source}: $INSUNITS is '{value[:20].decode('ascii', 'replace')}', no number; save the "
                    "drawing again"
                ) from None
        elif variable == b"$ACADVER":
            self._version = value
        elif variable == b"$DWGCODEPAGE":
            page = value.decode("ascii", "replace").lower().replace("ansi_", "cp")
            try:
                "".encode(page)
                self._encoding = page
            except LookupError:
                pass  # only names of layers depend on it

    def _name(self, raw: bytes) -> str:
        """A layer's name in lower case: drawings do not tell them apart by case."""
        name = self._names.get(raw)
        if name is None:
            encoding = "utf-8" if self._version >= b"AC1021" else self._encoding
            name = raw.decode(encoding, "replace").casefold()
            if len(self._names) > MAX_NAMES:
                self._names.clear()
            self._names[raw] = name
        return name

    def _entities(self, tags: Iterator[tuple[int, bytes]]) -> None:
        """Hear the section of entities to its end."""
        wanted = {kind.encode(): kind for kind in FACES | LINES}
        polyline: Entity | None = None
        polyline_layer = ""
        entity: Entity | None = None
        layer, paper = b"0", False
        kind = b""
        for code, value in tags:
            if code == 0:
                if kind == b"VERTEX":
                    if polyline is not None and entity is not None:
                        polyline.vertices.append(entity)
                        if len(polyline.vertices) > MAX_TAGS:
                            raise SurfaceError(f"{self.source}: a polyline of more than {MAX_TAGS} vertices")
                elif kind == b"POLYLINE" and not paper:
                    polyline, polyline_layer = entity, self._name(layer)
                elif kind and kind != b"SEQEND" and not paper:
                    self._take(kind, entity, self._name(layer))
                # A polyline is whole when its vertices, which follow it, are.
                if polyline is not None and value not in (b"VERTEX", b"SEQEND"):
                    self._take(b"POLYLINE", polyline, polyline_layer)
                    polyline = None
                if value == b"ENDSEC":
                    self.whole = True
                    return
                kind, layer, paper = value, b"0", False
                name = wanted.get(kind)
                entity = None
                if name is not None or (kind == b"VERTEX" and polyline is not None):
                    entity = Entity(name or "VERTEX")
            elif entity is not None:
                entity.tags.append((code, value))
                if code == 8:
                    layer = value
                elif code == 67:
                    paper = value == b"1"
                if len(entity.tags) > MAX_TAGS:
                    raise SurfaceError(f"{self.source}: a {entity.kind} of more than {MAX_TAGS} values")
            elif code == 8:
                layer = value

    def _take(self, kind: bytes, entity: Entity | None, layer: str) -> None:
        word = kind[:40].decode("ascii", "replace")
        if layer not in self._kinds and len(self._kinds) < MAX_NAMES:
            self._kinds[layer] = Counter()
        if layer in self._kinds and (word in self._kinds[layer] or len(self._kinds[layer]) < MAX_NAMES):
            self._kinds[layer][word] += 1
        if entity is None:
            return
        if layer == self.layer.casefold() and entity.kind in FACES:
            self.faces.add(entity)
        if (
            self.alignment_layer is not None
            and layer == self.alignment_layer.casefold()
            and entity.kind in LINES
        ):
            self.lines.append(entity)
            if len(self.lines) > MAX_LINES:
                raise SurfaceError(
                    f"{self.source}: layer '{layer}' has more than {MAX_LINES} lines; draw the alignment alone on "
                    "its layer"
                )
