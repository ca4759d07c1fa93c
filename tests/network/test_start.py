"""Planar poses and the choice between the two: what the adjustment starts from."""

import cv2
import numpy as np
import pytest

from pipeline.geometry import se3, so3
from pipeline.network import planar
from pipeline.network.branches import viterbi
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from pipeline.network.start import geodesic, start
from tests.estimation.simulator import Options, draw

SQUARE = 0.15 * np.array([[-1.0, 1], [1, 1], [1, -1], [-1, -1]])


def _views(n, seed):
    """Markers that face the camera, at 3 to 12 m, tilted up to 60 degrees."""
    rng = np.random.default_rng(seed)
    facing = so3.from_rpy_deg(np.array([180.0, 0.0, 0.0]))
    tilt = so3.exp(rng.uniform(-0.8, 0.8, (n, 3)))
    t = np.stack([rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), rng.uniform(3, 12, n)], axis=-1)
    return se3.from_rotation_translation(facing @ tilt, t)


def _rays(T, q):
    p = se3.transform(T[:, None], np.concatenate([q, np.zeros((len(q), 1))], axis=1))
    return p[..., :2] / p[..., 2:]


def test_one_of_both_poses_is_the_truth_where_nothing_disturbs():
    T = _views(200, 0)
    xy = _rays(T, SQUARE)
    both = planar.both_poses(np.broadcast_to(SQUARE, xy.shape), xy, np.ones(xy.shape[:2]))
    error = np.linalg.norm(se3.local(both, T[:, None]), axis=-1).min(axis=1)
    assert error.max() < 1e-5


@pytest.mark.parametrize("points", [4, 16])
def test_both_poses_are_those_of_opencv(points):
    q = (
        SQUARE
        if points == 4
        else np.concatenate([SQUARE + c for c in ([0, 0], [0.4, 0], [0, 0.4], [0.4, 0.4])])
    )
    rng = np.random.default_rng(1)
    T = _views(50, 2)
    xy = _rays(T, q) + 2e-4 * rng.standard_normal((50, points, 2))
    both = planar.both_poses(np.broadcast_to(q, xy.shape), xy, np.ones(xy.shape[:2]))
    q3 = np.concatenate([q, np.zeros((points, 1))], axis=1)
    for ours, rays in zip(both, xy, strict=True):
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(q3, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        for rvec, tvec in zip(rvecs, tvecs, strict=True):
            theirs = se3.from_rotation_translation(cv2.Rodrigues(rvec)[0], tvec[:, 0])
            gap = np.abs(se3.local(ours, theirs)).max(axis=-1).min()
            assert gap < 0.02  # two ways of fitting a homography to noisy points


def test_corners_that_were_not_seen_do_not_matter():
    q = np.concatenate([SQUARE, SQUARE + [0.4, 0.0]])
    T = _views(20, 3)
    xy = _rays(T, q)
    weight = np.ones(xy.shape[:2])
    weight[:, 4:] = 0
    xy[:, 4:] = 0
    both = planar.both_poses(np.broadcast_to(q, xy.shape), xy, weight)
    assert np.linalg.norm(se3.local(both, T[:, None]), axis=-1).min(axis=1).max() < 1e-5


def test_the_path_of_least_turning_outlives_flips_of_a_quarter_of_the_pictures():
    rng = np.random.default_rng(4)
    n = 400
    t = 0.2 * np.arange(n)
    right = se3.exp(
        np.stack(
            [0.0 * t, 0.0 * t, 5 + 0.0 * t, 0.3 * np.sin(0.3 * t), 0.4 + 0.1 * np.cos(t), 0.0 * t], axis=-1
        )
    )
    flipped = right @ se3.exp(np.array([0, 0, 0, 0, -0.8, 0.0]))
    cost = np.stack([np.zeros(n), np.full(n, 2.0)], axis=-1)
    wrong = rng.random(n) < 0.25  # here the flipped pose reprojects better
    cost[wrong] = cost[wrong][:, ::-1]
    chosen = viterbi(np.stack([right, flipped], axis=1), cost, t)
    assert not chosen.any()


def test_starts_from_noisy_corners_are_near_the_truth_on_the_right_branch():
    drawn = draw(5, Options(epochs=60, bucket_marker=True, potentiometer=False))
    tied = tie(drawn.network, drawn.observations, {})
    epochs = epochs_of(drawn.network, drawn.observations, {})
    first = start(drawn.network, tied, epochs)
    by_body = {v.body: k for k, v in enumerate(tied.variables)}
    cab = se3.local(first.pose[by_body["cab"]], drawn.T_world["cab"])
    assert np.abs(cab[:, 3:]).max() < 0.03 and np.abs(cab[:, :3]).max() < 0.3
    anchor = tied.frames.edges["body stick"].parent
    mount = drawn.statics[[s.name for s in drawn.network.statics].index(f"{anchor} mount")]
    T_camera_stick = se3.inverse(drawn.T_world["cab"] @ mount) @ drawn.T_world["stick"]
    stick = se3.local(first.pose[by_body["stick"]], T_camera_stick)
    assert np.abs(stick[:, 3:]).max() < 0.2  # a flip is off by more than 0.5


def test_geodesic_goes_through_its_knots_and_halves_the_way():
    T = np.array([se3.identity(), se3.exp(np.array([1.0, 0, 0, 0, 0, 1.0]))])
    out = geodesic(np.array([0.0, 2.0]), T, np.array([-1.0, 0.0, 1.0, 2.0, 5.0]))
    np.testing.assert_allclose(se3.log(out)[:, 5], [0, 0, 0.5, 1, 1], atol=1e-12)
    np.testing.assert_allclose(se3.log(out)[:, 0], [0, 0, 0.5, 1, 1], atol=1e-12)
