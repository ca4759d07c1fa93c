"""Tags on their way through the frames of a span: where each was last, and where it may be next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np

from pipeline.detection.motion import Drift
from pipeline.detection.prints import cells_across
from pipeline.detection.seen import Seen

DECODER_TRIES = 2
"""Frames after a tag was lost in which the decoder looks for it; after them only its correlation tells of it."""


@dataclass
class Track:
    """A tag on its way through the frames of a span."""

    number: int
    family: str
    tag_id: int
    uv: np.ndarray
    """(4, 2) where it was last, px."""
    frame: int
    """In which frame that was."""
    step: np.ndarray | None = None
    """(4, 2) velocity of its corners, px/s."""
    lost: int = 0
    """Frames since then."""
    side_px: float = 0.0
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        self.side_px, self.centre = _side_and_centre(self.uv)

    def at(self, uv: np.ndarray, frame: int, seconds: float) -> None:
        """Seen again, so many seconds later (negative on the way back)."""
        self.step = (uv - self.uv) / seconds if self.lost <= 2 and seconds else None
        self.uv, self.frame, self.lost = uv, frame, 0
        self.side_px, self.centre = _side_and_centre(uv)


def _side_and_centre(uv: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Mean side and centre of one quad, in plain numbers: arrays of four rows take ten times as long."""
    (a, b), (c, d), (e, f), (g, h) = uv.tolist()
    around = hypot(c - a, d - b) + hypot(e - c, f - d) + hypot(g - e, h - f) + hypot(a - g, b - h)
    return 0.25 * around, (0.25 * (a + c + e + g), 0.25 * (b + d + f + h))


class Span:
    """The frames between two searches, and what was seen in them so far."""

    def __init__(self, greys: Sequence[np.ndarray], time_s: np.ndarray, drift: Drift):
        self.greys, self.time_s = greys, np.asarray(time_s, float)
        self.drift, self.certain = drift.uv, drift.certain
        self.seen: list[list[Seen]] = [[] for _ in greys]
        self.tracks = 0

    def __len__(self) -> int:
        return len(self.greys)


def guesses_of(track: Track, span: Span, k: int) -> list[np.ndarray]:
    """Where a track may be in frame k, the likeliest first; (4, 2) each."""
    places = [track.uv]
    drift = span.drift[k] - span.drift[track.frame]
    if np.abs(drift).max() > 0.5:
        places.insert(0, track.uv + drift)
    if track.step is not None and not track.lost:
        places.insert(0, track.uv + track.step * (span.time_s[k] - span.time_s[track.frame]))
    return places


def nearest(tracks: Sequence[Track], span: Span, k: int, uv: np.ndarray) -> tuple[Track | None, float]:
    """The track that is likeliest to be at a quad in frame k, and how far from there its guess is, px."""
    centre = uv.mean(axis=0)
    away = [float(np.hypot(*(guesses_of(track, span, k)[0].mean(axis=0) - centre))) for track in tracks]
    if not away:
        return None, np.inf
    first = int(np.argmin(away))
    return tracks[first], away[first]


def reach_px(track: Track, span: Span, k: int) -> float:
    """How far from its guesses a track is looked for: by how fast things move; little once it is lost."""
    cell = track.side_px / cells_across(track.family)
    still = 1.5 * cell + 3.0
    if track.lost >= DECODER_TRIES:
        return still
    drift = float(np.abs(span.drift[k] - span.drift[track.frame]).max())
    own = 0.0
    if track.step is not None:
        own = float(np.abs(track.step).max() * abs(span.time_s[k] - span.time_s[track.frame]))
    return min(still + 4.0 + 0.3 * max(drift, own), 48.0)


def in_view(track: Track, span: Span, k: int) -> bool:
    """Whether a track's tag can be in frame k at all, by where it was and how the picture moved since."""
    height, width = span.greys[k].shape
    u, v = track.centre
    if 0 <= u < width and 0 <= v < height:
        return True
    for place in guesses_of(track, span, k):
        u, v = place.sum(axis=0) / 4
        if 0 <= u < width and 0 <= v < height:
            return True
    return False
