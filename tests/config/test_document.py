"""Every mistake in machine.toml or site.toml is told with file, line and key."""

import re

import pytest

from pipeline.config import load_machine, load_site
from pipeline.config.document import decode, line_of, read_file
from pipeline.errors import ConfigError


def test_both_examples_load(machine_text, site_text):
    machine, site = load_machine(machine_text, "machine.toml"), load_site(site_text, "site.toml")
    assert set(machine.bodies) == {"cab", "stick", "bucket"}
    assert [tag.id for tag in machine.markers["plate"].tags] == [1, 2]
    assert site.benchmarks["bm2"].corners[2].enh == (1001.3, 2012.0, 50.7)


def complaint(load, text, old, new):
    """What loading says about a text in which `old` was replaced by `new`, and that text by lines."""
    assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times"
    wrong = text.replace(old, new)
    with pytest.raises(ConfigError) as caught:
        load(wrong, "a/file.toml")
    return str(caught.value), wrong.splitlines()


GAS = """
[utilities.gas]
kind = "gas"
points = [[1000, 2005, 48], [1010, 2005, 48]]
radius_mm = 100
sigma_mm = [50, 80]
"""


def test_one_file_in_the_place_of_the_other_is_said_in_one_line(machine_text, site_text):
    with pytest.raises(ConfigError) as error:
        load_machine(site_text, "site.toml")
    assert str(error.value) == "site.toml: is a site.toml, and a machine.toml is needed in its place"
    with pytest.raises(
        ConfigError, match=r"^a: is a machine\.toml, and a site\.toml is needed in its place$"
    ):
        load_site(machine_text, "a")


def test_buried_lines_load_with_their_sigmas_in_metres(site_text):
    site = load_site(site_text + GAS, "site.toml")
    assert site.utilities["gas"].sigmas_m == (0.05, 0.08) and site.utilities["gas"].clearance_mm == 500
    alike = load_site(site_text + GAS.replace("[50, 80]", "50"), "site.toml")
    assert alike.utilities["gas"].sigmas_m == (0.05, 0.05)
    of_file = GAS.replace(
        "points = [[1000, 2005, 48], [1010, 2005, 48]]\nradius_mm = 100", 'file = "pipes.xml"'
    )
    assert load_site(site_text + of_file, "site.toml").utilities["gas"].radius_mm is None


@pytest.mark.parametrize(
    "old, new, line, said",
    [
        (", [1010, 2005, 48]", "", "[utilities.gas]", "at least two different points"),
        ("1010, 2005, 48", "1000, 2005, 48", "[utilities.gas]", "at least two different points"),
        (
            "1010, 2005, 48",
            "1010, 2_005_000, 48",
            "points",
            "gas.points: point 2 lies 2,003 km from grid.origin",
        ),
        ("1010, 2005, 48", "1010, nan, 48", "points", "gas.points.1.1: should be a finite number"),
        ("1010, 2005, 48", "1010, 48", "points", "gas.points.1: has too few values"),
        ("[1010, 2005, 48]", ", ".join(["[1, 2, 3]"] * 2001), "points", "at most 2000 items"),
        ('"gas"', '"oil"', "kind", "gas.kind: should be 'gas', 'water', 'power'"),
        ("radius_mm = 100", "radius_mm = 6000", "radius_mm", "less than or equal to 5000"),
        ("radius_mm = 100\n", "", "[utilities.gas]", "points need radius_mm"),
        ("sigma_mm = [50, 80]", "", "[utilities.gas]", "sigma_mm: is missing"),
        ("[50, 80]", "[50, -1]", "sigma_mm", "greater than or equal to 0"),
        ("radius_mm = 100", 'radius_mm = 100\nfile = "a.xml"', "[utilities.gas]", "give either points"),
        ("radius_mm = 100", 'radius_mm = 100\nnetwork = "a"', "[utilities.gas]", "network goes with file"),
    ],
)
def test_mistakes_in_buried_lines_name_file_and_line(site_text, old, new, line, said):
    message, lines = complaint(load_site, site_text + GAS, old, new)
    assert said in message
    number = int(re.search(r"a/file\.toml:(\d+): utilities\.gas", message).group(1))
    assert lines[number - 1].startswith(line)


