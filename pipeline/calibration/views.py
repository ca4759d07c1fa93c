"""Views: the corners of one board as one picture shows them, and which views are worth solving with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.calibration.board import CalibrationBoard

LEVEL_SIGMA_PX = 0.3
"""Of a corner in a corner file that was found in the full picture; each level halves the picture. Only the ratios
between corners count: the residuals tell how much corners scatter."""


@dataclass(frozen=True)
class View:
    """One picture of the board. Corners come in groups that were measured together: one corner of a chessboard, the
    four of a tag.
    """

    name: str
    """Of the picture: a file or a time."""
    point: np.ndarray
    """(m, c) int: which corners of the board."""
    uv: np.ndarray
    """(m, c, 2) px."""
    cov: np.ndarray
    """(m, 2c, 2c) px²; what repeats in all views (their common scale) is found from the residuals."""

    @property
    def corners(self) -> int:
        """How many corners were found."""
        return int(self.point.size)


def view_of(name: str, point: np.ndarray, uv: np.ndarray, cov: np.ndarray | float) -> View:
    """A view from corners that were measured one by one.

    Parameters
    ----------
    name : str
        Of the picture.
    point : (m,) int array
        Which corners of the board.
    uv : (m, 2) array
        Pixels.
    cov : (m, 2, 2) array or float
        px², or one standard deviation for all, px.
    """
    point = np.asarray(point, int).reshape(-1, 1)
    if np.ndim(cov) == 0:
        cov = np.broadcast_to(np.eye(2) * float(cov) ** 2, (len(point), 2, 2))
    return View(name, point, np.asarray(uv, float).reshape(-1, 1, 2), np.array(cov, float))


def views_of_corner_file(text: str, board: CalibrationBoard) -> tuple[list[View], list[str]]:
    """Views from a corner file: lines ``filename x y level``, corners of a picture row by row.

    Parameters
    ----------
    text : str
        Lines that begin with # are left out; ``-`` stands for a corner that was not found; the level is how often the
        picture was halved when it was (missing: 0, ``-`` or negative: not found).
    board : CalibrationBoard
        A chessboard.

    Returns
    -------
    views, odd : lists
        The views, and names of the pictures whose number of corners is not that of the board.
    """
    pictures: dict[str, list[list[str]]] = {}
    for line in text.splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            pictures.setdefault(words[0], []).append(words[1:])
    expected = len(board.corners_m)
    views, odd = [], []
    for name, rows in pictures.items():
        if all(row[:1] == ["-"] for row in rows):
            continue  # the board was not seen: one line, or one for each corner
        if len(rows) != expected:
            odd.append(name)
            continue
        uv, level = np.full((expected, 2), np.nan), np.zeros(expected)
        for number, row in enumerate(rows):
            try:
                uv[number] = float(row[0]), float(row[1])
                level[number] = float(row[2]) if len(row) > 2 else 0.0
            except (ValueError, IndexError):
                uv[number] = np.nan
        kept = np.flatnonzero(np.all(np.isfinite(uv), axis=1) & (level >= 0))
        sigma = LEVEL_SIGMA_PX * 2.0 ** level[kept]
        cov = sigma[:, None, None] ** 2 * np.eye(2)
        views.append(view_of(name.rsplit("/", 1)[-1], kept, uv[kept], cov))
    return views, odd


def most_telling(information: Sequence[np.ndarray], most: int) -> list[int]:
    """Which views to keep so that the intrinsics are known best.

    Greedy on the log-determinant of the sum of what they say; a set that is worse than the best of its size by no more
    than a factor of 1 - 1/e in what the determinant gains (Nemhauser, Wolsey and Fisher, 1978).

    Parameters
    ----------
    information : sequence of (n, n) arrays
        Of each view on the intrinsics, its own pose reduced out.
    most : int
        How many to keep.

    Returns
    -------
    list of int
        In ascending order.
    """
    if len(information) <= most:
        return list(range(len(information)))
    each = np.array(information)
    whole = each.sum(axis=0)
    # What all views together know, is the scale: a millionth of it begins the sum, so that it can be inverted.
    scale = 1 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    each = each * scale[:, None] * scale
    total = 1e-6 * whole * scale[:, None] * scale + 1e-9 * np.eye(len(whole))
    left = np.ones(len(each), bool)
    chosen: list[int] = []
    while len(chosen) < most:
        rows = np.flatnonzero(left)
        gain = np.linalg.slogdet(total + each[rows])[1]
        best = int(rows[np.argmax(gain)])
        chosen.append(best)
        left[best] = False
        total = total + each[best]
    return sorted(chosen)
