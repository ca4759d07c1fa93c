"""Vertical curves against closed forms, finite differences and the circle itself."""

import numpy as np
import pytest

from pipeline.errors import SurfaceError
from pipeline.surface.landxml import XmlProfile, XmlVertex
from pipeline.surface.long_profile import long_profile

FOOT = 0.3048


def pvi(station, elevation):
    return XmlVertex("PVI", station, elevation)


def parabola(station, elevation, length_in, length_out=None, kind="ParaCurve"):
    return XmlVertex(kind, station, elevation, length_in, length_in if length_out is None else length_out)


def circle(station, elevation, radius, length=None):
    return XmlVertex("CircCurve", station, elevation, radius=radius, length=length)


def profile(*vertices, scale=1.0, **more):
    return long_profile(XmlProfile("p", "ProfAlign", vertices, **more), "d.xml", scale)


def test_a_parabola_has_the_closed_form_of_the_textbooks():
    # -2 % to +3 % over 100 m at station 200, elevation 48: it begins at 150 with 49, low point 40 m on.
    line = profile(pvi(0, 52), parabola(200, 48, 50), pvi(400, 54))
    x = np.linspace(0, 100, 201)
    assert np.allclose(line.elevation(150 + x), 49 - 0.02 * x + 0.05 / 200 * x**2, rtol=0, atol=1e-12)
    assert line.elevation(200.0) == pytest.approx(48 + 0.05 * 100 / 8)  # the external distance
    assert line.elevation(190.0) == pytest.approx(48.6)
    assert line.slope(190.0) == pytest.approx(0.0, abs=1e-15)
    assert line.elevation([0, 100, 300, 400]).tolist() == pytest.approx([52, 50, 51, 54])


def test_an_unsymmetrical_parabola_meets_under_its_point_with_one_tangent():
    line = profile(pvi(0, 52), parabola(200, 48, 30, 90, "UnsymParaCurve"), pvi(400, 54))
    rise = 30 * 90 * 0.05 / (2 * 120)
    assert line.elevation(200.0) == pytest.approx(48 + rise)
    x = np.linspace(0, 30, 50)
    assert np.allclose(line.elevation(170 + x), 48.6 - 0.02 * x + rise * (x / 30) ** 2, rtol=0, atol=1e-12)
    x = np.linspace(0, 90, 50)
    assert np.allclose(line.elevation(290 - x), 50.7 - 0.03 * x + rise * (x / 90) ** 2, rtol=0, atol=1e-12)


def test_a_circle_touches_both_gradients_and_all_its_points_are_a_radius_from_its_centre():
    for sign in (1, -1):
        line = profile(
            pvi(0, 50), circle(200, 50 - sign * 16, -700.0), pvi(400, 50)
        )  # the sign is the gradients'
        incline = np.arctan(16 / 200)
        tangent = 700 * np.tan(incline)
        first = np.array([200, 50 - sign * 16]) + tangent * np.array(
            [-np.cos(incline), sign * np.sin(incline)]
        )
        center = np.array([200, first[1] + sign * 700 * np.cos(incline)])
        station = np.linspace(first[0], 400 - first[0], 101)
        away = np.hypot(station - center[0], line.elevation(station) - center[1])
        assert np.allclose(away, 700, rtol=0, atol=1e-9)
        assert line.slope(first[0] - 1e-9) == pytest.approx(-sign * 0.08)


def test_levels_and_gradients_are_continuous_and_gradients_are_the_differences_of_levels():
    line = profile(
        pvi(10, 5),
        parabola(60, 4, 20),
        parabola(130, 7, 15, 30, "UnsymParaCurve"),
        circle(260, 3, 400.0),
        parabola(330, 3, 0),
        pvi(400, 4),
    )
    station = np.linspace(10, 400, 390_001)
    level, slope = line.elevation(station), line.slope(station)
    step = station[1] - station[0]
    jumps = np.flatnonzero(np.abs(np.diff(slope)) > 1e-4)
    assert station[jumps] == pytest.approx([330], abs=0.01)  # only the corner without a curve
    assert np.abs(np.diff(level)).max() < 0.1 * step
    middle = np.abs(np.diff(level) / step - 0.5 * (slope[1:] + slope[:-1]))
    assert np.delete(middle, jumps).max() < 1e-6


def test_rows_are_so_close_that_straight_lines_between_them_are_right_to_two_micrometres():
    line = profile(pvi(0, 52), parabola(200, 48, 50), circle(330, 52, 150.0), pvi(400, 49))
    station, level = line.rows()
    fine = np.linspace(0, 400, 300_001)
    assert np.abs(np.interp(fine, station, level) - line.elevation(fine)).max() < 2e-6
    assert np.all(np.diff(station) > 0)
    assert len(station) < 50_000


def test_feet_become_metres_and_outside_there_is_nothing():
    feet = profile(pvi(0, 52), parabola(200, 48, 50), pvi(400, 54), scale=FOOT)
    metres = profile(pvi(0, 52), parabola(200, 48, 50), pvi(400, 54))
    assert feet.elevation(190 * FOOT) == pytest.approx(FOOT * 48.6)
    assert feet.slope(160 * FOOT) == pytest.approx(metres.slope(160.0))
    assert np.isnan(feet.elevation([-0.01, 400 * FOOT + 0.01])).all()


@pytest.mark.parametrize(
    "vertices, sentence",
    [
        ((pvi(0, 5),), "has one point only"),
        ((pvi(0, 5), pvi(0, 6), pvi(9, 5)), "stations must grow .* 0 follows 0"),
        ((pvi(0, 5), parabola(40, 4, 30), parabola(90, 6, 25), pvi(200, 5)),
         r"the curves at stations 40 and 90 overlap by 5\.000"),
        ((parabola(0, 5, 10), pvi(50, 6)), "its first point is a ParaCurve"),
        ((pvi(0, 5), circle(50, 6, 100.0)), "its last point is a CircCurve"),
        ((pvi(0, 5), circle(50, 6, 400.0, 9.0), pvi(100, 5)), r"station 50 is stated as 9\.000 long, .* 15\.998"),
        ((pvi(0, 5), parabola(50, 6, -1), pvi(100, 5)), "negative length"),
    ],
)  # fmt: skip
def test_profiles_that_make_no_sense_are_refused(vertices, sentence):
    with pytest.raises(SurfaceError, match=sentence):
        profile(*vertices)


def test_a_wrong_number_does_not_ask_for_all_memory():
    far = profile(pvi(0, 5), parabola(2e9, 5, 1e9), pvi(4e9, 1e9))
    with pytest.raises(SurfaceError, match="a profile of 4000000 km is too long"):
        far.rows()


def test_a_profile_with_gaps_is_refused():
    with pytest.raises(SurfaceError, match="has 2 separate stretches"):
        profile(pvi(0, 5), pvi(9, 5), gaps=1)
