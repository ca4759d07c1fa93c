"""Tags that are printed on one board: where one is, the others are.

A tag that comes into view beside others of its board, or from behind the boom, is looked for at the place that they
give, and needs no search. One tag is enough to tell where its neighbours are to a part of a cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.geometry import homography

NEAREST = 0.05
"""Depth of a corner that is believed to be in front of the camera, as a part of that of the corners that are seen."""


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
        H = homography.from_points(
            np.concatenate([self.corners[number] for number in mine]),
            np.concatenate([seen[number] for number in mine]),
        )
        found = {}
        for number in self.tag_id:
            if number not in seen:
                p = np.column_stack([self.corners[number], np.ones(4)]) @ H.T
                if np.all(p[:, 2] > NEAREST):
                    found[number] = p[:, :2] / p[:, 2:]
        return found
