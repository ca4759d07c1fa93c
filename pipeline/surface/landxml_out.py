"""LandXML 1.2 as it leaves: surface, alignment and long profile, in the unit of the grid.

Northing stands before easting, as LandXML wants it. `date` and `time`, which the standard demands, are those of the
end of the log and not of the writing, so that the same run gives the same bytes.
"""

from __future__ import annotations

import datetime
import io
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from xml.sax.saxutils import XMLGenerator
from xml.sax.xmlreader import AttributesImpl

import numpy as np

from pipeline.surface.alignment import Alignment
from pipeline.surface.hand_off import DECIMALS, HandOff, Mesh

NAMESPACE = "http://www.landxml.org/schema/LandXML-1.2"
# The words of LandXML; "foot" is the international foot there.
_UNITS = {
    "m": ("Metric", "meter", "squareMeter", "cubicMeter", "celsius", "HPA"),
    "international_foot": ("Imperial", "foot", "squareFoot", "cubicFeet", "fahrenheit", "inHG"),
    "us_survey_foot": ("Imperial", "USSurveyFoot", "squareFoot", "cubicFeet", "fahrenheit", "inHG"),
}
_UNIT_KEYS = ("linearUnit", "areaUnit", "volumeUnit", "temperatureUnit", "pressureUnit")
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML has no way to write; names come from files that others wrote."""


def landxml_bytes(hand_off: HandOff) -> bytes:
    """The file; what there is nothing of is left out."""
    out = _Writer()
    scale = hand_off.metres_per_unit
    recorded = datetime.datetime.fromtimestamp(hand_off.recorded_ns // 10**9, datetime.UTC)
    with out.element(
        "LandXML",
        xmlns=NAMESPACE,
        version="1.2",
        date=f"{recorded:%Y-%m-%d}",
        time=f"{recorded:%H:%M:%S}",
        language="English",
        readOnly="false",
    ):
        system, *words = _UNITS[hand_off.unit]
        with out.element("Units"):
            out.leaf(system, **dict(zip(_UNIT_KEYS, words)))
        out.leaf("Project", name=hand_off.project)
        out.leaf("Application", name="gradetrace", version=hand_off.version)
        with out.element("Alignments"):
            _write_alignment(out, hand_off.alignment, hand_off.profile, hand_off.surface_name, scale)
        if len(hand_off.surface.faces):
            with out.element("Surfaces"):
                _write_surface(out, hand_off.surface, hand_off.surface_name, scale)
    return out.bytes()


def _write_alignment(
    out: _Writer, line: Alignment, profile: Iterable[np.ndarray], surface_name: str, scale: float
) -> None:
    stations, lengths = line.station / scale, np.diff(line.station) / scale
    start, end, center = (points[:, ::-1] / scale for points in (line.start, line.end, line.center))
    name = line.name or "alignment"
    with out.element(
        "Alignment",
        name=name,
        length=_text(line.length / scale),
        staStart=_text(stations[0]),
        state="proposed",
    ):
        with out.element("CoordGeom"):
            for i, turn in enumerate(line.turn):
                told = {"length": _text(lengths[i]), "staStart": _text(stations[i])}
                if turn:
                    radius = float(np.hypot(*(start[i] - center[i])))
                    told |= {"rot": "cw" if turn > 0 else "ccw", "crvType": "arc", "radius": _text(radius)}
                with out.element("Curve" if turn else "Line", **told):
                    out.leaf("Start", _texts(start[i]))
                    if turn:
                        out.leaf("Center", _texts(center[i]))
                    out.leaf("End", _texts(end[i]))
        stretches = list(profile)
        if stretches:
            # A gap in a profile is the end of one list and the start of the next.
            with (
                out.element("Profile", name=name),
                out.element("ProfSurf", name=surface_name, state="existing"),
            ):
                for stretch in stretches:
                    out.leaf("PntList2D", _texts(stretch.ravel() / scale))


def _write_surface(out: _Writer, mesh: Mesh, name: str, scale: float) -> None:
    points = mesh.points / scale
    plan, slope = mesh.areas(scale)
    used = points[np.unique(mesh.faces), 2]
    with (
        out.element("Surface", name=name, state="existing"),
        out.element(
            "Definition",
            surfType="TIN",
            area2DSurf=_text(plan),
            area3DSurf=_text(slope),
            elevMin=_text(used.min()),
            elevMax=_text(used.max()),
        ),
    ):
        with out.element("Pnts"):
            for i, point in enumerate(points[:, [1, 0, 2]].tolist(), start=1):
                out.leaf("P", _texts(point), id=str(i))
        with out.element("Faces"):
            for face in (mesh.faces + 1).tolist():
                out.leaf("F", " ".join(map(str, face)))


def _text(value: float) -> str:
    """A number without an exponent and without idle zeros."""
    return f"{round(float(value), DECIMALS) + 0.0:.{DECIMALS}f}".rstrip("0").removesuffix(".")


def _texts(values: Iterable[float]) -> str:
    return " ".join(map(_text, values))


class _Writer:
    """Elements one after the other, each on its line, escaped."""

    def __init__(self) -> None:
        self._stream = io.BytesIO()
        self._xml = XMLGenerator(self._stream, encoding="utf-8", short_empty_elements=True)
        self._xml.startDocument()

    @contextmanager
    def element(self, tag: str, /, **attributes: str) -> Iterator[None]:
        """An element around others."""
        self._xml.startElement(tag, _legal(attributes))
        self._xml.ignorableWhitespace("\n")
        yield
        self._xml.endElement(tag)
        self._xml.ignorableWhitespace("\n")

    def leaf(self, tag: str, text: str = "", /, **attributes: str) -> None:
        """An element with text, or with nothing, in it."""
        self._xml.startElement(tag, _legal(attributes))
        if text:
            self._xml.characters(text)
        self._xml.endElement(tag)
        self._xml.ignorableWhitespace("\n")

    def bytes(self) -> bytes:
        """The document so far."""
        self._xml.endDocument()
        return self._stream.getvalue()


def _legal(attributes: dict[str, str]) -> AttributesImpl[str]:
    return AttributesImpl(
        {key: _NO_XML.sub("\N{REPLACEMENT CHARACTER}", value) for key, value in attributes.items()}
    )