def test_more_than_200_buried_lines_are_refused(site_text):
    with pytest.raises(ConfigError, match=r"utilities: .* at most 200 items"):
        load_site(site_text + "".join(GAS.replace("gas]", f"gas{i}]") for i in range(201)), "site.toml")


MACHINE_MISTAKES = [
    # old, new, the line that is shown, key, what is said
    (
        "width_m = 0.9",
        "width_m = 0.9\nwidth_mm = 900",
        "width_mm = 900",
        "cutting_edge.width_mm",
        "not a key that is known",
    ),
    ("noise = 0.002", "noise = -1", "noise = -1", "sensors.pot.noise", "greater than 0; found -1"),
    (
        "noise = 0.002",
        'noise = "0.002"',
        'noise = "0.002"',
        "sensors.pot.noise",
        "a valid number; found '0.002'",
    ),
    ("noise = 0.002", "noise = true", "noise = true", "sensors.pot.noise", "a valid number; found True"),
    ("noise = 0.002", "noise = nan", "noise = nan", "sensors.pot.noise", "a finite number"),
    (
        "width = 640",
        "width = 640.5",
        "width = 640.5",
        "cameras.front.intrinsics.width",
        "a valid integer; found 640.5",
    ),
    ("fx = 850.0\n", "", "[cameras.front.intrinsics]", "cameras.front.intrinsics.fx", "is missing"),
    (
        "sigma_mm = 0.5\n",
        "",
        "[markers.plate.mount]",
        "markers.plate.mount",
        "a pose is not exact by default",
    ),
    ('kind = "joint"', 'kind = "hinge"', "[bodies.bucket]", "bodies.bucket", "'moving', 'joint', 'static'"),
    (
        '[bodies.stick]\nkind = "moving"',
        '[bodies.stick]\nkind = "moving"\npose = 1',
        "pose = 1",
        "bodies.stick.pose",
        "not a key",
    ),
    (
        'body = "cab"',
        'body = "cabin"',
        'body = "cabin"',
        "cameras.front.body",
        "known are ['bucket', 'cab', 'stick', 'world']",
    ),
    (
        'joint = "bucket"',
        'joint = "stick"',
        'joint = "stick"',
        "sensors.pot.joint",
        "no body of kind 'joint'",
    ),
    (
        'family = "tag36h11"',
        'family = "tag36h12"',
        'family = "tag36h12"',
        "markers.plate.family",
        "should be one of tag36h11, tag25h9, tag16h5, tagStandard41h12, or OpenCV's DICT_4X4_50",
    ),
    (
        'family = "tag36h11"',
        'family = "DICT_APRILTAG_36h11"',
        'family = "DICT_APRILTAG_36h11"',
        "markers.plate.family",
        "should be written 'tag36h11'",
    ),
    (
        'family = "tag36h11"\ntags = [\n  { id = 1,',
        'family = "DICT_4X4_50"\ntags = [\n  { id = 50,',
        "[markers.plate]",
        "markers.plate",
        "DICT_4X4_50 has the ids 0 to 49, there is no tag 50 in it",
    ),
    (
        "id = 2, size_m = 0.2",
        "id = 1, size_m = 0.2",
        "[markers.plate]",
        "markers.plate",
        "stands twice on one marker: [1]",
    ),
    ("id = 2, size_m = 0.2", "id = 600, size_m = 0.2", "[markers.plate]", "markers.plate", "ids 0 to 586"),
    ("id = 2, size_m = 0.2", "id = 2", "tags = [", "markers.plate.tags.1.size_m", "is missing"),
    (
        "sigma = [0.2, 0.01]",
        "sigma = [0.2]",
        "[sensors.pot.curve]",
        "sensors.pot.curve",
        "one number per coefficient",
    ),
    ('output = "angle_deg"', 'output = "cylinder_m"', "[sensors.pot]", "sensors.pot", "needs a linkage"),
    (
        "sigma_mm = [1.0, 1.0, 2.0]",
        "sigma_mm = [1.0, 1.0]",
        "sigma_mm = [1.0, 1.0]",
        "cameras.front.mount.sigma_mm",
        " or ",
    ),
    (
        "sigma = [1, 1, 1, 1, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3]",
        "sigma = [1, 1]",
        "[cameras.front.intrinsics]",
        "cameras.front.intrinsics",
        "found 2",
    ),
    ('id = "EX-1"', 'id = "1"', 'id = "1"', "machine.id", "begin with a letter"),
    ('format = "gradetrace/machine/1"', 'format = "2"', 'format = "2"', "format", "gradetrace/machine/1"),
]


