"""The design against closed forms; what is floor; what does not belong to the site."""

import re

import ezdxf
import numpy as np
import pytest

from pipeline.config import load_site
from pipeline.errors import SurfaceError
from pipeline.surface.alignment import polyline
from pipeline.surface.design import FLOOR_SLOPE, TinDesign, floor_sentence, read_design, read_profile

FOOT = 1200 / 3937
SITE = """
format = "gradetrace/site/1"
[site]
id = "s"
[grid]
unit = "{unit}"
origin = [{e}, {n}, {h}]
[benchmarks.a]
family = "tag36h11"
tags = [{{ id = 1, size_m = 0.5 }}]
pose = {{ enh = [{e}, {n}, {h}], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.1 }}
{alignment}
[design]
file = "{file}"
kind = "{kind}"
{more}
[tolerance]
high_mm = 25
low_mm = 25
"""


def site(file, kind, unit="m", e=512_000, n=4_123_000, h=50, points=None, start=0.0, more=""):
    points = points or [[e, n], [e, n + 20]]
    alignment = f"[alignment]\npoints = {points}\nstart_station = {start}" if points != "file" else ""
    return load_site(
        SITE.format(unit=unit, e=e, n=n, h=h, alignment=alignment, file=file, kind=kind, more=more),
        "site.toml",
    )


def profile(tmp_path, text):
    path = tmp_path / "design.csv"
    path.write_text(text)
    return path


def trapezoid(run=1.5, rise=2.0, half=0.5, length=20.0, gradient=0.01, ground=4.0):
    """A floor, two side slopes and the ground beside them: points (n, 3) along north from 0, 0; and faces."""
    offsets = [
        -half - run * rise - ground,
        -half - run * rise,
        -half,
        half,
        half + run * rise,
        half + run * rise + ground,
    ]
    levels = [rise, rise, 0, 0, rise, rise]
    points = np.array([[o, y, z + gradient * y] for y in (0.0, length) for o, z in zip(offsets, levels)])
    faces = [f for i in range(5) for f in ((i, i + 1, i + 6), (i + 1, i + 7, i + 6))]
    return points, np.array(faces)


def landxml(
    points, faces, alignment="", units='<Metric linearUnit="meter"/>', shift=(512_000, 4_123_000, 50)
):
    p = "".join(
        f'<P id="{i}">{y + shift[1]} {x + shift[0]} {z + shift[2]}</P>' for i, (x, y, z) in enumerate(points)
    )
    f = "".join(f"<F>{a} {b} {c}</F>" for a, b, c in faces)
    return (
        f'<LandXML><Units>{units}</Units>{alignment}<Surfaces><Surface name="t"><Definition>'
        f"<Pnts>{p}</Pnts><Faces>{f}</Faces></Definition></Surface></Surfaces></LandXML>"
    )


def test_a_profile_is_linear_between_its_rows(tmp_path):
    path = profile(tmp_path, "station,elevation,width,side_slope\n10,50,1.0,0.5\n20,49,2.0,0.5\n")
    design = read_profile(path, 1.0)
    assert design.elevation(15.0, 0.0) == pytest.approx(49.5)
    assert design.elevation(15.0, 0.75) == pytest.approx(49.5)  # floor of 1.5 m
    assert design.elevation(15.0, -1.25) == pytest.approx(49.5 + 0.5 / 0.5)  # half a run per rise
    assert np.isnan(design.elevation(9.0, 0.0)) and np.isnan(design.elevation(21.0, 0.0))
    assert design.is_floor(np.array([15.0]), np.array([0.76])).tolist() == [False]
    assert design.station_range() == (10, 20)


def test_beside_a_vertical_wall_there_is_no_design(tmp_path):
    design = read_profile(profile(tmp_path, "station,elevation,width,side_slope\n0,5,1,0\n9,5,1,0\n"), 1.0)
    assert design.elevation(3.0, 0.5) == 5
    assert np.isnan(design.elevation(3.0, 0.51))


