"""LandXML: what is read, what is skipped, what is refused."""

import time

import numpy as np
import pytest

from pipeline.errors import SurfaceError
from pipeline.surface import landxml, landxml_surfaces
from pipeline.surface.landxml import read_landxml

HEAD = '<?xml version="1.0"?>\n<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">'
METRES = '<Units><Metric linearUnit="meter" areaUnit="squareMeter"/></Units>'
SURFACE = """
<Surfaces><Surface name="trench"><Definition surfType="TIN" area2DSurf="0.5" elevMin="7.0" elevMax="9">
<Pnts><P id="a">100.0 5.0 7.0</P><P id="7">101.0 5.0 8.0</P><P id="NA">100.0 6.0 9.0</P><P id="x">99 4 9</P></Pnts>
<Faces><F>a 7 NA</F><F i="1">a 7 x</F><F n="0 0 1" i="0">7 NA x</F></Faces>
</Definition></Surface></Surfaces>"""
ALIGNMENT = """
<Alignments><Alignment name="CL" length="25.707963" staStart="100"><CoordGeom>
<Line><Start>0 0</Start><End>10 0</End></Line>
<Curve rot="cw"><Start>10 0</Start><Center>10 10</Center><End>20 10 0.0</End></Curve>
</CoordGeom><Profile><ProfAlign name="p"><PVI>0 1</PVI></ProfAlign></Profile></Alignment></Alignments>"""


def written(tmp_path, body, head=HEAD):
    path = tmp_path / "design.xml"
    path.write_text(head + body + "</LandXML>")
    return path


def refused(tmp_path, text, sentence):
    path = tmp_path / "design.xml"
    path.write_text(text)
    with pytest.raises(SurfaceError, match=sentence) as caught:
        read_landxml(path)
    assert "\n" not in str(caught.value)


def test_points_are_northing_easting_elevation_in_the_file(tmp_path):
    surface = read_landxml(written(tmp_path, METRES + SURFACE)).surface(None)
    assert surface.points[0].tolist() == [5, 100, 7]  # easting, northing, elevation


def test_invisible_faces_are_skipped_and_counted_and_ids_are_strings(tmp_path):
    surface = read_landxml(written(tmp_path, METRES + SURFACE)).surface("trench")
    assert surface.faces.tolist() == [[0, 1, 2], [1, 2, 3]]
    assert surface.invisible == 1
    assert surface.stated == {"area2DSurf": 0.5, "elevMin": 7.0, "elevMax": 9.0}


@pytest.mark.parametrize(
    "namespace",
    ["http://www.landxml.org/schema/LandXML-1.0", "http://www.landxml.org/schema/LandXML-2.0",
     "http://www.inframodel.fi/inframodel", None],
)  # fmt: skip
def test_the_namespace_does_not_matter(tmp_path, namespace):
    head = f'<LandXML xmlns="{namespace}">' if namespace else "<LandXML>"
    assert len(read_landxml(written(tmp_path, METRES + SURFACE, head)).surfaces) == 1


def test_an_alignment_is_lines_and_arcs_with_their_points(tmp_path):
    alignment = read_landxml(written(tmp_path, METRES + ALIGNMENT)).alignment("CL")
    line, curve = alignment.elements
    assert (line.kind, line.start, line.end, line.center) == ("Line", (0, 0), (0, 10), None)
    assert (curve.kind, curve.end, curve.center, curve.clockwise) == ("Curve", (10, 20), (10, 10), True)
    assert (alignment.start_station, alignment.stated_length) == (100, 25.707963)


@pytest.mark.parametrize(
    "units, unit",
    [
        ('<Metric linearUnit="meter"/>', "m"),
        ('<Imperial linearUnit="foot" elevationUnit="feet"/>', "international_foot"),
        ('<Imperial linearUnit="USSurveyFoot"/>', "us_survey_foot"),
        ('<Metric linearUnit="millimeter"/>', None),
    ],
)
def test_the_two_feet_are_told_apart(tmp_path, units, unit):
    assert read_landxml(written(tmp_path, f"<Units>{units}</Units>" + SURFACE)).unit == unit


