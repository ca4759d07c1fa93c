"""What a set of views cannot tell: parts of the picture that the board never reached, one distance, one attitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.calibration.views import View

COLUMNS, ROWS = 8, 6
CORNER_PART = 0.2
"""Of the picture's width and height: what counts as its corner."""
NEAR_AND_FAR = 1.4
"""Largest over smallest distance below which a recording has one distance."""
TILTED_DEG = 20.0
"""Widest angle between two attitudes of the board below which focal length hangs on little."""
PLACES = ("upper left", "upper right", "lower left", "lower right")


@dataclass(frozen=True)
class Coverage:
    """Where the corners of all views lie, and how the board was held."""

    counts: np.ndarray
    """(ROWS, COLUMNS) corners by part of the picture."""
    missing: tuple[str, ...]
    """Corners of the picture, of `PLACES`, without a corner of the board."""
    distance_m: tuple[float, float]
    """Nearest and farthest middle of the board; in its own metres."""
    tilt_deg: float
    """Widest angle between two attitudes of the board."""
    slant_deg: float
    """Largest angle between the board and the picture."""

    @property
    def one_distance(self) -> bool:
        """Whether all views are from about one distance."""
        return self.distance_m[1] < NEAR_AND_FAR * self.distance_m[0]

    @property
    def little_tilt(self) -> bool:
        """Whether the board was tilted too little."""
        return self.tilt_deg < TILTED_DEG


def coverage(
    views: Sequence[View], T_camera_board: np.ndarray, corners_m: np.ndarray, size: tuple[int, int]
) -> Coverage:
    """What a set of views covers.

    Parameters
    ----------
    views : sequence of View
        Those that are used.
    T_camera_board : (v, 4, 4) array
        Their poses.
    corners_m : (n, 3) array
        Of the board.
    size : (width, height)
        Of the picture, px.
    """
    uv = np.concatenate([view.uv.reshape(-1, 2) for view in views])
    width, height = size
    counts, _, _ = np.histogram2d(
        uv[:, 1], uv[:, 0], bins=(ROWS, COLUMNS), range=((-0.5, height - 0.5), (-0.5, width - 0.5))
    )
    x, y = uv[:, 0] / width, uv[:, 1] / height
    low, high = CORNER_PART, 1 - CORNER_PART
    there = [(x < low) & (y < low), (x > high) & (y < low), (x < low) & (y > high), (x > high) & (y > high)]
    middle = corners_m.mean(axis=0)
    distance = np.linalg.norm(T_camera_board[:, :3, :3] @ middle + T_camera_board[:, :3, 3], axis=1)
    normal = T_camera_board[:, :3, 2]
    return Coverage(
        counts=counts.astype(int),
        missing=tuple(place for place, seen in zip(PLACES, there) if not np.any(seen)),
        distance_m=(float(distance.min()), float(distance.max())),
        tilt_deg=float(np.rad2deg(np.arccos(np.clip(np.min(normal @ normal.T), -1, 1)))),
        slant_deg=float(np.rad2deg(np.arccos(np.clip(np.min(np.abs(normal[:, 2])), -1, 1)))),
    )
