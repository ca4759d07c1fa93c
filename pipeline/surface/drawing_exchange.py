"""DXF as it leaves: the as-built surface as faces, the alignment, stations and check shots, each on its own layers."""

from __future__ import annotations

import io
import re
import threading

import ezdxf
import numpy as np
from ezdxf.document import Drawing
from ezdxf.layouts import Modelspace

from pipeline.surface.alignment import Alignment
from pipeline.surface.hand_off import DECIMALS, HandOff, Marks

SURFACE = "AS_BUILT_SURFACE"
ALIGNMENT = "ALIGNMENT"
STATIONS, STATION_TEXT = "STATIONS", "STATION_TEXT"
CHECKS, CHECK_TEXT = "CHECK_SHOTS", "CHECK_TEXT"
# Layer -> colour of AutoCAD's index; no meaning hangs on a colour alone.
LAYERS = {SURFACE: 34, ALIGNMENT: 7, STATIONS: 5, STATION_TEXT: 5, CHECKS: 6, CHECK_TEXT: 6}
# $INSUNITS: 6 metres, 2 feet, 21 US survey feet; $MEASUREMENT: 1 metric, 0 not.
UNITS = {"m": (6, 1), "international_foot": (2, 0), "us_survey_foot": (21, 0)}
TEXT_M = 0.15
POINT_M = 0.10
MAX_TEXT = 255
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
_FIXED = threading.Lock()


def dxf_bytes(hand_off: HandOff) -> bytes:
    """The drawing, AutoCAD 2010 format; the same run gives the same bytes."""
    # The library stamps the hour and fresh GUIDs into every drawing unless it is told that bytes must repeat, and
    # it is told for all drawings of a process at once.
    with _FIXED:
        before = ezdxf.options.write_fixed_meta_data_for_testing
        ezdxf.options.write_fixed_meta_data_for_testing = True
        try:
            return _drawing(hand_off)
        finally:
            ezdxf.options.write_fixed_meta_data_for_testing = before


def _drawing(hand_off: HandOff) -> bytes:
    scale = hand_off.metres_per_unit
    insunits, measurement = UNITS[hand_off.unit]
    document = ezdxf.new("R2010", setup=False)
    document.header["$INSUNITS"] = insunits
    document.header["$MEASUREMENT"] = measurement
    document.header["$LASTSAVEDBY"] = "gradetrace"
    # Points are drawn as a circle with a cross, or nobody sees them.
    document.header["$PDMODE"], document.header["$PDSIZE"] = 34, _plain(POINT_M / scale)
    for layer, colour in LAYERS.items():
        document.layers.add(layer, color=colour)
    space = document.modelspace()
    _add_alignment(space, hand_off.alignment, scale)
    points = np.round(hand_off.surface.points / scale, DECIMALS)
    for corners in points[hand_off.surface.faces].tolist():
        space.add_3dface(corners, dxfattribs={"layer": SURFACE})
    _add_marks(space, hand_off.stations, STATIONS, STATION_TEXT, scale)
    _add_marks(space, hand_off.checks, CHECKS, CHECK_TEXT, scale)
    _look_at(document, space, hand_off, scale)
    # The library adds the classes of what is drawn in the order of a set, which is another in every process.
    for name in sorted(document.entitydb.dxf_types_in_use()):
        document.classes.add_class(name)
    text = io.StringIO()
    document.write(text)
    return document.encode(text.getvalue())


def _add_alignment(space: Modelspace, line: Alignment, scale: float) -> None:
    """One polyline; an arc is a bulge, the tangent of a quarter of its angle, positive to the left."""
    angle = np.zeros(len(line.turn))
    arc = line.turn != 0
    radius = np.linalg.norm((line.start - line.center)[arc], axis=1)
    angle[arc] = np.diff(line.station)[arc] / radius
    bulge = np.append(-line.turn * np.tan(angle / 4), 0.0)
    corners = np.round(np.concatenate([line.start, line.end[-1:]]) / scale, DECIMALS)
    space.add_lwpolyline(
        [(e, n, float(b)) for (e, n), b in zip(corners.tolist(), bulge)],
        format="xyb",
        dxfattribs={"layer": ALIGNMENT},
    )


def _add_marks(space: Modelspace, marks: Marks | None, layer: str, text_layer: str, scale: float) -> None:
    if marks is None:
        return
    for place, text in zip(np.round(marks.p_grid / scale, DECIMALS).tolist(), marks.text):
        space.add_point(place, dxfattribs={"layer": layer})
        space.add_text(
            _one_line(text), height=_plain(TEXT_M / scale), dxfattribs={"layer": text_layer, "insert": place}
        )


def _look_at(document: Drawing, space: Modelspace, hand_off: HandOff, scale: float) -> None:
    """A drawing in grid coordinates opens far from its zero, where nothing is, unless it says where to look."""
    parts = [hand_off.alignment.start, hand_off.alignment.end, hand_off.surface.points[:, :2]]
    places = np.concatenate(parts) / scale
    low, high = np.round(places.min(axis=0), DECIMALS), np.round(places.max(axis=0), DECIMALS)
    space.reset_extents((*low.tolist(), 0.0), (*high.tolist(), 0.0))
    document.set_modelspace_vport(
        _plain(1.1 * max(*(high - low), 1.0)), center=tuple((0.5 * (low + high)).tolist())
    )


def _plain(value: float) -> float:
    return round(float(value), DECIMALS)


def _one_line(text: str) -> str:
    """Text as DXF wants it: no control characters, and its two escapes, caret and doubled percent, taken literally."""
    line = _CONTROL.sub(" ", text)[:MAX_TEXT].replace("^", "^ ")
    return line.replace("%", "%%%") if "%%" in line else line
