"""Axes and mounts of drawn machines, calibrated from rendered logs of a waving arm, and drawn axes from numbers."""

from __future__ import annotations

import numpy as np

from benchmarks._calibration_bars import Row, normalised
from benchmarks._calibration_rigs import drawn, recorded
from pipeline.calibration.axes import TOLD, axis_of_motion
from pipeline.calibration.mounts import calibrate_mounts
from pipeline.geometry import se3, so3
from pipeline.synthetic.calibration_sites import BUCKET_BOARD, MOUNTS

FIRST, AXES = 2000, 400
AXIS, MARKER = "bodies.bucket.axis", f"markers.{BUCKET_BOARD.name}.mount"


def mounts_of_rig(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors over sigma of the bucket's axis (4,) and of the mount of the board on the bucket (4,).

    Where the axis' frame lies along it and where its angle is zero are conventions, of the mount as well: it is
    compared by what is left in the axis' frame.
    """
    with recorded(MOUNTS, seed) as (site, found):
        mounts = calibrate_mounts(found.machine, found.site, [AXIS], found.detections)
    told = {quantity.key: quantity for quantity in mounts.told}
    axis, marker = told[AXIS], told[MARKER]
    assert site.bucket_marker is not None
    of_axis = se3.local(site.truth.axis, axis.T)[list(TOLD)]
    of_axis = of_axis / np.sqrt(np.diagonal(axis.covariance))[list(TOLD)]
    A = se3.Ad(marker.T)
    of_marker = se3.log(marker.T @ se3.inverse(site.bucket_marker)) / np.sqrt(
        np.diagonal(A @ marker.covariance @ A.T)
    )
    return of_axis, of_marker[list(TOLD)]


def axis_of_numbers(seed: int) -> np.ndarray:
    """(4,) errors over sigma of one axis, from drawn poses of a marker that turns about it."""
    rng = np.random.default_rng([seed, 608])
    A, M = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6) * 0.6)
    n = int(rng.integers(8, 40))
    angle = rng.uniform(-0.9, 0.9, n)
    sigma = np.repeat([rng.uniform(1e-3, 4e-3), rng.uniform(1e-3, 6e-3)], 3)
    Z = se3.from_rotation_translation(so3.exp(angle[:, None] * np.array([0.0, 0.0, 1.0])), np.zeros(3))
    T = A @ Z @ M @ se3.exp(rng.normal(size=(n, 6)) * sigma)
    said = se3.retract(A, rng.normal(size=6) * [0.02, 0.02, 0.0, 0.03, 0.03, 0.0])
    found = axis_of_motion(T, np.tile(np.diag(sigma**2), (n, 1, 1)), said, "joint")
    error = se3.local(A, found.T_parent_axis)[list(TOLD)]
    return np.asarray(error / np.sqrt(np.diagonal(found.covariance)))


def mounts(draws: int) -> list[Row]:
    """The bucket's axis and the mount of the board on it."""
    rigs = drawn(mounts_of_rig, draws, FIRST)
    return [
        normalised("axis of the bucket", np.array([rig[0] for rig in rigs])),
        normalised("mount of the bucket's board", np.array([rig[1] for rig in rigs])),
    ]


def axes(draws: int) -> list[Row]:
    """Axes from the motion of one marker: numbers only, so there are many."""
    z = np.array([axis_of_numbers(seed) for seed in range(max(draws, AXES))])
    return [normalised("axis from motion", z)]
