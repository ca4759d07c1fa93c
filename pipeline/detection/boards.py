"""Tags that are printed on one board: where one is, the others are.

A tag that comes into view beside others of its board, or from behind the boom, is looked for at the place that they
give, and needs no search. One tag is enough to tell where its neighbours are to a part of a cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Board:
    """The tags of one marker of machine.toml or site.toml."""

    family: str
    tag_id: tuple[int, ...]
    corners_m: tuple[tuple[tuple[float, float], ...], ...]
    """Of each tag on the board, x to the right and y up, in our order of corners."""

    @cached_property
    def corners(self) -> dict[int, np.ndarray]:
        """Tag id -> (4, 2)."""
        return {number: np.array(corners) for number, corners in zip(self.tag_id, self.corners_m)}

    def places(self, seen: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
        """Where the tags are that are not seen.

        Parameters
        ----------
        seen : mapping
            Tag id -> (4, 2) corners, px.

        Returns
        -------
        dict
            Tag id -> (4, 2) corners, px; without those that would lie behind the camera.
        """
        mine = [number for number in self.tag_id if number in seen]
        if not mine or len(mine) == len(self.tag_id):
            return {}
        H = homography(
            np.concatenate([self.corners[number] for number in mine]),
            np.concatenate([seen[number] for number in mine]),
        )
        anchor = np.append(self.corners[mine[0]].mean(axis=0), 1.0) @ H[2]
        found = {}
        for number in self.tag_id:
            if number not in seen:
                p = np.column_stack([self.corners[number], np.ones(4)]) @ H.T
                if np.all(p[:, 2] * np.sign(anchor) > 0.05 * abs(anchor)):
                    found[number] = p[:, :2] / p[:, 2:]
        return found


def homography(from_xy: np.ndarray, to_uv: np.ndarray) -> np.ndarray:
    """(3, 3) that brings (n, 2) points to (n, 2) others, n >= 4, least squares of the algebraic error."""
    A, a = _normalised(from_xy)
    B, b = _normalised(to_uv)
    M = np.zeros((2 * len(A), 9))
    M[0::2, 0:2], M[0::2, 2] = A, 1.0
    M[1::2, 3:5], M[1::2, 5] = A, 1.0
    M[0::2, 6:8], M[0::2, 8] = -A * B[:, :1], -B[:, 0]
    M[1::2, 6:8], M[1::2, 8] = -A * B[:, 1:], -B[:, 1]
    _, V = np.linalg.eigh(M.T @ M)
    H = np.linalg.inv(b) @ V[:, 0].reshape(3, 3) @ a
    return np.asarray(H / np.linalg.norm(H))


def _normalised(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points about their mean at a mean distance of about 1, and the (3, 3) that does it."""
    mean = xy.mean(axis=0)
    scale = 1.0 / max(float(np.abs(xy - mean).mean()), 1e-9)
    T = np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]])
    return (xy - mean) * scale, T