def test_lengths_are_converted_and_the_side_slope_is_not(tmp_path):
    path = profile(tmp_path, "station,elevation,width,side_slope\n0,100,10,2\n100,100,10,2\n")
    design = read_profile(path, FOOT)
    assert design.station_range()[1] == pytest.approx(100 * FOOT)
    assert design.elevation(1.0, 5 * FOOT + 3.0) == pytest.approx(100 * FOOT + 1.5)


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("", "holds 0 rows"),
        ("station,elevation,width\n1,2,3\n", r"design\.csv:1: .*missing: side_slope"),
        ("1,50,1,0\n2,50,1,0\n", r"design\.csv:1: the first line must name the columns"),
        ("station,elevation,width,side_slope\n0,50,1,0\n", "holds 1 rows"),
        ("station,elevation,width,side_slope\n0,50,1,0\n5,abc,1,0\n", r"design\.csv:3: elevation: .*'abc'"),
        ("station,elevation,width,side_slope\n0,50,1,0\n5,50,1\n", r"design\.csv:3: side_slope: .*''"),
        ("station,elevation,width,side_slope\n0,50,1,0\n5,nan,1,0\n", "expected a number"),
        ("station,elevation,width,side_slope\n5,50,1,0\n5,50,1,0\n", "stations must grow .* 5 follows 5"),
        ("station,elevation,width,side_slope\n0,50,0,0\n5,50,1,0\n", "width must be positive"),
    ],
)  # fmt: skip
def test_a_profile_that_makes_no_sense_is_refused_with_its_line(tmp_path, text, sentence):
    with pytest.raises(SurfaceError, match=sentence):
        read_profile(profile(tmp_path, text), 1.0)


def test_semicolons_tabs_comments_and_further_columns_are_understood(tmp_path):
    for s in ";\t":
        text = f"Station{s}Elevation{s}Note{s}Width{s}Side_Slope\n# km 0\n0{s}5{s}x{s}1{s}0\n\n9{s}5{s}{s}1{s}0\n"
        assert read_profile(profile(tmp_path, text), 1.0).station.tolist() == [0, 9]


def test_elevations_of_a_surface_are_those_of_its_planes():
    points, faces = trapezoid()
    design = TinDesign("t", points, faces, polyline([[0, 0], [0, 20]]))
    rng = np.random.default_rng(0)
    station, offset = rng.uniform(0, 20, 5000), rng.uniform(-7, 7, 5000)
    rise = np.clip((np.abs(offset) - 0.5) / 1.5, 0, 2)
    assert np.allclose(design.elevation(station, offset), 0.01 * station + rise, rtol=0, atol=1e-9)
    assert np.all(np.isnan(design.elevation(station, offset + 20)))
    assert np.isfinite(design.elevation(np.linspace(0, 20, 50), np.full(50, 0.5))).all()  # on shared edges


def test_the_floor_of_a_surface_is_flat_and_hangs_together_under_the_alignment():
    points, faces = trapezoid()
    design = TinDesign("t", points, faces, polyline([[0, 0], [0, 20]]))
    offset = np.array([-6.0, -2.0, -0.49, 0.0, 0.49, 0.51, 3.0, 6.0])
    # The ground beside the trench is as flat as the floor, but the slopes part them.
    assert design.is_floor(10.0, offset).tolist() == [False, False, True, True, True, False, False, False]
    assert design.floor_reach() == pytest.approx(0.5)
    assert not design.floor_is_whole
    assert design.floor_level(np.array([5.0])) == pytest.approx(0.05)


def test_vertical_walls_neither_break_the_surface_nor_join_floor_and_ground():
    points, faces = trapezoid(run=0.0)
    design = TinDesign("t", points, faces, polyline([[0, 0], [0, 20]]))
    assert design.is_floor(10.0, np.array([-0.6, 0.0, 0.6])).tolist() == [False, True, False]
    assert design.elevation(10.0, np.array([0.0, 0.6])) == pytest.approx([0.1, 2.1])


def test_a_ditch_without_flat_faces_is_floor_as_a_whole_and_says_so():
    points, faces = trapezoid(half=0.0, run=1 / (FLOOR_SLOPE * 1.5))
    keep = ~np.any(np.isin(faces, [0, 5, 6, 11]), axis=1)
    design = TinDesign("t", points, faces[keep], polyline([[0.1, 0], [0.1, 20]]))
    assert design.floor_is_whole
    assert design.is_floor(10.0, np.array([-2.0, 2.0])).all()


