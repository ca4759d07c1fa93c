"""LandXML beyond surfaces: spirals, chains, references, profiles and pipes; bounds hold for them too."""

import itertools
import math

import pytest

from pipeline.errors import SurfaceError
from pipeline.surface import landxml_section
from pipeline.surface.landxml import profile_named, read_landxml

METRES = '<Units><Metric linearUnit="meter" diameterUnit="millimeter"/></Units>'
SPIRAL = """
<Spiral length="40.25" radiusStart="INF" radiusEnd="250." rot="ccw" spiType="clothoid">
<Start>10 5</Start><PI>20 5</PI><End>50 4</End></Spiral>"""
POINTS = """<CgPoints name="all"><CgPoints name="inner"><CgPoint name="1">100. 5. 7.</CgPoint>
<CgPoint name="2">110. 5.<Feature code="x"><Property label="a" value="b"/></Feature></CgPoint>
<CgPoint name="two" pntRef="2"/><CgPoint name="3">120 25</CgPoint></CgPoints></CgPoints>"""
PROFILE = """<Profile name="road"><ProfAlign name="floor"><PVI>0 10</PVI><ParaCurve length="20">50 12</ParaCurve>
<UnsymParaCurve lengthIn="5" lengthOut="8">80 11</UnsymParaCurve>
<CircCurve length="9.5" radius="-300">120 13</CircCurve>
<PVI>200 12</PVI></ProfAlign>
<ProfSurf name="ground"><PntList2D>0 14 100 15.5 200 14</PntList2D></ProfSurf></Profile>"""
NETWORK = """<PipeNetworks><PipeNetwork name="storm" pipeNetType="storm">
<Structs><Struct name="A"><Center>100 5</Center><Invert elev="50" flowDir="out" refPipe="p"/></Struct>
<Struct name="B"><Center pntRef="3"/><Invert elev="49.6" flowDir="in" refPipe="p"/>
<Invert elev="49.5" flowDir="out" refPipe="q"/></Struct>
<Struct name="C"><Center>140 5 49</Center><Invert elev="49.1" flowDir="in" refPipe="q"/></Struct></Structs>
<Pipes><Pipe name="p" refStart="A" refEnd="B"><CircPipe diameter="300" material="x"/></Pipe>
<Pipe name="q" refStart="B" refEnd="C"><RectPipe height="1" width="1"/></Pipe></Pipes></PipeNetwork></PipeNetworks>"""


def alignment(geometry, more=""):
    line = f'<Alignment name="CL" staStart="100"><CoordGeom>{geometry}</CoordGeom>{more}</Alignment>'
    return f"<Alignments>{line}</Alignments>"


def read(tmp_path, body, units=METRES):
    path = tmp_path / "design.xml"
    path.write_text(f"<LandXML>{units}{body}</LandXML>")
    return read_landxml(path)


def refused(tmp_path, body, sentence):
    with pytest.raises(SurfaceError, match=sentence) as caught:
        read(tmp_path, body)
    assert "\n" not in str(caught.value)


def test_a_spiral_has_its_radii_its_length_and_its_kind(tmp_path):
    (spiral,) = read(tmp_path, alignment(SPIRAL)).alignment("CL").elements
    assert (spiral.kind, spiral.start, spiral.end, spiral.clockwise) == ("Spiral", (5, 10), (4, 50), False)
    assert spiral.radii == (math.inf, 250.0)
    assert (spiral.length, spiral.spiral) == (40.25, "clothoid")


def test_points_may_be_named_before_or_after_and_through_one_another(tmp_path):
    line = '<Line><Start pntRef="1"/><End pntRef="two"/></Line><Curve rot="cw"><Start>110 5</Start>'
    line += '<Center>110 25</Center><End pntRef="3"/></Curve>'
    for body in (POINTS + alignment(line), alignment(line) + POINTS):
        first, second = read(tmp_path, body).alignment(None).elements
        assert (first.start, first.end) == ((5, 100), (5, 110))
        assert (second.center, second.end) == ((25, 110), (25, 120))


def test_chains_and_irregular_lines_are_polylines(tmp_path):
    chain = read(tmp_path, alignment("<Chain>1 2 3</Chain>") + POINTS).alignment(None).elements
    assert [(e.kind, e.start, e.end) for e in chain] == [
        ("Line", (5, 100), (5, 110)),
        ("Line", (5, 110), (25, 120)),
    ]
    for listed in ("<PntList2D>0 0 10 1 20 3</PntList2D>", "<PntList3D>0 0 9 10 1 9 20 3 9</PntList3D>"):
        body = f"<IrregularLine><Start>0 0</Start><End>30 3</End>{listed}</IrregularLine>"
        elements = read(tmp_path, alignment(body)).alignment(None).elements
        assert [e.start for e in elements] == [(0, 0), (1, 10), (3, 20)]
        assert elements[-1].end == (3, 30)


