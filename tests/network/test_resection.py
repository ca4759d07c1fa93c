"""Poses refined on all their corners: what they are, and what they are worth where places grow on each other."""

import numpy as np
import pytest

from pipeline.geometry import se3
from pipeline.network import frames as fr
from pipeline.network import resection
from pipeline.network.resection import _normal, refined
from pipeline.network.views import View

FOCAL_PX = 800.0
SQUARE = 0.1 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def _scene(sign, seed=0, count=20, markers=3, noise_px=0.0):
    """A rig that looks at some markers from ``count`` places: views, what is around their edge, and its true poses.

    ``sign`` -1: the edge is the rig's pose in the world, on the way up from the camera; +1: a pose on the way down.
    """
    rng = np.random.default_rng(seed)
    T_world_marker = se3.exp(rng.uniform(-1, 1, (markers, 6)) * np.array([1.0, 1.0, 0.5, 0.4, 0.4, 3.0]))
    away = se3.from_rotation_translation(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 5.0]))
    T_world_rig = away @ se3.exp(rng.uniform(-1, 1, (count, 6)) * np.array([0.5, 0.5, 0.5, 0.1, 0.1, 0.5]))
    T_rig_camera = se3.exp(np.array([0.1, -0.05, 0.02, 0.03, -0.02, 0.1]))
    E = T_world_rig if sign < 0 else se3.inverse(T_world_rig)
    edge = fr.Edge("world", "moving", 0)
    views, around = [], []
    for T in T_world_marker:
        p = se3.transform((se3.inverse(T_world_rig @ T_rig_camera) @ T)[:, None], SQUARE)
        assert p[..., 2].min() > 1
        xy = p[..., :2] / p[..., 2:] + noise_px / FOCAL_PX * rng.standard_normal((count, 4, 2))
        seen = np.ones((count, 4), dtype=bool)
        views.append(View((), np.arange(count), SQUARE, xy, seen, FOCAL_PX, None, None))
        before = np.broadcast_to(se3.inverse(T_rig_camera), (count, 4, 4))
        around.append(
            (np.arange(count), before, np.broadcast_to(T, (count, 4, 4)), fr.Step("rig", edge, sign))
        )
    return views, around, E, rng


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_gradient_of_the_loss_matches_central_differences(sign):
    views, around, E, rng = _scene(sign)
    E = se3.retract(E, rng.normal(size=(len(E), 6)) * np.repeat([0.01, 0.003], 3))
    _, g, _ = _normal(E, views, around)
    for i in range(6):
        d = 1e-6 * np.eye(6)[i]
        ahead, behind = (_normal(se3.retract(E, s * d), views, around)[2] for s in (1, -1))
        np.testing.assert_allclose(g[:, i], (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("sign", [-1, 1])
def test_without_noise_it_ends_at_the_truth_from_a_decimetre_and_five_degrees_off(sign):
    views, around, truth, rng = _scene(sign)
    off = rng.normal(size=truth.shape[:1] + (6,))
    off *= np.repeat([0.1, 0.087], 3) / np.linalg.norm(off.reshape(-1, 2, 3), axis=-1).repeat(3, axis=1)
    E = refined(se3.retract(truth, off), views, around)
    error = np.linalg.norm(se3.local(truth, E), axis=-1)
    print(f"error {np.median(error):.1e} in the median, {error.max():.1e} at most")
    assert np.median(error) < 1e-6 and error.max() < 1e-3


def test_a_pose_of_an_edge_that_does_not_change_is_told_by_all_frames():
    """A camera's mount from 60 markers in frames: its error is that of one frame over the root of their number."""
    views, around, T_world_rig, _ = _scene(-1, noise_px=0.3)
    truth = around[0][1][0]  # T_camera_rig
    every = [
        (
            np.zeros(len(rows), dtype=int),
            np.broadcast_to(np.eye(4), before.shape),
            se3.inverse(T_world_rig) @ after,
            fr.Step("camera", fr.Edge("rig", "static", 0), 1),
        )
        for rows, before, after, _ in around
    ]
    start = se3.retract(truth[None], np.array([0.05, -0.05, 0.05, 0.03, 0.02, -0.03])[None])
    error = se3.local(refined(start, views, every)[0], truth)
    print(f"{1000 * np.linalg.norm(error[:3]):.2f} mm, {np.rad2deg(np.linalg.norm(error[3:])):.3f} deg")
    assert np.linalg.norm(error[:3]) < 0.01 and np.linalg.norm(error[3:]) < 0.002


def test_one_marker_that_lies_elsewhere_does_not_pull_a_pose_away(monkeypatch):
    views, around, truth, _ = _scene(-1, markers=4)
    rows, before, after, step = around[0]
    moved = [(rows, before, after @ se3.exp(np.array([0.3, 0.2, 0, 0, 0, 0])), step), *around[1:]]

    def pulled():
        return np.median(np.linalg.norm(se3.local(truth, refined(truth, views, moved))[:, :3], axis=-1))

    robust = pulled()
    monkeypatch.setattr(resection, "SCALE_PX", 1e6)
    squares = pulled()
    print(f"a marker 360 mm off pulls {1000 * robust:.0f} mm, with plain squares {1000 * squares:.0f} mm")
    assert robust < 0.1 * squares