@pytest.mark.parametrize(
    "old, new, shown, key, said", MACHINE_MISTAKES, ids=[m[3] + " " + m[1][:18] for m in MACHINE_MISTAKES]
)
def test_mistake_in_machine_file_is_told_with_line_and_key(machine_text, old, new, shown, key, said):
    message, lines = complaint(load_machine, machine_text, old, new)
    number = int(re.match(r"a/file\.toml:(\d+): ", message)[1])
    assert (lines[number - 1].strip(), key in message, said in message) == (shown, True, True), message
    assert len(message.splitlines()) == 1, "one mistake, one line"


SITE_MISTAKES = [
    ('unit = "m"', 'unit = "ft"', 'unit = "ft"', "grid.unit", "'international_foot' or 'us_survey_foot'"),
    ('unit = "m"', 'unit = "yard"', 'unit = "yard"', "grid.unit", "found 'yard'"),
    (
        "origin = [1000, 2000, 50]",
        "origin = [1000, 2000.5, 50]",
        "origin = [1000, 2000.5, 50]",
        "grid.origin.1",
        "a valid integer",
    ),
    (
        "origin = [1000, 2000, 50]",
        "origin = [2000000, 1000, 50]",
        "[benchmarks.bm1]",
        "benchmarks.bm1",
        "km from grid.origin",
    ),
    (
        "corner = 2\n",
        "corner = 4\n",
        "corner = 4",
        "benchmarks.bm2.corners.2.corner",
        "less than or equal to 3; found 4",
    ),
    (
        "tag = 11\ncorner = 1",
        "tag = 12\ncorner = 1",
        "[benchmarks.bm2]",
        "benchmarks.bm2",
        "tags of this benchmark are [11]",
    ),
    ("sigma_corner_mm = 1.5\n", "", "[benchmarks.bm2]", "benchmarks.bm2", "sigma_corner_mm"),
    ("high_mm = 25", "high_mm = -25", "high_mm = -25", "tolerance.high_mm", "greater than or equal to 0"),
    ("id = 10, size_m = 0.3", "id = 11, size_m = 0.3", "", "", "stands on two benchmarks, bm1 and bm2"),
    ("[alignment]\npoints = [[1000, 2000], [1000, 2020]]\n", "", "", "", "stations need an alignment"),
    (
        'kind = "profile_csv"',
        'kind = "dwg"',
        'kind = "dwg"',
        "design.kind",
        "'profile_csv', 'landxml' or 'dxf'",
    ),
    (
        'kind = "profile_csv"',
        'kind = "dxf"',
        "[design]",
        "design",
        "a design that is a DXF drawing needs layer",
    ),
    (
        'kind = "profile_csv"',
        'kind = "profile_csv"\nlayer = "x"\nwidth = 1.0',
        "[design]",
        "design",
        "a design that is a CSV profile has no use for layer, width",
    ),
    (
        'kind = "profile_csv"',
        'kind = "landxml"\nprofile = "floor"\nsurface = "t"',
        "[design]",
        "design",
        "a design that is a LandXML profile needs alignment and width",
    ),
    (
        'kind = "profile_csv"',
        'kind = "landxml"\npipes = "storm"\nwidth = 1.0\nbedding = 0.1\nsurface = "t"',
        "[design]",
        "design",
        "a design that is a run of LandXML pipes has no use for surface",
    ),
    (
        'kind = "profile_csv"',
        'kind = "landxml"\nbedding = 0.1',
        "[design]",
        "design",
        "a design that is a LandXML surface has no use for bedding",
    ),
    (
        'kind = "profile_csv"',
        'kind = "landxml"\nalignment = "CL"\nprofile = "floor"\nwidth = 1.0',
        'profile = "floor"',
        "design.profile",
        "goes with an alignment of the design's own file, but [alignment] points are given",
    ),
    (
        'kind = "profile_csv"',
        'kind = "dxf"\nlayer = "t"\nalignment_layer = "axis"',
        'alignment_layer = "axis"',
        "design.alignment_layer",
        "goes with an alignment of the design's own file",
    ),
    (
        'kind = "profile_csv"',
        'kind = "dxf"\nlayer = "t"\nunit = "ft"',
        'unit = "ft"',
        "design.unit",
        "'m', 'international_foot' or 'us_survey_foot'",
    ),
    (
        'kind = "profile_csv"',
        'kind = "landxml"\npipes = "storm"\nwidth = 0\nbedding = 0.1',
        "width = 0",
        "design.width",
        "greater than 0",
    ),
    ("high_mm = 25", "high = 25", "high = 25", "tolerance.high", "not a key that is known"),
]


