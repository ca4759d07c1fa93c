"""LandXML files that other programs wrote: what the files say of themselves is the oracle."""

import numpy as np
import pytest

from pipeline.errors import SurfaceError
from pipeline.surface.design import TinDesign
from pipeline.surface.landxml import profile_named, read_landxml
from pipeline.surface.long_profile import long_profile
from pipeline.surface.pipe_run import run_of
from pipeline.surface.plan_geometry import alignment_of

pytestmark = pytest.mark.real

FOOT = 0.3048


def areas(surface):
    corners = surface.points[surface.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.abs(normal[:, 2]).sum() / 2, np.linalg.norm(normal, axis=1).sum() / 2


@pytest.mark.parametrize("name", ["EG", "FG"])
def test_areas_and_elevations_are_those_the_file_states(real_data, name):
    file = read_landxml(real_data / "landxml" / "subdivision" / "subdivision.xml")
    assert file.unit == "international_foot"
    surface = file.surface(name)
    plan, slope = areas(surface)
    assert plan == pytest.approx(surface.stated["area2DSurf"], rel=1e-6)
    assert slope == pytest.approx(surface.stated["area3DSurf"], rel=1e-6)
    assert surface.points[:, 2].min() == pytest.approx(surface.stated["elevMin"], rel=1e-6)
    assert surface.points[:, 2].max() == pytest.approx(surface.stated["elevMax"], rel=1e-6)


def test_lengths_of_alignments_are_those_the_files_state(real_data):
    paths = [
        *(real_data / "landxml" / "inframodel_m3").glob("*.tg.xml"),
        real_data / "landxml" / "subdivision/subdivision.xml",
    ]
    count = 0
    for path in paths:
        for stated in read_landxml(path).alignments:
            alignment = alignment_of(stated, path.name, 1.0)
            assert alignment.length == pytest.approx(stated.stated_length, abs=1e-4)
            count += 1
    assert count == 9  # three roads in metres, six in feet, lines and arcs


def test_profiles_of_the_subdivision_are_read_whole_and_go_through_their_points(real_data):
    file = read_landxml(real_data / "landxml" / "subdivision" / "subdivision.xml")
    followed = 0
    for road in file.alignments:
        ground, grade = (profile_named(road, name, file.source) for name in ("eg", "FGCenter"))
        assert (ground.kind, grade.kind) == ("ProfSurf", "ProfAlign")
        for profile in (ground, grade):
            assert profile.vertices[0].station == 0
            assert profile.vertices[-1].station == pytest.approx(road.stated_length, abs=1e-2)
            if any(v.kind != "PVI" for v in profile.vertices):
                continue
            line = long_profile(profile, file.source, FOOT)
            for v in profile.vertices:
                assert line.elevation(v.station * FOOT) == pytest.approx(v.elevation * FOOT, abs=1e-9)
            followed += 1
    assert followed == 11
    loop = profile_named(file.alignment("loop"), "FGCenter", file.source)
    assert [v.kind for v in loop.vertices].count("ParaCurve") == 11
    assert {2 * v.length_in for v in loop.vertices[1:-1]} == {75, 100, 125, 150, 200, 250, 350}
    # As drawn, its first two curves would have to be at two gradients at once.
    with pytest.raises(SurfaceError, match=r"stations 478\.59 and 645\.423 overlap by 8\.167"):
        long_profile(loop, file.source, FOOT)


def test_vertical_circles_of_the_roads_have_the_length_the_files_state(real_data):
    curves = 0
    for name in ("M3", "Y10", "Y11"):
        road = read_landxml(real_data / "landxml" / "inframodel_m3" / f"{name}_RS-CL.tg.xml").alignment(None)
        (profile,) = road.profiles
        line = long_profile(profile, name, 1.0)
        stated = [v.length for v in profile.vertices if v.kind == "CircCurve"]
        for k, length in zip(np.flatnonzero(np.isfinite(line.radius)), stated, strict=True):
            station = np.linspace(line.station[k], line.station[k + 1], 20_001)
            walked = np.hypot(np.diff(station), np.diff(line.elevation(station))).sum()
            assert walked == pytest.approx(length, abs=2e-6)
            curves += 1
        corners = [line.station[0], *line.station[1:-1], line.station[-1]]
        slope = [(line.slope(at - 1e-7), line.slope(at + 1e-7)) for at in corners[1:-1]]
        kinks = sum(abs(b - a) > 1e-6 for a, b in slope)
        assert kinks == sum(v.kind == "PVI" for v in profile.vertices) - 2
    assert curves == 13


def test_pipes_of_the_subdivision_hang_together_at_the_inverts_of_their_structures(real_data):
    file = read_landxml(real_data / "landxml" / "subdivision" / "subdivision.xml")
    assert [pipe.name for pipe in file.pipes] == [f"Pipe{k}" for k in range(1, 6)]
    assert file.pipes[0].start == (843.25113901, 1217.64087219, 253.191490)
    assert file.pipes[4].end == (-247.85948505, 611.2517392, 260.735336)
    for above, below in zip(file.pipes, file.pipes[1:], strict=False):
        assert above.end[:2] == below.start[:2]
        assert above.end[2] - below.start[2] == pytest.approx(0.1)  # the drop in each manhole
    assert {pipe.diameter for pipe in file.pipes} == {None}  # 8, but nothing says of what
    run = run_of(file.pipes, "loop-south", (), FOOT, file.source)
    line = run.line(0.0)
    station, invert = run.rows(line, 0.5, "x")
    structures = np.interp(line.station, station, invert) / FOOT
    assert structures == pytest.approx(
        [253.19149, 250.522322, 248.405639, 249.6944, 255.268699, 260.735336], abs=1e-3
    )


def test_every_surface_is_read_with_easting_and_northing_in_place(real_data):
    surfaces = 0
    for path in (real_data / "landxml" / "inframodel_m3").glob("*.mm.xml"):
        file = read_landxml(path)
        assert file.unit == "m"
        for surface in file.surfaces:
            low, high = surface.points.min(axis=0), surface.points.max(axis=0)
            assert np.all(low > [21_530_000, 6_782_000, 10]) and np.all(high < [21_532_000, 6_784_000, 25])
            assert areas(surface)[0] > 100
            surfaces += 1
    assert surfaces == 7


def test_an_excavation_surface_has_an_elevation_along_its_road(real_data):
    base = real_data / "landxml" / "inframodel_m3"
    road = alignment_of(read_landxml(base / "Y10_RS-CL.tg.xml").alignment(None), "Y10", 1.0)
    surface = read_landxml(base / "Y10_Lowest_Comb_rev2_201200.mm.xml").surface(None)
    design = TinDesign(surface.name, surface.points, surface.faces, road)
    station = np.linspace(10, 30, 41)
    level = design.floor_level(station)
    assert np.isfinite(level).all()
    # The road's own profile runs some 18 m high; the excavation lies under it, by the thickness of the courses.
    assert np.all((level > 16.2) & (level < 18.0))
    assert design.is_floor(20.0, np.array([0.0])).all()