def test_several_surfaces_must_be_named(tmp_path):
    two = METRES + SURFACE + SURFACE.replace("trench", "ground")
    read = read_landxml(written(tmp_path, two))
    assert read.surface("ground").name == "ground"
    with pytest.raises(
        SurfaceError, match=r"holds 2 surfaces \('trench', 'ground'\); say which with design.surface"
    ):
        read.surface(None)
    with pytest.raises(SurfaceError, match="has no surface 'pipe'; it holds 'trench', 'ground'"):
        read.surface("pipe")
    with pytest.raises(SurfaceError, match="holds no alignment"):
        read.alignment(None)


LAUGHS = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("", "is empty"),
        ("<LandXML><Units>", "not well-formed"),
        ("station,elevation\n1,2\n", "not well-formed"),
        ("<html></html>", "first element is 'html' and not LandXML"),
        (LAUGHS + "<LandXML>&b;</LandXML>", "document type or entities"),
        ('<!DOCTYPE x SYSTEM "file:///etc/passwd"><LandXML/>', "document type or entities"),
        ("<LandXML>" + "<a>" * 100 + "</a>" * 100 + "</LandXML>", "nested deeper than 64"),
        (HEAD + SURFACE.replace("100.0 5.0 7.0", "100.0 5.0") + "</LandXML>", "point a .*expected 3 numbers"),
        (HEAD + SURFACE.replace("100.0 5.0 7.0", "1 nan 3") + "</LandXML>", "expected 3 numbers"),
        (HEAD + SURFACE.replace("100.0 5.0 7.0", "9" * 20_000) + "</LandXML>", "more than 10000 characters"),
        (HEAD + SURFACE.replace("<F>a 7 NA", "<F>a 7 Q") + "</LandXML>", "names point 'Q', which it has not"),
        (HEAD + SURFACE.replace("<F>a 7 NA", "<F>a 7") + "</LandXML>", "has 2 corners, expected 3"),
        (HEAD + SURFACE.replace('id="7"', 'id="a"') + "</LandXML>", "two points with id a"),
        (HEAD + ALIGNMENT.replace("<End>10 0</End>", "") + "</LandXML>", "a Line .* no Start or no End"),
        (HEAD + '<Units><Metric linearUnit="meter" elevationUnit="feet"/></Units></LandXML>', "one unit"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_or_may_be_hostile_is_refused_in_one_sentence(tmp_path, text, sentence):
    refused(tmp_path, text, sentence)


def test_bounds_on_size_and_counts(tmp_path, monkeypatch):
    path = written(tmp_path, METRES + SURFACE)
    for module, bound, sentence in (
        (landxml_surfaces, "MAX_POINTS", "points"),
        (landxml_surfaces, "MAX_FACES", "faces"),
        (landxml, "MAX_BYTES", "are read"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, bound, 1)
            with pytest.raises(SurfaceError, match=sentence):
                read_landxml(path)


def test_a_hundred_thousand_faces_are_read_whole_and_quickly(tmp_path):
    side = 224
    n, e = np.divmod(np.arange(side * side), side)
    points = "".join(f'<P id="{i}">{a} {b} {a * b % 7}</P>' for i, (a, b) in enumerate(zip(n, e)))
    at = np.flatnonzero((n < side - 1) & (e < side - 1))
    faces = "".join(f"<F>{i} {i + 1} {i + side}</F><F>{i + 1} {i + side + 1} {i + side}</F>" for i in at)
    definition = f"<Definition><Pnts>{points}</Pnts><Faces>{faces}</Faces></Definition>"
    body = f'<Surfaces><Surface name="s">{definition}</Surface></Surfaces>'
    path = written(tmp_path, METRES + body)
    started = time.process_time()
    surface = read_landxml(path).surface(None)
    assert len(surface.faces) == 2 * 223**2
    assert time.process_time() - started < 3
    corners = surface.points[surface.faces][:, :, :2]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    assert np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2 == pytest.approx(223**2)
