"""LandXML files that other programs wrote: what the files say of themselves is the oracle."""

import numpy as np
import pytest

from pipeline.surface.design import TinDesign, alignment_of
from pipeline.surface.landxml import read_landxml

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
