"""Shots of a joint's pin against an axis that was drawn."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.calibration import mounts as told_mounts
from pipeline.calibration.mounts import calibrate_mounts
from pipeline.calibration.pins import PinShot
from pipeline.config import load_machine, load_site
from pipeline.errors import CalibrationError
from pipeline.estimation.repeated import WHITE
from pipeline.geometry import se3
from pipeline.network import network_of
from pipeline.synthetic import calibration_log, calibration_sites
from pipeline.synthetic.calibration_sites import STAND_S

SIGMA_PX = 0.05
KEY = "bodies.bucket.axis"
TOLD = [0, 1, 3, 4]


@pytest.fixture(autouse=True)
def drawn_corners_are_white(monkeypatch):
    plain = told_mounts.adjusted
    monkeypatch.setattr(told_mounts, "adjusted", lambda *a, **k: plain(*a, **k, repeated=WHITE))


def yard(seed):
    drawn = calibration_sites.calibration_site(calibration_sites.MOUNTS, seed)
    text = calibration_log.machine_text(drawn.spec, drawn.files, drawn.sigma, bucket_board=False)
    return drawn, load_machine(text, "machine.toml"), load_site(calibration_log.site_toml(drawn), "site.toml")


def seen(drawn, machine, site, rng, until_s=8.0):
    """Detections of benchmarks and the stick's marker by OpenCV's projection: standing, and two seconds of waving."""
    network = network_of(machine, site)
    out = {}
    for camera, delay in (("bench", 0.0), ("arm", 0.13)):
        rows = {k: [] for k in ("time_ns", "family", "tag_id", "uv")}
        lens = drawn.truth.intrinsics[camera]
        K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
        for t in np.arange(0.1, until_s, 0.4) + delay:
            poses = drawn.motion.poses(np.array([t]))
            T_camera_world = np.linalg.inv(poses.T_world_cab[0] @ drawn.truth.cameras[camera])
            where = dict(drawn.truth.benchmarks)
            where[drawn.spec.stick_board.name] = poses.stick(drawn.spec)[0] @ drawn.truth.stick_marker
            for tag, (m, corners) in enumerate(zip(network.tag_marker, network.tag_corners, strict=True)):
                T = T_camera_world @ where[network.markers[m].name]
                p = corners @ T[:3, :3].T + T[:3, 3]
                if p[:, 2].min() < 0.5 or T[:3, 2] @ T[:3, 3] > 0:
                    continue
                uv = cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, lens[4:])[0].reshape(4, 2)
                if uv.min() < 3 or uv[:, 0].max() > 636 or uv[:, 1].max() > 476:
                    continue
                rows["time_ns"].append(drawn.spec.start_utc_ns + round(t * 1e9))
                rows["family"].append(network.tag_family[tag])
                rows["tag_id"].append(network.tag_id[tag])
                rows["uv"].append(uv + rng.normal(size=(4, 2)) * SIGMA_PX)
        n = len(rows["uv"])
        out[camera] = columns(rows, n)
    return out


def columns(rows, n):
    uv = np.array(rows["uv"]).reshape(n, 8)
    table = {
        "time_ns": np.array(rows["time_ns"], np.int64),
        "family": np.array(rows["family"], object),
        "tag_id": np.array(rows["tag_id"]),
        "status": np.full(n, "accepted", object),
    }
    for k in range(4):
        table[f"u{k}"], table[f"v{k}"] = uv[:, 2 * k], uv[:, 2 * k + 1]
        table[f"cov{k}_uu"] = table[f"cov{k}_vv"] = np.full(n, SIGMA_PX**2)
        table[f"cov{k}_uv"] = np.zeros(n)
    return table


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


def test_one_end_leaves_the_direction_open_and_is_refused(rig):
    _, machine, site, detections, pins = rig
    with pytest.raises(CalibrationError, match="both of its ends"):
        calibrate_mounts(machine, site, (), detections, pins[:1])


def test_a_third_shot_with_a_typing_error_is_named(rig):
    drawn, machine, site, detections, pins = rig
    more = shots(drawn, np.random.default_rng(8), half_m=0.25)
    wrong = replace(more[0], name="bucket-3", p_world=more[0].p_world + [0.0, 0.0, 0.1])
    with pytest.raises(CalibrationError, match=r"bucket-3.*9\d mm|bucket-3.*10\d mm"):
        calibrate_mounts(machine, site, (), detections, [*pins, more[1], wrong])


def test_a_pin_shot_while_the_arm_moves_is_refused(rig):
    drawn, machine, site, detections, _ = rig
    with pytest.raises(CalibrationError, match="moved by"):
        calibrate_mounts(
            machine, site, (), detections, shots(drawn, np.random.default_rng(1), at_s=STAND_S + 0.5)
        )


def test_a_shot_of_another_day_is_refused(rig):
    _, machine, site, detections, pins = rig
    late = [replace(shot, time_ns=shot.time_ns + 86_400_000_000_000) for shot in pins]
    with pytest.raises(CalibrationError, match="no picture of the log"):
        calibrate_mounts(machine, site, (), detections, late)
