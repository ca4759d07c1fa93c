"""Typing errors are named by touch, coordinate and size; honest touches are left alone."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibration import bucket
from pipeline.calibration.agreement import agreed, kept_of
from pipeline.calibration.snooping import suspects
from pipeline.errors import CalibrationError
from tests.calibration.rigs import drawn


def mistyped(d, which, shift):
    """The rig with an error in the coordinates of one touch, or of all."""
    shift = np.asarray(shift, float)
    touches = [
        replace(t, p_world=t.p_world + shift) if which in (i, "all") else t for i, t in enumerate(d.touches)
    ]
    return replace_touches(d, touches)


def replace_touches(d, touches):
    d.touches = touches
    return d


def named(d):
    return agreed(d.rig, d.stands, d.touches, d.points)


@pytest.mark.parametrize(
    "which, shift, axis",
    [
        (3, (0.1, 0, 0), "easting"),
        (2, (0, 0, 0.1), "elevation"),
        (5, (0, 1.0, 0), "northing"),
        (7, (0, 10.0, 0), "northing"),
    ],
)
def test_the_touch_the_coordinate_and_the_size_are_named(which, shift, axis):
    with pytest.raises(CalibrationError, match=f"the {axis} of touch 'touch {which}' does not go") as caught:
        named(mistyped(drawn(5), which, shift))
    size = float(str(caught.value).split("others: ")[1].split(" mm")[0])
    assert size == pytest.approx(1000 * sum(shift), abs=15)  # the sigma of one such coordinate is some 3 mm


def test_a_mistyped_known_point_is_named_as_such():
    with pytest.raises(
        CalibrationError, match=r"the northing of known point 'TP1' does not go.*[45][0-9] mm"
    ):
        named(mistyped(drawn(5), "all", (0, 0.05, 0)))


def test_the_test_statistic_is_standard_normal_without_errors():
    w = []
    for seed in range(2000, 2040):
        d = drawn(seed, "angle_deg")
        found = bucket.robust(d.rig, d.stands, d.touches, list(d.points.values()))
        tested = suspects(found, 1)
        assert len(tested) == 27  # 8 touches and a point, three coordinates each
        assert tested[0].critical == pytest.approx(4.13, abs=0.02)  # two-sided 0.1 % over 27
        assert not tested[0].wrong
        w += [s.w for s in tested]
    assert np.std(w) == pytest.approx(1.0, abs=0.08)
    assert abs(np.mean(w)) < 0.1


def test_the_size_of_an_error_is_its_shift():
    """A linear problem answers a shift with the same shift: the difference of two sizes is exact to second order."""
    d = drawn(1007, "angle_deg")
    points = list(d.points.values())
    before = {(s.touch, s.axis): s for s in suspects(bucket.adjust(d.rig, d.stands, d.touches, points), 1)}
    mistyped(d, 4, (0, 0, 0.004))
    after = {(s.touch, s.axis): s for s in suspects(bucket.adjust(d.rig, d.stands, d.touches, points), 1)}
    assert after[4, 2].size_m - before[4, 2].size_m == pytest.approx(0.004, rel=0.02)
    assert after[4, 2].w - before[4, 2].w == pytest.approx(0.004 / before[4, 2].sigma_m, rel=0.02)


def test_too_few_touches_are_refused_with_what_was_left_out():
    d = drawn(1, count=4)
    with pytest.raises(
        CalibrationError, match=r"touched at 4 bucket angles, at least 5 are needed \(2 shot of the floor"
    ):
        agreed(d.rig, d.stands, d.touches, d.points, {"shot of the floor": 2})


def test_touches_at_like_angles_are_refused():
    d = drawn(1, span_deg=(-60.0, -30.0))
    with pytest.raises(CalibrationError, match="span 30 deg, at least 40 are needed"):
        named(d)


def test_bars_that_cannot_be_are_refused_in_words():
    d = drawn(1)
    long = d.rig.bars.copy()
    long[5] = 3.0
    d.rig = replace(d.rig, bars=long)
    with pytest.raises(CalibrationError, match="no curve brings the cutting edge"):
        named(d)


def test_a_curve_that_turns_back_is_refused():
    """Readings that do not follow the angle: a potentiometer that slipped over half of the stroke."""
    d = drawn(1, "angle_deg", scale=0.0)
    d.rig = replace(d.rig, coefficients=3)
    middle = 0.5 * (d.stands[0].raw + d.stands[-1].raw)
    folded = [replace(s, raw=abs(s.raw - middle)) for s in d.stands]
    angles = np.deg2rad(np.linspace(-150, -8, 8))
    # A parabola in the reading whose turn lies inside the readings used.
    readings = 10 * np.sqrt(angles - angles[0] + 1e-3)
    readings[0] = -readings[0] - 3.0
    d.stands = [replace(s, raw=float(r), raw_sigma=1e-6) for s, r in zip(folded, readings)]
    found = bucket.adjust(d.rig, d.stands, d.touches, list(d.points.values()))
    with pytest.raises(CalibrationError, match="turns back within the stroke"):
        kept_of(found, "pot")


def test_a_stand_that_hovered_is_no_touch_and_one_that_was_noted_is_an_error():
    d = drawn(2001)
    touches = [replace(t, by_time=False) for t in d.touches]
    touches[2] = replace(touches[2], p_world=touches[2].p_world + [0, 0, 0.35])
    left_out = {}
    found = agreed(d.rig, d.stands, touches, d.points, left_out)
    assert [t.name for t in found.touches] == [t.name for i, t in enumerate(d.touches) if i != 2]
    assert len(found.stands) == 7 and left_out == {"stand near the point without touching it": 1}
    touches[2] = replace(touches[2], by_time=True)
    with pytest.raises(CalibrationError, match="the elevation of touch 'touch 2'"):
        agreed(d.rig, d.stands, touches, d.points)
    near = replace(
        d.touches[2], by_time=False, p_world=d.touches[2].p_world + [0, 0, 0.02]
    )  # slipped, not hovered
    with pytest.raises(CalibrationError, match="does not go with the others"):
        agreed(d.rig, d.stands, [*d.touches[:2], near, *d.touches[3:]], d.points)
