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
        hamming=np.array([row.hamming for row in rows], np.int32),
        margin=np.array([row.margin for row in rows], float),
    )


_BEFORE = [3, 0, 1, 2]


def sides_px(uv: np.ndarray) -> np.ndarray:
    """Mean side of quads, (..., 4, 2) -> (...)."""
    edge = uv - uv[..., _BEFORE, :]
    return np.asarray(np.sqrt(edge[..., 0] ** 2 + edge[..., 1] ** 2).mean(axis=-1))