def test_profiles_keep_their_curves(tmp_path):
    line = read(tmp_path, alignment("<Line><Start>0 0</Start><End>200 0</End></Line>", PROFILE)).alignment(
        None
    )
    floor = profile_named(line, "floor", "design.xml")
    assert [(v.kind, v.station, v.elevation) for v in floor.vertices] == [
        ("PVI", 0, 10), ("ParaCurve", 50, 12), ("UnsymParaCurve", 80, 11), ("CircCurve", 120, 13), ("PVI", 200, 12),
    ]  # fmt: skip
    assert (floor.vertices[1].length_in, floor.vertices[1].length_out) == (10, 10)
    assert (floor.vertices[2].length_in, floor.vertices[2].length_out) == (5, 8)
    assert (floor.vertices[3].radius, floor.vertices[3].length) == (-300, 9.5)
    ground = profile_named(line, "ground", "design.xml")
    assert (ground.kind, [v.elevation for v in ground.vertices]) == ("ProfSurf", [14, 15.5, 14])
    with pytest.raises(
        SurfaceError, match=r"has no profile 'x'; it holds 'floor', 'ground'; mend design.profile"
    ):
        profile_named(line, "x", "design.xml")


def test_profiles_go_with_the_alignment_they_stand_in(tmp_path):
    line = "<Line><Start>0 0</Start><End>200 0</End></Line>"
    bare = alignment(line).replace("CL", "bare")
    found = read(tmp_path, alignment(line, PROFILE) + bare)
    assert len(found.alignment("CL").profiles) == 2
    assert found.alignment("bare").profiles == ()


def test_of_two_inverts_for_one_pipe_the_flow_tells_which_end_is_meant(tmp_path):
    both = NETWORK.replace(
        'flowDir="in" refPipe="q"', 'flowDir="in" refPipe="q"/><Invert elev="48" flowDir="out" refPipe="q"'
    )
    both = both.replace(
        'flowDir="out" refPipe="p"', 'flowDir="out" refPipe="p"/><Invert elev="51" flowDir="in" refPipe="p"'
    )
    p, q = read(tmp_path, both + POINTS).pipes
    assert (p.start[2], q.end[2]) == (50, 49.1)


def test_pipes_lie_at_the_inverts_of_their_structures(tmp_path):
    p, q = read(tmp_path, NETWORK + POINTS).pipes
    assert (p.network, p.name, p.start, p.end) == ("storm", "p", (5, 100, 50), (25, 120, 49.6))
    assert (q.start, q.end) == ((25, 120, 49.5), (5, 140, 49.1))
    assert p.diameter == pytest.approx(0.3) and q.diameter is None


@pytest.mark.parametrize(
    "units, diameter",
    [
        ('<Metric linearUnit="meter" diameterUnit="meter"/>', 300.0),
        ('<Imperial linearUnit="foot" diameterUnit="inch"/>', 25.0),
        ('<Imperial linearUnit="USSurveyFoot" diameterUnit="inch"/>', 300 * 0.0254 * 3937 / 1200),
        ('<Imperial linearUnit="foot"/>', None),
    ],
)
def test_diameters_are_in_the_linear_unit_or_unknown(tmp_path, units, diameter):
    found = read(tmp_path, NETWORK + POINTS, f"<Units>{units}</Units>").pipes[0].diameter
    assert found is None if diameter is None else found == pytest.approx(diameter)


def test_a_curved_pipe_is_chords_within_a_millimetre_of_its_arc(tmp_path):
    curved = NETWORK.replace(
        '<CircPipe diameter="300" material="x"/>', '<CircPipe diameter="300"/><Center>120 5</Center>'
    )
    pipes = [pipe for pipe in read(tmp_path, curved + POINTS).pipes if pipe.name == "p"]
    assert len(pipes) > 20
    assert (pipes[0].start, pipes[-1].end) == ((5, 100, 50), (25, 120, 49.6))
    for a, b in itertools.pairwise(pipes):
        assert a.end == b.start
    for pipe in pipes:
        middle = [(s + t) / 2 for s, t in zip(pipe.start, pipe.end, strict=True)]
        assert math.hypot(middle[0] - 5, middle[1] - 120) == pytest.approx(20, abs=1.001e-3)
        share = math.atan2(pipe.end[0] - 5, -(pipe.end[1] - 120)) / (math.pi / 2)
        assert pipe.end[2] == pytest.approx(50 - 0.4 * share, abs=1e-9)


