"""Corner noise by size of the tag and by light, from whatever stood still in a log: the paper's Fig. 11.

`pipeline.detection.stillness` finds the stretches in which a tag stood still and holds the scatter of its corners
against their covariances. Here its rows are told apart by light first. A log has no light meter; how far the tag's
white is from its black in grey values is what light leaves on the picture, and what noise is felt against.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.detection.still_window import WINDOW
from pipeline.detection.stillness import RATIO_HIGH, Scatter, SizeClass, Stillness, Tag

CONTRASTS = (0.0, 40.0, 80.0, 120.0, 160.0, math.inf)
"""Borders of the classes of light: grey values from black to white."""
PORTION = 2 * WINDOW
"""Sightings of a tag that share one class of light, so that a flicker at a border does not cut its windows."""
COLUMNS = (
    "frame", "family", "tag_id", "status", "side_px", "contrast",
    *(f"{x}{k}" for k in range(4) for x in "uv"),
    *(f"cov{k}_{name}" for k in range(4) for name in ("uu", "uv", "vv")),
)  # fmt: skip
"""Of the table `detections`."""


@dataclass(frozen=True)
class LightClass:
    """Grey values from black to white, from `low` up to `high`, exclusive."""

    low: float
    high: float

    def __str__(self) -> str:
        if math.isinf(self.high):
            return f"{self.low:g} and more"
        return f"{self.low:g} to {self.high:g}" if self.low else f"under {self.high:g}"


LIGHT_CLASSES = tuple(LightClass(low, high) for low, high in pairwise(CONTRASTS))


@dataclass(frozen=True)
class CornerNoise:
    """What stood still before one camera."""

    by_class: dict[tuple[LightClass, SizeClass], Scatter]
    by_tag: dict[tuple[Tag, LightClass, SizeClass], Scatter]
    whole: Scatter | None
    """All together; None where nothing stood still. Of the largest class."""

    @property
    def ratio(self) -> float:
        """Noise over prediction of the class that has most frames."""
        return self.whole.ratio if self.whole else math.nan

    @property
    def surely_above(self) -> bool:
        """Whether corners of any class surely scatter more than what a report rests on."""
        return any(found.ratio_low > RATIO_HIGH for found in self.by_class.values())


def corner_noise(columns: Mapping[str, np.ndarray]) -> CornerNoise:
    """The scatter of one camera's corners while nothing moved.

    Parameters
    ----------
    columns : mapping
        `COLUMNS` of the table `detections` of one camera, in order of its frames.
    """
    light = _light(columns)
    by_class: dict[tuple[LightClass, SizeClass], Scatter] = {}
    by_tag: dict[tuple[Tag, LightClass, SizeClass], Scatter] = {}
    for number, of in enumerate(LIGHT_CLASSES):
        rows = np.flatnonzero(light == number)
        if not len(rows):
            continue
        stillness = Stillness()
        stillness.add({name: columns[name][rows] for name in COLUMNS})
        by_class |= {(of, size): found for size, found in stillness.by_size().items()}
        by_tag |= {(tag, of, size): found for (tag, size), found in stillness.by_tag().items()}
    largest = max(by_class.values(), key=lambda found: found.corners, default=None)
    return CornerNoise(by_class, by_tag, largest)


def one_frame_mm(noise_px: float, side_px: float, focal_px: float, distance_m: float) -> tuple[float, float]:
    """What corner noise makes of a tag's place in one frame: millimetres across the view, and along it.

    A tag that faces the camera, alone and to first order. A tilt moves its corners alike as a shift does, and shows
    otherwise only in the keystone; so its place across the view is the mean of the corners and the keystone together,
    either with half a corner's noise: ``noise / sqrt 2``. Its size has the relative deviation ``noise / (sqrt 2 s)``.

    Parameters
    ----------
    noise_px : float
        Standard deviation of a corner per axis.
    side_px : float
        Side of the tag in the picture.
    focal_px : float
        Focal length.
    distance_m : float
        From the camera to the tag.
    """
    across = 1000 * distance_m * noise_px / math.sqrt(2) / focal_px
    along = 1000 * distance_m * noise_px / (math.sqrt(2) * side_px)
    return across, along


def _light(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """(n,) number of the class of light of each row; -1 where the print was not laid over the picture."""
    contrast = np.asarray(columns["contrast"], float)
    light = np.full(len(contrast), -1)
    for rows in _by_tag(columns):
        rows = rows[np.isfinite(contrast[rows])]
        for start in range(0, len(rows), PORTION):
            part = rows[start : start + PORTION]
            light[part] = np.searchsorted(CONTRASTS, np.median(contrast[part]), side="right") - 1
    return light


def _by_tag(columns: Mapping[str, np.ndarray]) -> Iterator[np.ndarray]:
    """Rows of each tag."""
    names, number = np.unique(columns["family"].astype(str), return_inverse=True)
    key = columns["tag_id"].astype(np.int64) * max(len(names), 1) + number
    order = np.argsort(key, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        if len(part):
            yield part
