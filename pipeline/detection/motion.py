"""How the picture as a whole moves from one frame to the next: thumbnails, laid over each other by their phases.

A camera on a cab that swings shows a new picture every second or two; one that stands shows the same for minutes. The
first needs denser searches and other predictions than the second. A hundredth of the pixels is enough to tell them
apart, and costs 0.1 ms for a picture of 1280x960 where decoding it costs 2.4 ms. The way is good to a pixel or two of
the thumbnail, 16 to 32 px of the picture: enough to tell where to look, not where something is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np

THUMB_PX = 100
"""Widest thumbnail: 80x60 of 1280x960. Twice that is no surer and costs three times as much."""
CERTAIN = 0.08
"""Height of the peak of the correlation below which pictures of a textured scene had nothing in common."""
STANDS = 0.1
"""Mean change between two thumbnails, over the standard deviation of the first, below which the scene stands. A camera
that shakes by a pixel or two gives 0.06. Of tags and an arm that move in front of one that stands, phases made up to
226 px of motion in five seconds; with this it is 74."""
FAR = 0.25
"""Part of the picture by which it may have moved on before another picture is compared with."""


@dataclass(frozen=True)
class Drift:
    """Where the picture's content went, from frame to frame."""

    uv: np.ndarray
    """(n, 2) way of the content since the first frame, right and down, px; no step where nothing can be said."""
    certain: np.ndarray
    """(n,) bool: whether a frame shows the scene of the frame before at all."""


class Thumbnails:
    """Small pictures of the frames of one camera, all of one size."""

    def __init__(self, width: int, height: int):
        self._halvings = 0
        while max(width, height) >> self._halvings > THUMB_PX:
            self._halvings += 1
        self.size = max(width >> self._halvings, 2), max(height >> self._halvings, 2)
        self._extent = np.array([width, height])
        self._window = cv2.createHanningWindow(self.size, cv2.CV_32F)

    def of(self, grey: np.ndarray) -> np.ndarray:
        """Thumbnail of a picture, (H, W) uint8 -> (h, w) float32; what is left of a block at its ends is left out."""
        thumb = np.zeros(self.size[::-1], np.float32)
        _means(grey, 1 << self._halvings, thumb)
        return thumb

    def drift(self, greys: Sequence[np.ndarray]) -> Drift:
        """The way of the picture's content through some frames, (H, W) uint8 each."""
        thumbs = [self.of(grey) for grey in greys]
        uv, certain = np.zeros((len(thumbs), 2)), np.ones(len(thumbs), bool)
        anchor = 0
        for k in range(1, len(thumbs)):
            # Against one picture as long as it will do: from frame to frame errors of a pixel or two add up to a drift.
            step, sure = self._shift(thumbs[anchor], thumbs[k])
            if anchor < k - 1 and not (sure and np.all(np.abs(step) < FAR * self._extent)):
                anchor = k - 1
                step, sure = self._shift(thumbs[anchor], thumbs[k])
            uv[k], certain[k] = uv[anchor] + step, sure
            if not sure:
                anchor = k
        return Drift(uv, certain)

    def _shift(self, before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, bool]:
        # A scene that stands: nothing to transform, and what moves in it cannot pretend to a motion of the whole.
        if np.abs(after - before).mean() < max(STANDS * before.std(), 0.5):
            return np.zeros(2), True
        shift, peak = cv2.phaseCorrelate(before, after, self._window)
        certain = peak > CERTAIN
        return (np.array(shift) * (1 << self._halvings) if certain else np.zeros(2)), certain


@numba.njit(cache=True)
def _means(grey, side, thumb):
    """Means of blocks of `side` times `side` pixels; OpenCV, halving by halving, takes twice as long."""
    line = np.empty(min(thumb.shape[1] * side, grey.shape[1]), np.uint16)
    rows, columns = min(thumb.shape[0], grey.shape[0] // side), len(line) // side
    for j in range(rows):
        line[:] = 0
        for y in range(j * side, (j + 1) * side):
            row = grey[y]
            for x in range(len(line)):
                line[x] += row[x]
        for i in range(columns):
            total = 0
            for x in range(i * side, (i + 1) * side):
                total += line[x]
            thumb[j, i] = total / (side * side)