@pytest.mark.parametrize(
    "old, new, sentence",
    [
        ('refEnd="B"', 'refEnd="Z"', "pipe 'p' of network 'storm' ends at structure 'Z', which is not there"),
        ("<Center>100 5</Center>", "", "structure 'A', which is not there or has no Center"),
        (
            'elev="49.6" flowDir="in" refPipe="p"',
            'elev="49.6" flowDir="in" refPipe="x"',
            "at structure 'B' no invert",
        ),
        (
            'elev="49.5" flowDir="out" refPipe="q"',
            'elev="49.5" flowDir="in" refPipe="p"',
            "'B' 2 invert elevations",
        ),
        ('pntRef="3"', 'pntRef="33"', "structure 'B' refers to point '33', which the file does not hold"),
    ],
)
def test_pipes_that_cannot_be_placed_are_refused_by_whoever_wants_pipes(tmp_path, old, new, sentence):
    assert old in NETWORK
    found = read(tmp_path, NETWORK.replace(old, new) + POINTS)  # a surface beside them is none the worse
    with pytest.raises(SurfaceError, match=sentence):
        _ = found.pipes


LINE = "<Line><Start>0 0</Start><End>200 0</End></Line>"


@pytest.mark.parametrize(
    "body, sentence",
    [
        (alignment(SPIRAL.replace('"INF"', '"-5"')), "radiusStart of .* expected a positive number or INF"),
        (alignment(SPIRAL.replace('radiusEnd="250."', "")), "radiusEnd of alignment 'CL': expected 1 number, found ''"),
        (alignment('<Line><Start pntRef="9"/><End>1 1</End></Line>') + POINTS, "refers to point '9', which the file"),
        (alignment("<Chain>1</Chain>") + POINTS, "Chain of alignment 'CL' has fewer than two points"),
        (alignment("<Chain>a b</Chain>") + POINTS.replace('"1"', '"a"').replace('"2"', '"b"').replace('"3"', '"a"'),
         "refers to point 'a', of which there are several"),
        (alignment('<Chain>a b</Chain><CgPoints><CgPoint name="a" pntRef="b"/></CgPoints>'), "refers to point"),
        (alignment(LINE) + '<CgPoints><CgPoint name="a">1 x</CgPoint></CgPoints>', "point 'a': expected 2 numbers"),
        (alignment("<IrregularLine><PntList3D>1 2 3 4</PntList3D></IrregularLine>"), "has 4 numbers, which"),
        (alignment(LINE, PROFILE.replace('length="20"', "")), "a ParaCurve .* at station 50 has no length"),
        (alignment(LINE, PROFILE.replace('radius="-300"', "")), "a CircCurve .* has no radius"),
        (alignment(LINE, PROFILE.replace("80 11", "80")), "a UnsymParaCurve of profile 'floor': expected 2 numbers"),
        (alignment(LINE, PROFILE.replace("0 14 100", "14 100")), "the list of profile 'ground' has 5 numbers"),
        (alignment(LINE, PROFILE.replace("0 10<", "0 inf<")), "expected 2 numbers, found '0 inf'"),
        (NETWORK.replace('elev="50"', 'elev="low"'), "elev of an Invert of network 'storm': expected 1 number"),
        (NETWORK.replace('diameter="300"', 'diameter="nan"'), "diameter of pipe 'p'"),
        (NETWORK.replace('name="C"', 'name="B"'), "two structures called 'B'"),
        (alignment("<Chain>" + "1 " * 20_000_000 + "</Chain>"), "a Chain element with more than 20000000 characters"),
        (alignment(LINE, PROFILE.replace("80 11", "8" * 20_000)), "a UnsymParaCurve element with more than 10000"),
        (alignment("<Line><Start>" + "<a>" * 70 + "</a>" * 70 + "</Start></Line>"), "nested deeper than 64"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_or_may_be_hostile_is_refused_in_one_sentence(tmp_path, body, sentence):
    refused(tmp_path, body, sentence)


def test_points_that_refer_to_each_other_end(tmp_path):
    ring = '<CgPoints><CgPoint name="a" pntRef="b"/><CgPoint name="b" pntRef="a"/></CgPoints>'
    refused(
        tmp_path,
        alignment("<Chain>a b</Chain>") + ring,
        "refers to point '[ab]', which the file does not hold",
    )


@pytest.mark.parametrize(
    "body",
    [
        alignment(LINE * 9),
        alignment(LINE, PROFILE),
        NETWORK + POINTS,
        POINTS + alignment("<Chain>1 2</Chain>"),
    ],
)
def test_records_are_counted(tmp_path, monkeypatch, body):
    monkeypatch.setattr(landxml_section, "MAX_RECORDS", 2)
    refused(tmp_path, body, "more than 2 .*; cut the file down")


def test_misplaced_parts_of_a_hostile_file_are_passed_over_or_refused_and_never_crash(tmp_path):
    odd = "<Alignment><CoordGeom><Line><Alignment><CoordGeom><Feature><Start>1 1</Start></Feature>"
    odd += "</CoordGeom></Alignment></Line></CoordGeom></Alignment>"
    refused(tmp_path, odd, "a Line of alignment '' has no Start or no End")
    odd = "<Surfaces><F>1</F><P>2</P><Definition/></Surfaces><PipeNetworks><Invert/>"
    odd += "<Pipe/><Center>1 1</Center></PipeNetworks><Profile><PVI>x</PVI></Profile>"
    assert read(tmp_path, odd).alignments == ()
