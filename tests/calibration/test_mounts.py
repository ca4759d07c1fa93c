"""Axis of the bucket and mount of a board on it, told from drawn corners of a waving arm; and what cannot be told."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.calibration.axes import TOLD
from pipeline.calibration.mounts import ToldPose, calibrate_mounts
from pipeline.errors import CalibrationError
from pipeline.geometry import se3
from pipeline.report.mounts_sheet import edge_sigma_m, mounts_sheet
from pipeline.report.sheet import Demand, render_sheet
from pipeline.synthetic.calibration_sites import BUCKET_BOARD
from tests.calibration.waving import seen, yard

pytestmark = pytest.mark.usefixtures("white_corners")
AXIS, BOARD, STICK = "bodies.bucket.axis", f"markers.{BUCKET_BOARD.name}.mount", "markers.stick-board.mount"
WAVED_S = 26.0


@pytest.fixture(scope="module")
def rig():
    drawn, machine, site = yard(5, bucket_board=True)
    return drawn, machine, site, seen(drawn, machine, site, np.random.default_rng(5), WAVED_S)


def told(found, key):
    return next(t for t in found.told if t.key == key)


def test_axis_and_board_lie_within_their_covariances(rig):
    drawn, machine, site, detections = rig
    found = calibrate_mounts(machine, site, [AXIS], detections)
    axis, board = told(found, AXIS), told(found, BOARD)
    at = list(TOLD)
    e = se3.local(drawn.truth.axis, axis.T)[at]
    P = axis.covariance[np.ix_(at, at)]
    # The board's own frame turns and shifts with the axis' conventions: it is compared by where it lies about the axis.
    A = se3.Ad(board.T)
    off = se3.log(board.T @ se3.inverse(drawn.bucket_marker))[at]
    Q = (A @ board.covariance @ A.T)[np.ix_(at, at)]
    print(f"axis {1e3 * np.hypot(*e[:2]):.2f} mm {np.rad2deg(np.hypot(*e[2:])):.3f} deg")
    # 99.9 % of a chi-square of four.
    assert e @ np.linalg.solve(P, e) < 18.5
    assert off @ np.linalg.solve(Q, off) < 18.5
    assert np.sqrt(np.diagonal(P))[:2].max() < 0.002
    assert np.rad2deg(np.sqrt(np.diagonal(P))[2:].max()) < 0.06


def test_what_no_motion_tells_of_an_axis_keeps_the_files_own_sigma(rig):
    """Where the frame lies along the line and where its angle is zero: with a board whose mount is told along."""
    _, machine, site, detections = rig
    found = told(calibrate_mounts(machine, site, [AXIS], detections), AXIS)
    file = np.diagonal(machine.bodies["bucket"].axis.covariance_xi())
    kept = [i for i in range(6) if i not in TOLD]
    assert np.diagonal(found.covariance)[kept] == pytest.approx(file[kept], rel=1e-6)
    assert found.covariance[np.ix_(kept, list(TOLD))] == pytest.approx(0, abs=1e-9)


def test_a_turn_counts_at_the_edge_with_its_lever():
    sigma = np.deg2rad(0.02)
    for key, turned, expected_m in (
        ("cameras.bench.mount", 4, 3.0 * sigma),
        ("markers.board.mount", 5, 3.0 * sigma),
        ("bodies.bucket.axis", 5, 0.0),  # a convention
        ("bodies.bucket.axis", 4, 3.0 * sigma),
    ):
        covariance = np.zeros((6, 6))
        covariance[turned, turned] = sigma**2
        assert edge_sigma_m(ToldPose(key, np.eye(4), covariance, None), 3.0) == pytest.approx(expected_m)


@pytest.mark.slow
def test_errors_of_axes_are_as_large_as_their_covariances_say():
    at, squares = list(TOLD), []
    for seed in range(10):
        drawn, machine, site = yard(300 + seed, bucket_board=True)
        detections = seen(drawn, machine, site, np.random.default_rng(seed), 16.0)
        axis = told(calibrate_mounts(machine, site, [AXIS], detections), AXIS)
        e = se3.local(drawn.truth.axis, axis.T)[at]
        squares.append(e @ np.linalg.solve(axis.covariance[np.ix_(at, at)], e) / 4)
    ratio = np.sqrt(np.mean(squares))
    print(f"errors over their sigma {ratio:.2f}, 10 machines")
    # 99 % of the mean of 40 squares lies within 0.72 and 1.29 of one sigma.
    assert 0.72 < ratio < 1.29


def test_the_sheet_counts_what_the_file_knew_before(rig):
    _, machine, site, detections = rig
    found = calibrate_mounts(machine, site, [AXIS], detections)
    _, said = render_sheet(mounts_sheet(found, Demand(0.03, 2.0, 3.0), "ex-14", {}))
    assert said["state"] == "good" and AXIS in said["sentence"]
    tables = [t["table"]["rows"] for part in said["parts"] for t in part["tables"]]
    assert {row["key"] for row in tables[0]} == {AXIS, BOARD}
    (turned,) = tables[1]
    assert turned["key"] == AXIS and turned["turn"] > 60


def test_a_key_that_is_none_is_named(rig):
    _, machine, site, detections = rig
    for key, said in (
        ("bodies.bucket", "cannot be freed"),
        ("bodies.dipper.axis", "no such one in machine.toml; known are cab, stick, bucket"),
        ("bodies.stick.axis", "is no joint"),
    ):
        with pytest.raises(CalibrationError, match=said):
            calibrate_mounts(machine, site, [key], detections)


def test_an_axis_and_the_only_marker_on_its_parent_are_not_both_told(rig):
    _, machine, site, detections = rig
    with pytest.raises(CalibrationError, match="cannot both be told"):
        calibrate_mounts(machine, site, [AXIS, STICK], detections)


def test_an_arm_that_only_stood_tells_no_axis(rig):
    drawn, machine, site, _ = rig
    standing = seen(drawn, machine, site, np.random.default_rng(1), 5.5)
    with pytest.raises(CalibrationError, match="turn"):
        calibrate_mounts(machine, site, [AXIS], standing)


def test_a_joint_without_marker_and_pin_asks_for_one(rig):
    _, machine, site, detections = rig
    bare = machine.model_copy(
        update={"markers": {n: m for n, m in machine.markers.items() if n != BUCKET_BOARD.name}}
    )
    with pytest.raises(CalibrationError, match="put one on it"):
        calibrate_mounts(bare, site, [AXIS], detections)
