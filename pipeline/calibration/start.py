"""Where the adjustment of intrinsics begins: OpenCV's closed forms."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pipeline.calibration.views import View
from pipeline.errors import CalibrationError
from pipeline.geometry.lenses import BROWN5, BROWN8, FISHEYE, Lens

VIEWS = 12
"""Views for the first focal length."""
FISHEYE_FOCALS = np.geomspace(0.2, 1.2, 13)
"""Tried, in widths of the picture."""


def first_guess(
    lens: Lens, views: Sequence[View], corners_m: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics and poses to begin with.

    Parameters
    ----------
    lens : Lens
        Its model.
    views : sequence of View
        All of them.
    corners_m : (n, 3) array
        Metres.
    size : (width, height)
        Of the picture, px.

    Returns
    -------
    intrinsics : (n,) array
    T_camera_board : (v, 4, 4) array

    Raises
    ------
    CalibrationError
        No camera shows the board like this.
    """
    few = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, VIEWS).round().astype(int))]
    if lens is FISHEYE:
        centre = [(size[0] - 1) / 2, (size[1] - 1) / 2]
        trials = [np.array([f * size[0], f * size[0], *centre, 0, 0, 0, 0]) for f in FISHEYE_FOCALS]
        misses = [_miss(lens, trial, few, corners_m) for trial in trials]
        k = trials[int(np.argmin(misses))]
    else:
        points = [corners_m[view.point.ravel()].astype(np.float32) for view in few]
        uv = [view.uv.reshape(-1, 1, 2).astype(np.float32) for view in few]
        flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_K2
        try:
            _, K, d, _, _ = cv2.calibrateCamera(points, uv, size, None, None, flags=flags)
        except cv2.error:
            K, d = np.full((3, 3), np.nan), np.zeros(5)
        k = np.zeros(len(lens))
        k[:4] = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        k[4] = float(np.ravel(d)[0])
        if not np.all(np.isfinite(k)) or not np.all((k[:2] > 0.1 * size[0]) & (k[:2] < 100 * size[0])):
            # Views that are all alike leave the focal length open; the adjustment says so with its sigma.
            k = np.array([size[0], size[0], (size[0] - 1) / 2, (size[1] - 1) / 2, *[0.0] * (len(lens) - 4)])
    assert lens in (BROWN5, BROWN8, FISHEYE)
    T = np.array([pose_of(lens, k, view, corners_m)[0] for view in views])
    return k, T


def pose_of(lens: Lens, k: np.ndarray, view: View, corners_m: np.ndarray) -> tuple[np.ndarray, float]:
    """``T_camera_board`` (4, 4) of a view, and its RMS residual in normalised coordinates.

    Raises CalibrationError where nothing fits.
    """
    xy = lens.undistorted(view.uv.reshape(-1, 2), k)
    good = np.all(np.isfinite(xy), axis=1)
    p = corners_m[view.point.ravel()]
    T = np.eye(4)
    if np.count_nonzero(good) >= 6:
        found, rotation, shift = cv2.solvePnP(p[good], xy[good], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        if found and np.all(np.isfinite(shift)) and shift[2, 0] > 0:
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], shift[:, 0]
            p_camera = p[good] @ T[:3, :3].T + T[:3, 3]
            miss = p_camera[:, :2] / p_camera[:, 2:] - xy[good]
            return T, float(np.sqrt(np.mean(miss**2)) / max(float(np.mean(good)), 0.1) ** 2)
    raise CalibrationError(f"{view.name}: no camera shows the board like this; is it this board?")


def _miss(lens: Lens, k: np.ndarray, views: Sequence[View], corners_m: np.ndarray) -> float:
    total = 0.0
    for view in views:
        try:
            total += pose_of(lens, k, view, corners_m)[1] * k[0]
        except CalibrationError:
            total += 1e3
    return total
