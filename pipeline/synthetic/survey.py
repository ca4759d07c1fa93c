"""What a surveyor hands over: the design as CSV and LandXML, and total-station shots as PNEZD."""

from __future__ import annotations

import numpy as np

from pipeline.synthetic.excavator import Place
from pipeline.synthetic.files import METRES_PER_UNIT
from pipeline.synthetic.specification import Specification


def design_rows(spec: Specification) -> np.ndarray:
    """(n, 4) station, grid elevation, floor width, side slope; metres."""
    stations = np.array([row[0] for row in spec.trench.rows])
    heights = np.array([row[1] for row in spec.trench.rows]) + spec.origin[2] * METRES_PER_UNIT[spec.unit]
    width = np.full_like(stations, spec.arm.width_m)
    return np.stack([stations, heights, width, np.full_like(stations, spec.trench.side_slope)], axis=-1)


def design_csv(spec: Specification) -> str:
    """The design as a profile along the alignment, in the grid unit."""
    unit = METRES_PER_UNIT[spec.unit]
    lines = ["station,elevation,width,side_slope"]
    lines += [f"{s / unit:.4f},{h / unit:.5f},{w / unit:.5f},{k:g}" for s, h, w, k in design_rows(spec)]
    return "\n".join(lines) + "\n"


def design_xml(spec: Specification) -> str:
    """The same design as a LandXML 1.2 surface, floor and side slopes, with its alignment.

    Points are northing easting elevation, as LandXML wants them.
    """
    unit = METRES_PER_UNIT[spec.unit]
    place = Place(spec)
    origin = np.array(spec.origin)

    def grid(p_world: np.ndarray) -> np.ndarray:
        return origin + p_world / unit

    rows = design_rows(spec)
    rows[:, 1] -= spec.origin[2] * unit
    points, faces = [], []
    for station, z, width, slope in rows:
        half = 0.5 * width
        top = half + slope * (spec.ground - z)
        for offset, height in ((top, spec.ground), (half, z), (-half, z), (-top, spec.ground)):
            points.append(grid(place.point(station, offset, height)))
    for i in range(len(rows) - 1):
        for j in range(3):
            a, b, c, d = 4 * i + j + 1, 4 * i + j + 2, 4 * i + j + 5, 4 * i + j + 6
            faces += [(a, b, c), (b, d, c)]
    start, end = (grid(place.point(spec.start_station + d, 0.0, 0.0)) for d in (0.0, spec.length_m))
    length = spec.length_m / unit
    if spec.unit == "m":
        units = '<Metric linearUnit="meter" areaUnit="squareMeter" volumeUnit="cubicMeter" '
    else:
        foot = {"us_survey_foot": "USSurveyFoot", "international_foot": "foot"}[spec.unit]
        units = f'<Imperial linearUnit="{foot}" areaUnit="squareFoot" volumeUnit="cubicYard" '
    units += 'temperatureUnit="celsius" pressureUnit="HPA" '
    units += 'angularUnit="decimal degrees" directionUnit="decimal degrees"/>'
    if spec.unit != "m":
        units = units.replace("celsius", "fahrenheit").replace("HPA", "inHG")
    text = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2" date="2025-06-02" time="09:00:00">',
        f"  <Units>{units}</Units>",
        f'  <Project name="{spec.title}"/>',
        '  <Alignments name="">',
        f'    <Alignment name="centre line" length="{length:.5f}" staStart="{spec.start_station / unit:.5f}">',
        "      <CoordGeom>",
        f'        <Line length="{length:.5f}"><Start>{_ne(start)}</Start><End>{_ne(end)}</End></Line>',
        "      </CoordGeom>",
        "    </Alignment>",
        "  </Alignments>",
        "  <Surfaces>",
        '    <Surface name="trench" desc="floor and side slopes">',
        '      <Definition surfType="TIN">',
        "        <Pnts>",
        *[f'          <P id="{i}">{_ne(p)} {p[2]:.5f}</P>' for i, p in enumerate(points, 1)],
        "        </Pnts>",
        "        <Faces>",
        *[f"          <F>{a} {b} {c}</F>" for a, b, c in faces],
        "        </Faces>",
        "      </Definition>",
        "    </Surface>",
        "  </Surfaces>",
        "</LandXML>",
    ]
    return "\n".join(text) + "\n"


def check_shots(
    spec: Specification, shots_world: np.ndarray, notes: list[str], rng: np.random.Generator
) -> str:
    """Total-station shots as PNEZD (point, northing, easting, elevation, description), grid unit."""
    unit = METRES_PER_UNIT[spec.unit]
    shot = shots_world + rng.normal(size=shots_world.shape) * spec.sigmas.shot_mm / 1000
    enh = np.array(spec.origin) + shot / unit
    lines = [
        f"{100 + i:04d},{n:.4f},{e:.4f},{h:.4f},{note}"
        for i, ((e, n, h), note) in enumerate(zip(enh, notes), 1)
    ]
    return "\n".join(lines) + "\n"


def _ne(p: np.ndarray) -> str:
    return f"{p[1]:.5f} {p[0]:.5f}"