def test_the_lowest_of_two_faces_above_each_other_is_the_design():
    points = np.array([[0, 0, 5], [10, 0, 5], [0, 10, 5], [0, 0, 3], [10, 0, 3], [0, 10, 3.0]])
    for faces in ([[0, 1, 2], [3, 4, 5]], [[3, 4, 5], [0, 1, 2]]):
        design = TinDesign("t", points, np.array(faces), polyline([[1, 1], [1, 5]]))
        assert design.elevation(2.0, 0.0) == 3


def written(tmp_path, text, name="design.xml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_a_landxml_design_and_the_same_profile_say_the_same(tmp_path):
    xml = written(tmp_path, landxml(*trapezoid()))
    csv = profile(tmp_path, "station,elevation,width,side_slope\n0,50,1,1.5\n20,50.2,1,1.5\n")
    surface, alignment = read_design(xml, site("design.xml", "landxml"))
    row, _ = read_design(csv, site("design.csv", "profile_csv"))
    station, offset = np.meshgrid(np.linspace(0.1, 19.9, 30), np.linspace(-3.4, 3.4, 40))
    assert np.allclose(surface.elevation(station, offset), row.elevation(station, offset), rtol=0, atol=1e-6)
    assert np.array_equal(surface.is_floor(station, offset), row.is_floor(station, offset))
    assert alignment.length == 20
    assert surface.station_range() == pytest.approx((0, 20), abs=0.0011)


def test_the_alignment_of_the_file_is_used_where_site_toml_has_none(tmp_path):
    line = (
        '<Alignments><Alignment name="CL" staStart="100" length="20"><CoordGeom>'
        "<Line><Start>4123000 512000</Start><End>4123020 512000</End></Line></CoordGeom></Alignment></Alignments>"
    )
    xml = written(tmp_path, landxml(*trapezoid(), alignment=line))
    _, alignment = read_design(xml, site("design.xml", "landxml", points="file", more='alignment = "CL"'))
    assert (alignment.start_station, alignment.end_station, alignment.name) == (100, 120, "CL")


SPIRAL = (
    '<Spiral length="20" radiusStart="INF" radiusEnd="90" rot="cw" spiType="clothoid">'
    "<Start>4123000 512000</Start><End>4123020 512000</End></Spiral>"
)
LINE = "<Line><Start>4123000 512000</Start><End>4123020 512000</End></Line>"


@pytest.mark.parametrize(
    "geometry, length, sentence",
    [
        (
            SPIRAL.replace("clothoid", "bloss"),
            20,
            "alignment 'CL' has spirals that are bloss; clothoids are understood",
        ),
        (SPIRAL.replace('spiType="clothoid"', ""), 20, "alignment 'CL' has spirals that are of no kind"),
        (SPIRAL.replace('length="20"', ""), 20, "alignment 'CL' has a spiral without length"),
        (
            SPIRAL.replace("Spiral", "Clothoid"),
            20,
            "has elements of kind Clothoid; lines, arcs and spirals are",
        ),
        (
            SPIRAL.replace('"20"', '"21"'),
            20,
            r"spiral 1 is stated as 21\.000 m long, .* 20\.0\d\d m from its start",
        ),
        (
            LINE + "</CoordGeom><StaEquation staBack='110' staAhead='200'/><CoordGeom>",
            20,
            "has station equations",
        ),
        (LINE, 21, r"its elements are 20\.000 long, the file says 21\.000"),
        (LINE.replace("Line", "Curve"), 20, "has an arc without Center"),
        (LINE.replace("4123020", "4e9"), 20, r"is 3,\d{3},877 km long; cut it down to the job"),
    ],
)
def test_an_alignment_that_cannot_be_followed_is_refused(tmp_path, geometry, length, sentence):
    alone = f'<Alignment name="CL" length="{length}"><CoordGeom>{geometry}</CoordGeom></Alignment>'
    text = f"<Alignments>{alone}</Alignments>"
    xml = written(tmp_path, landxml(*trapezoid(), alignment=text))
    with pytest.raises(SurfaceError, match=sentence):
        read_design(xml, site("design.xml", "landxml", points="file", more='alignment = "CL"'))


@pytest.mark.parametrize(
    "change, sentence",
    [
        ({"units": '<Imperial linearUnit="foot"/>'}, r"its unit is 'foot', but grid\.unit in site\.toml is 'm'"),
        ({"shift": (4_123_000, 512_000, 50)}, "northing and easting look swapped"),
        ({"shift": (512_000 / FOOT, 4_123_000 / FOOT, 50)}, "look like '(us_survey|international)_foot'"),
        ({"shift": (0, 0, 50)}, "km from grid.origin .* another job"),
        ({"shift": (512_000, 4_123_000, 5000)}, "m from the elevation of grid.origin"),
        ({"shift": (512_300, 4_123_000, 50)}, "does not lie under the alignment anywhere"),
    ],
)  # fmt: skip
def test_a_design_of_another_place_or_unit_is_refused_with_the_likely_cause(tmp_path, change, sentence):
    xml = written(tmp_path, landxml(*trapezoid(), **change))
    with pytest.raises(SurfaceError, match=sentence):
        read_design(xml, site("design.xml", "landxml"))


def test_elevations_in_another_unit_than_the_benchmarks_are_refused(tmp_path):
    # 50 m are 164 ft: near enough to grid.origin for another height datum, and further from the boards than one digs.
    csv = profile(tmp_path, "station,elevation,width,side_slope\n0,164.04,1,0\n20,164.04,1,0\n")
    with pytest.raises(SurfaceError, match=r"lies at 164\.04, 114 m from the nearest benchmark \(50\.00\)"):
        read_design(csv, site("design.csv", "profile_csv"))
    deep = profile(tmp_path, "station,elevation,width,side_slope\n0,12,1,0\n20,12,1,0\n")
    assert read_design(deep, site("design.csv", "profile_csv"))[0].floor_level(5.0) == 12.0


def test_an_alignment_with_swapped_axes_is_refused(tmp_path):
    csv = profile(tmp_path, "station,elevation,width,side_slope\n0,50,1,0\n20,50,1,0\n")
    swapped = site("design.csv", "profile_csv", points=[[4_123_000, 512_000], [4_123_020, 512_000]])
    with pytest.raises(SurfaceError, match=r"the alignment in site\.toml: .* swapped"):
        read_design(csv, swapped)


def test_a_profile_whose_stations_miss_the_alignment_is_refused(tmp_path):
    csv = profile(tmp_path, "station,elevation,width,side_slope\n0,50,1,0\n20,50,1,0\n")
    with pytest.raises(
        SurfaceError, match=r"from station 0\.00 to 20\.00, the alignment from 100\.00 to 120\.00"
    ):
        read_design(csv, site("design.csv", "profile_csv", start=100.0))


def test_a_missing_or_unreadable_design_is_one_sentence(tmp_path):
    for kind, name in (("profile_csv", "no.csv"), ("landxml", "no.xml")):
        with pytest.raises(SurfaceError, match=name):
            read_design(tmp_path / name, site(name, kind))
    binary = tmp_path / "design.csv"
    binary.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(SurfaceError, match="cannot be read as UTF-8"):
        read_design(binary, site("design.csv", "profile_csv"))


# Designs of other kinds: each gives the levels of one closed form, and is refused with its axes swapped.

AXIS = "<Line><Start>4123000 512000</Start><End>4123020 512000</End></Line>"
LEVELS = '<PVI>100 50</PVI><ParaCurve length="8">110 49</ParaCurve><PVI>120 50</PVI>'
STRUCTS = (
    '<Struct name="A"><Center>4123000 512000</Center><Invert elev="50" flowDir="out" refPipe="p"/></Struct>'
    '<Struct name="B"><Center>4123020 512000</Center><Invert elev="49" flowDir="in" refPipe="p"/></Struct>'
)


def swapped(text):
    """Easting first, as no LandXML has it."""
    return re.sub(r"(4123\d{3}) (512\d{3})", r"\2 \1", text)


def xml_of(tmp_path, more, levels=LEVELS, structs=STRUCTS, change=str):
    axis = f'<Alignment name="CL" staStart="100"><CoordGeom>{AXIS}</CoordGeom>'
    axis += f'<Profile><ProfAlign name="floor">{levels}</ProfAlign></Profile></Alignment>'
    pipes = f'<PipeNetwork name="storm"><Structs>{structs}</Structs><Pipes><Pipe name="p" refStart="A" refEnd="B">'
    pipes += '<CircPipe diameter="0.3"/></Pipe></Pipes></PipeNetwork>'
    text = '<LandXML><Units><Metric linearUnit="meter"/></Units>'
    text += change(f"<Alignments>{axis}</Alignments><PipeNetworks>{pipes}</PipeNetworks></LandXML>")
    return written(tmp_path, text), site("design.xml", "landxml", points="file", more=more)


PROFILE_KEYS = 'alignment = "CL"\nprofile = "floor"\nwidth = 1.2\nside_slope = 0.5'
PIPE_KEYS = 'pipes = "storm"\nbedding = 0.15\nwidth = 1.2'


def test_a_landxml_profile_gives_the_level_of_the_floor(tmp_path):
    design, alignment = read_design(*xml_of(tmp_path, PROFILE_KEYS))
    assert (alignment.start_station, alignment.end_station) == (100, 120)
    station = np.linspace(100, 120, 400)
    bend = np.clip(station - 106, 0, 8)
    level = 50 - 0.1 * (station - 100) + np.where(station < 114, 0.2 / 16 * bend**2, 0.2 * (station - 110))
    assert np.allclose(design.floor_level(station), level, rtol=0, atol=2e-6)
    assert design.elevation(104.0, 1.6) == pytest.approx(49.6 + 1.0 / 0.5)
    assert design.is_floor(104.0, np.array([0.59, 0.61])).tolist() == [True, False]
    assert floor_sentence(design).startswith("The floor is everything within half")


def test_a_run_of_pipes_gives_a_floor_under_its_inverts(tmp_path):
    design, alignment = read_design(*xml_of(tmp_path, PIPE_KEYS + "\nstart_station = 30"))
    assert (alignment.start_station, alignment.end_station) == (30, 50)
    assert design.floor_level(np.array([30.0, 40.0, 50.0])) == pytest.approx([49.85, 49.35, 48.85])
    assert np.isnan(design.elevation(40.0, 0.61)) and design.elevation(40.0, 0.59) == pytest.approx(49.35)
    assert "0.15 under the inverts of storm" in design.name
    along, _ = read_design(*xml_of(tmp_path, PIPE_KEYS + '\nalignment = "CL"\nside_slope = 1'))
    assert along.floor_level(np.array([110.0])) == pytest.approx([49.35])
    assert along.elevation(110.0, 1.6) == pytest.approx(50.35)


def test_pipes_may_lie_along_the_alignment_of_the_site_file(tmp_path):
    path, _ = xml_of(tmp_path, PIPE_KEYS)
    design, _ = read_design(path, site("design.xml", "landxml", start=7.0, more=PIPE_KEYS))
    assert design.floor_level(np.array([17.0])) == pytest.approx([49.35])


def test_a_job_in_feet_has_its_width_and_bedding_in_feet(tmp_path):
    path, _ = xml_of(tmp_path, PIPE_KEYS)
    path.write_text(path.read_text().replace("Metric", "Imperial").replace('"meter"', '"USSurveyFoot"'))
    feet = site("design.xml", "landxml", unit="us_survey_foot", points="file", more=PIPE_KEYS)
    design, alignment = read_design(path, feet)
    assert alignment.length == pytest.approx(20 * FOOT)
    assert design.floor_level(np.array([10 * FOOT])) == pytest.approx([49.35 * FOOT])
    assert design.floor_reach() == pytest.approx(0.6 * FOOT)


def dxf_of(tmp_path, run=1.5, turn=lambda p: p, units=6, more="", line=True):
    """A drawing of the trapezoid, and of its axis from station 100."""
    doc = ezdxf.new()
    doc.header["$INSUNITS"] = units
    points, faces = trapezoid(run=run)
    points = points + [512_000, 4_123_000, 50]
    for face in faces:
        doc.modelspace().add_3dface([turn(points[k]) for k in face], dxfattribs={"layer": "t"})
    ends = np.array([[512_000, 4_123_000, 0], [512_000, 4_123_020, 0]])
    doc.modelspace().add_lwpolyline([turn(p)[:2] for p in ends], dxfattribs={"layer": "axis"})
    path = tmp_path / "design.dxf"
    doc.saveas(path)
    keys = 'layer = "t"\n' + ('alignment_layer = "axis"\nstart_station = 100\n' if line else "") + more
    return path, site("design.dxf", "dxf", points="file" if line else None, more=keys)


def test_a_drawing_and_the_same_landxml_say_the_same(tmp_path):
    drawn, axis = read_design(*dxf_of(tmp_path))
    xml = written(tmp_path, landxml(*trapezoid()))
    surface, _ = read_design(xml, site("design.xml", "landxml", start=100.0))
    assert axis.start_station == 100
    station, offset = np.meshgrid(np.linspace(100.1, 119.9, 30), np.linspace(-5, 5, 40))
    assert np.allclose(
        drawn.elevation(station, offset), surface.elevation(station, offset), rtol=0, atol=1e-6
    )
    assert np.array_equal(drawn.is_floor(station, offset), surface.is_floor(station, offset))
    assert read_design(*dxf_of(tmp_path, line=False))[0].floor_reach() == pytest.approx(0.5)


def test_a_drawing_may_have_vertical_walls(tmp_path):
    design, _ = read_design(*dxf_of(tmp_path, run=0.0))
    assert design.is_floor(110.0, np.array([-0.6, 0.0, 0.6])).tolist() == [False, True, False]
    assert design.elevation(110.0, np.array([0.0, 0.6])) == pytest.approx([50.1, 52.1])


def test_a_drawing_without_a_unit_needs_one_in_the_site_file(tmp_path):
    with pytest.raises(SurfaceError, match=r"does not say its unit .* write unit = \"m\""):
        read_design(*dxf_of(tmp_path, units=0))
    assert read_design(*dxf_of(tmp_path, units=0, more='unit = "m"'))[1].length == pytest.approx(20)
    with pytest.raises(SurfaceError, match="its unit is millimetres"):
        read_design(*dxf_of(tmp_path, units=4))


@pytest.mark.parametrize("keys", [PROFILE_KEYS, PIPE_KEYS])
def test_landxml_lines_with_easting_first_are_refused(tmp_path, keys):
    with pytest.raises(
        SurfaceError,
        match=r"(alignment 'CL'|network 'storm'): lies around .* northing and easting look swapped",
    ):
        read_design(*xml_of(tmp_path, keys, change=swapped))


@pytest.mark.parametrize("line", [True, False])
def test_a_drawing_with_northing_first_is_refused(tmp_path, line):
    where = "alignment 'axis'" if line else "surface 't'"
    with pytest.raises(SurfaceError, match=f"{where}: lies around .* northing and easting look swapped"):
        read_design(*dxf_of(tmp_path, turn=lambda p: (p[1], p[0], p[2]), line=line))


def test_pipes_of_another_place_beside_the_alignment_of_the_site_file_are_refused(tmp_path):
    path, _ = xml_of(tmp_path, PIPE_KEYS, change=swapped)
    with pytest.raises(SurfaceError, match=r"network 'storm': lies around .* look swapped"):
        read_design(path, site("design.xml", "landxml", more=PIPE_KEYS))


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffstation;elevation;width;side_slope\n0;50,25;1,5;0\n9,5;50,75;1,5;0\n",
        "Station\tElevation\tWidth\tSide_Slope\tnote\n0\t50,25\t1.5\t0\t1,2,3\n9.5\t50,75\t1,5\t0\t\n",
        '"station","elevation","width","side_slope"\r\n"0","50.25","1.5","0"\r\n"9.5","50.75","1.5","0",,\r\n',
    ],
)
def test_decimal_commas_byte_order_marks_and_quotes_are_understood(tmp_path, text):
    path = tmp_path / "design.csv"
    path.write_text(text, encoding="utf-8", newline="")
    design = read_profile(path, 1.0)
    assert design.station.tolist() == [0, 9.5]
    assert design.floor.tolist() == [50.25, 50.75]
    assert design.width.tolist() == [1.5, 1.5]


def test_decimal_commas_between_commas_are_refused_and_not_misread(tmp_path):
    text = "station,elevation,width,side_slope\n0,0,50,25,1,5,0,0\n9,5,50,75,1,5,0,0\n"
    with pytest.raises(SurfaceError, match=r"design\.csv:2: has 8 cells for 4 columns; .* semicolons"):
        read_profile(profile(tmp_path, text), 1.0)
    with pytest.raises(SurfaceError, match=r"design\.csv:2: elevation: expected a number, found '1\.234,5'"):
        read_profile(profile(tmp_path, "station;elevation;width;side_slope\n0;1.234,5;1;0\n9;50;1;0\n"), 1.0)
