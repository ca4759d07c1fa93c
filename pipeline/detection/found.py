"""The tags found in one picture, whoever found them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class Sighting(NamedTuple):
    """One tag as a search hands it over; in our conventions already."""

    family: str
    tag_id: int
    uv: np.ndarray
    """(4, 2) px."""
    hamming: int
    margin: float


@dataclass(frozen=True)
class Found:
    """The tags found in one picture, sorted by family, id and place."""

    family: np.ndarray
    """(n,) object array of names."""
    tag_id: np.ndarray
    """(n,) int."""
    uv: np.ndarray
    """(n, 4, 2) corners top-left, top-right, bottom-right, bottom-left of the print; px, top-left pixel at (0, 0)."""
    side_px: np.ndarray
    """(n,) mean side of the quad."""
    hamming: np.ndarray
    """(n,) int, corrected bits."""
    margin: np.ndarray
    """(n,) decision margin of the decoder."""

    def __len__(self) -> int:
        return len(self.tag_id)


def gathered(sightings: Iterable[Sighting]) -> Found:
    """Sightings of one picture, in whatever order, as `Found`."""
    # The library's order depends on its hash tables; equal bytes for equal pictures need one of our own.
    rows = sorted(sightings, key=lambda row: (row.family, row.tag_id, row.uv.tolist()))
    uv = np.array([row.uv for row in rows]).reshape(-1, 4, 2)
    return Found(
        family=np.array([row.family for row in rows], object),
        tag_id=np.array([row.tag_id for row in rows], np.int32),
        uv=uv,
        side_px=np.linalg.norm(np.roll(uv, -1, axis=1) - uv, axis=-1).mean(axis=1),
        hamming=np.array([row.hamming for row in rows], np.int32),
        margin=np.array([row.margin for row in rows], float),
    )