@pytest.mark.parametrize(
    "old, new, shown, key, said", SITE_MISTAKES, ids=[m[3] + " " + m[1][:18] for m in SITE_MISTAKES]
)
def test_mistake_in_site_file_is_told_with_line_and_key(site_text, old, new, shown, key, said):
    message, lines = complaint(load_site, site_text, old, new)
    relevant = next(text for text in message.splitlines() if said in text)
    number = re.match(r"a/file\.toml:(\d+): ", relevant)
    assert key in relevant
    assert (lines[int(number[1]) - 1] if number else "") == shown, message


def test_no_more_than_five_complaints_and_a_count_of_the_rest(site_text):
    text = site_text + "".join(f"unknown_{n} = {n}\n" for n in range(8))
    with pytest.raises(ConfigError) as caught:
        load_site(text, "site.toml")
    lines = str(caught.value).splitlines()
    assert len(lines) == 6
    assert lines[-1] == "site.toml: and 3 more"


@pytest.mark.parametrize(
    "text, line",
    [
        ("a = 1\nb = = 2\n", 2),
        ("a = 1\na = 2\n", 2),
        ("x = " + "9" * 5000, None),
        ("a = " + "[" * 5000, None),
    ],
    ids=["syntax", "twice", "huge number", "nested"],
)
def test_broken_toml_is_told_with_its_line(text, line):
    with pytest.raises(ConfigError, match="not valid TOML") as caught:
        load_machine(text, "m.toml")
    if line:
        assert str(caught.value).startswith(f"m.toml:{line}: ")


def test_byte_order_mark_and_windows_line_ends_are_read(machine_text):
    data = b"\xef\xbb\xbf" + machine_text.replace("\n", "\r\n").encode()
    assert load_machine(decode(data, "m"), "m") == load_machine(machine_text, "m")


def test_text_that_is_not_utf8_is_told_with_its_line():
    with pytest.raises(ConfigError, match=r"^m\.toml:2: is not UTF-8"):
        decode("a = 1\nb = 'Baustelle Süd'".encode("latin-1"), "m.toml")


def test_file_that_is_no_configuration_is_refused_by_size(tmp_path):
    path = tmp_path / "machine.toml"
    with path.open("wb") as stream:
        stream.truncate(5_000_000)
    with pytest.raises(ConfigError, match="larger than 4 MB"):
        read_file(path)


def test_line_of_counts_the_tables_of_an_array():
    text = "[[a.b]]\nx = 1\n[[a.b]]\nx = 2\n[a.b.c]\ny = 3\n[a]\nz = 1\n"
    assert line_of(text, ("a", "b", 0, "x")) == 2
    assert line_of(text, ("a", "b", 1, "x")) == 4
    assert line_of(text, ("a", "b", 1, "c", "y")) == 6
    assert line_of(text, ("a", "z")) == 8
    assert line_of(text, ("q",)) is None
