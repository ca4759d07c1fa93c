"""Shots of a joint's pin against an axis that was drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibration import pins
from pipeline.calibration.mounts import calibrate_mounts
from pipeline.calibration.pins import PinShot
from pipeline.errors import CalibrationError
from pipeline.geometry import se3
from pipeline.synthetic.calibration_sites import STAND_S
from tests.calibration.waving import seen, yard

pytestmark = pytest.mark.usefixtures("white_corners")
KEY = "bodies.bucket.axis"
TOLD = [0, 1, 3, 4]


def shots(drawn, rng, sigma_m=1e-3, at_s=3.0, half_m=0.35):
    t = np.full(2, at_s)
    T = drawn.motion.poses(t).stick(drawn.spec) @ drawn.truth.axis
    p = se3.transform(T, np.array([[0, 0, -half_m], [0, 0, half_m]]))
    p = p + rng.normal(size=p.shape) * sigma_m
    time_ns = drawn.spec.start_utc_ns + round(at_s * 1e9)
    return [PinShot(f"bucket-{n}", "bucket", time_ns, q, sigma_m) for n, q in zip("LR", p, strict=True)]


def error(drawn, pose):
    """Of the line that the axis is, (4,): x, y and the turns about them."""
    xi = se3.local(drawn.truth.axis, pose.T)
    return xi[TOLD]


@pytest.fixture(scope="module")
def rig():
    drawn, machine, site = yard(3)
    rng = np.random.default_rng(3)
    return drawn, machine, site, seen(drawn, machine, site, rng), shots(drawn, rng)


def test_two_ends_of_a_pin_tell_its_axis(rig):
    drawn, machine, site, detections, pins = rig
    found = calibrate_mounts(machine, site, (), detections, pins)
    (pose,) = found.told
    e, P = error(drawn, pose), pose.covariance[np.ix_(TOLD, TOLD)]
    print(f"error {1e3 * np.hypot(*e[:2]):.2f} mm, {np.rad2deg(np.hypot(*e[2:])):.3f} deg")
    assert pose.key == KEY
    assert e @ np.linalg.solve(P, e) < 18.5  # 99.9 % of a chi-square of four
    assert np.sqrt(P[0, 0]) < 0.003
    assert (
        np.sqrt(P[3, 3]) > 1e-3
    )  # two shots of 1 mm, 0.7 m apart, tell a direction to no better than 0.1 deg


@pytest.mark.slow
def test_errors_of_axes_from_pins_are_as_large_as_their_covariances_say():
    squares = []
    for seed in range(16):
        drawn, machine, site = yard(200 + seed)
        rng = np.random.default_rng(seed)
        (pose,) = calibrate_mounts(
            machine, site, (), seen(drawn, machine, site, rng, 6.0), shots(drawn, rng)
        ).told
        e = error(drawn, pose)
        squares.append(e @ np.linalg.solve(pose.covariance[np.ix_(TOLD, TOLD)], e) / 4)
    ratio = np.sqrt(np.mean(squares))
    print(f"errors over their sigma {ratio:.2f}, 16 machines")
    # 64 squares: 99 % of their mean lies within 0.60 and 1.51.
    assert 0.77 < ratio < 1.23


def test_derivatives_of_a_shot_off_its_axis_are_those_by_differences(rig):
    _, machine, site, detections, pins_ = rig
    whole = calibrate_mounts(machine, site, (), detections, pins_).whole
    residual, z = pins._off_axis(whole, "bucket"), whole.optimum.values.z
    T, p, h = se3.exp(np.array([0.3, -2.0, 1.0, 0.4, 0.2, -0.5])), np.array([1.0, 0.7, -0.3]), 1e-6
    _, by_pose, by_point, by_z = residual(T, p, z)

    def differences(of, n):
        return np.array([(of(h * e)[0] - of(-h * e)[0]) / (2 * h) for e in np.eye(n)]).T

    assert by_pose == pytest.approx(differences(lambda d: residual(T @ se3.exp(d), p, z), 6), abs=1e-6)
    assert by_point == pytest.approx(differences(lambda d: residual(T, p + d, z), 3), abs=1e-6)
    assert by_z == pytest.approx(differences(lambda d: residual(T, p, z + d), len(z)), abs=1e-6)


def test_two_ends_a_hand_apart_leave_the_direction_open_and_are_refused(rig):
    drawn, machine, site, detections, _ = rig
    near = shots(drawn, np.random.default_rng(4), half_m=0.05)
    with pytest.raises(CalibrationError, match=r"within 0\.25 m and leave its direction open"):
        calibrate_mounts(machine, site, (), detections, near)


def test_one_end_leaves_the_direction_open_and_is_refused(rig):
    _, machine, site, detections, pins = rig
    with pytest.raises(CalibrationError, match="both of its ends"):
        calibrate_mounts(machine, site, (), detections, pins[:1])


@pytest.mark.parametrize(("off", "said"), [(0.0, None), (0.1, r"bucket-3.*9\d mm|bucket-3.*10\d mm")])
def test_a_third_shot_with_a_typing_error_is_named(rig, off, said):
    drawn, machine, site, detections, pins = rig
    more = shots(drawn, np.random.default_rng(8), half_m=0.25)
    third = replace(more[0], name="bucket-3", p_world=more[0].p_world + [0.0, 0.0, off])
    if said is None:
        assert len(calibrate_mounts(machine, site, (), detections, [*pins, more[1], third]).pins) == 4
        return
    with pytest.raises(CalibrationError, match=said):
        calibrate_mounts(machine, site, (), detections, [*pins, more[1], third])


@pytest.mark.parametrize("moved", [([0.5, 0.0, 0.0], [0.5, 0.0, 0.0]), ([0.0, 0.0, 0.0], [0.0, 0.0, 0.1])])
def test_two_ends_that_only_the_file_contradicts_are_refused(rig, moved):
    """Shot in another grid, or one of the two with a typing error: neither end shows it by the other."""
    _, machine, site, detections, pins = rig
    wrong = [replace(pin, p_world=pin.p_world + d) for pin, d in zip(pins, moved, strict=True)]
    with pytest.raises(
        CalibrationError, match=r"shots of its pin bodies\.bucket\.axis is \d+ mm and [\d.]+ deg"
    ):
        calibrate_mounts(machine, site, (), detections, wrong)


def test_a_pin_shot_while_the_arm_moves_is_refused(rig):
    drawn, machine, site, detections, _ = rig
    with pytest.raises(CalibrationError, match="moved by"):
        calibrate_mounts(
            machine, site, (), detections, shots(drawn, np.random.default_rng(1), at_s=STAND_S + 0.5)
        )


def test_pins_do_without_the_marker_that_the_file_has_and_no_camera_saw(rig):
    drawn, machine, site, detections, pins = rig
    stick = next(iter(machine.markers.values()))
    tag = stick.tags[0].model_copy(update={"id": 99})
    unseen = stick.model_copy(update={"body": "bucket", "mount": None, "tags": (tag,)})
    more = machine.model_copy(update={"markers": {**machine.markers, "bucket-board": unseen}})
    found = calibrate_mounts(more, site, (KEY,), detections, pins)
    e = error(drawn, next(t for t in found.told if t.key == KEY))
    assert np.hypot(*e[:2]) < 0.01


def test_a_shot_that_few_pictures_surround_is_refused(rig):
    drawn, machine, site, detections, _ = rig
    few = {}
    for name, rows in detections.items():
        at_s = (np.asarray(rows["time_ns"]) - drawn.spec.start_utc_ns) / 1e9
        few[name] = {key: column[(at_s > 2.0) & (at_s < 3.1)] for key, column in rows.items()}
    with pytest.raises(CalibrationError, match="too few to tell that it stood"):
        calibrate_mounts(machine, site, (), few, shots(drawn, np.random.default_rng(1)))


def test_a_shot_of_another_day_is_refused(rig):
    _, machine, site, detections, pins = rig
    late = [replace(shot, time_ns=shot.time_ns + 86_400_000_000_000) for shot in pins]
    with pytest.raises(CalibrationError, match="no picture of the log"):
        calibrate_mounts(machine, site, (), detections, late)
