"""Corners of a board as a camera of known lens would show them, with drawn errors; for the tests of this folder."""

import numpy as np

from pipeline.calibration.board import parse_board
from pipeline.calibration.views import view_of
from pipeline.geometry import se3, so3
from pipeline.geometry.lenses import BROWN5, BROWN8, FISHEYE

SIZE = (640, 480)
BOARD = parse_board("chessboard:9x7:0.05")
TRUTH = {
    BROWN5.name: np.array([620.0, 617.0, 322.0, 236.0, -0.18, 0.06, 0.0006, -0.0007, -0.01]),
    BROWN8.name: np.array([620.0, 617.0, 322.0, 236.0, 0.25, -0.1, 0.0006, -0.0007, 0.02, 0.45, -0.05, 0.01]),
    FISHEYE.name: np.array([330.0, 331.0, 322.0, 236.0, 0.03, -0.01, 0.004, -0.001]),
}


def poses(count, seed, alike=False):
    """(count, 4, 4) ``T_camera_board``, the board all over the picture."""
    rng = np.random.default_rng([seed, 1])
    middle = BOARD.corners_m.mean(axis=0)
    found = []
    for _ in range(count):
        way, tilt = rng.uniform(0, 2 * np.pi), 0.01 if alike else np.deg2rad(rng.uniform(8, 40))
        R = so3.exp(tilt * np.array([np.cos(way), np.sin(way), 0])) @ so3.exp([0, 0, rng.normal(0, 0.3)])
        z = 0.9 if alike else rng.uniform(0.6, 1.3)
        centre = z * np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.22, 0.22), 1.0])
        found.append(se3.from_rotation_translation(R, centre - R @ middle))
    return np.array(found)


def drawn_views(lens, count=12, seed=0, sigma_px=0.1, truth=None, alike=False, per_view=lambda k, rng: k):
    """Views with independent errors of `sigma_px`, and their true poses; corners outside the picture are left out."""
    rng = np.random.default_rng([seed, 2])
    k = TRUTH[lens.name] if truth is None else truth
    T = poses(count, seed, alike)
    views = []
    for index, pose in enumerate(T):
        uv = lens.project(se3.transform(pose, BOARD.corners_m), per_view(k, rng))
        inside = np.all((uv > 0) & (uv < np.array(SIZE) - 1), axis=1)
        uv = uv + rng.normal(0, sigma_px, uv.shape)
        views.append(view_of(str(index), np.flatnonzero(inside), uv[inside], 0.1))
    return views, T
