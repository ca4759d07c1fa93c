"""The ground before digging: one level or a surface, in the grid's unit, and refused where it belongs elsewhere."""

import numpy as np
import pytest

from pipeline.config.site import Tolerance
from pipeline.errors import ConfigError, SurfaceError
from pipeline.surface.alignment import polyline
from pipeline.surface.ground import read_ground
from tests.surface.test_design import FOOT, site

XML = """<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2">
<Units><Metric linearUnit="meter"/></Units><Surfaces>
<Surface name="EG"><Definition surfType="TIN"><Pnts>
<P id="1">4122990 511990 52</P><P id="2">4122990 512010 52</P>
<P id="3">4123030 512010 53</P><P id="4">4123030 511990 53</P>
</Pnts><Faces><F>1 2 3</F><F>1 3 4</F></Faces></Definition></Surface></Surfaces></LandXML>"""


def ground_of(more, path=None, **where):
    at = site("design.csv", "profile_csv", more=f"[ground]\n{more}", **where)
    line = polyline(np.array([[512_000.0, 4_123_000.0], [512_000.0, 4_123_020.0]]))
    return read_ground(path, at, line)


def test_one_level_is_in_the_unit_of_the_grid():
    ground = ground_of("elevation = 170.0\nsigma_mm = 30", unit="us_survey_foot", h=164)
    assert ground.elevation(np.array([3.0]), 0.5)[0] == pytest.approx(170 * FOOT)
    assert ground.sigma_m == pytest.approx(0.03)


def test_a_surface_is_read_where_station_and_offset_say(tmp_path):
    path = tmp_path / "ground.xml"
    path.write_text(XML)
    ground = ground_of('file = "ground.xml"\nsigma_mm = 20', path)
    # From northing 4,122,990 to 4,123,030 it rises by one metre; station 0 is at 4,123,000.
    np.testing.assert_allclose(ground.elevation(np.array([0.0, 10.0]), 0.0), [52.25, 52.5], atol=1e-9)
    assert np.isnan(ground.elevation(np.array([5.0]), 50.0)[0])


def test_without_a_ground_there_is_none():
    line = polyline(np.array([[512_000.0, 4_123_000.0], [512_000.0, 4_123_020.0]]))
    assert read_ground(None, site("design.csv", "profile_csv"), line) is None


def test_a_surface_that_is_not_there_is_told_with_its_own_key(tmp_path):
    path = tmp_path / "ground.xml"
    path.write_text(XML)
    with pytest.raises(SurfaceError, match=r"has no surface 'FG'; it holds 'EG'; mend ground\.surface"):
        ground_of('file = "ground.xml"\nsurface = "FG"\nsigma_mm = 20', path)


def test_a_level_of_another_datum_is_refused():
    with pytest.raises(SurfaceError, match="check the unit and the height datum"):
        ground_of("elevation = 4170.0\nsigma_mm = 30")


@pytest.mark.parametrize("text", ["sigma_mm = 5", 'elevation = 1.0\nfile = "g.xml"\nsigma_mm = 5'])
def test_a_ground_needs_one_source(text):
    with pytest.raises(ConfigError, match="give either elevation, or file"):
        ground_of(text)


def test_sides_are_judged_with_both_limits_or_not_at_all():
    with pytest.raises(ValueError, match="give both or neither"):
        Tolerance(high_mm=25, low_mm=25, wide_mm=50)
    assert Tolerance(high_mm=25, low_mm=25, wide_mm=50, narrow_mm=0).narrow_mm == 0
