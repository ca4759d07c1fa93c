"""Scatter of corners while nothing moves, against their predicted covariances: the paper's Fig. 11 from any log.

The paper puts a tag before a camera, takes many pictures and finds the scatter of its corners (0.2 px). Every log holds
such stretches: a machine that waits, a camera on a tripod. Here they are found in the table `detections` as it is
written, tag by tag, in windows (`still_window`), and memory does not grow with the log. The median over windows stands
for a size class, so that a few that were not quite still do not decide.

Two ratios come out. The **noise** of a corner beside the shift that all corners of its tag share, over its
prediction: this one judges the covariances. And the **shake** of whole tags over what that noise explains: on a
machine whose engine runs it is real and the adjustment follows it; only where tag and camera cannot move against one
another it is an error, of the mount or of hot air (the report tells which those are).

The scatter says nothing on errors that repeat from frame to frame (blur, light, the place within a pixel, a bent
print): a ratio far below 1 may be right where the prediction covers those.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.detection.acceptance import ACCEPTED
from pipeline.detection.still_window import (
    MAX_MISSED,
    WINDOW,
    StillWindow,
    Stretch,
    kept_by_line,
    still_window,
    true_lag1,
)

STEP = 6
"""Sightings by which a window that was not still moves on."""
HOPELESS_PX = 2.0
"""Predicted sigma of what is hardly a quad; such tags say nothing on pixels."""
SIZES_PX = (0.0, 25.0, 50.0, 100.0, math.inf)
"""Borders of the size classes, mean side of the quad."""
RATIO_HIGH = 1.5
"""A ratio above it by more than chance warns."""
SURE = 1.96
"""Half width of the interval of a ratio, in its standard deviations: 95 %."""
FEW_WINDOWS = 6
"""Below this many, the spread among windows is not known well enough to say how certain their median is."""
BIN = 0.01
"""Width of a bin of the histograms that stand for the windows, in natural logarithms: 0.5 % of a ratio."""

Tag = tuple[str, int]
"""Family and id."""


@dataclass(frozen=True)
class SizeClass:
    """Sides from `low_px` up to `high_px`, exclusive."""

    low_px: float
    high_px: float

    def __str__(self) -> str:
        if not self.low_px:
            return f"under {self.high_px:g} px"
        if math.isinf(self.high_px):
            return f"{self.low_px:g} px and more"
        return f"{self.low_px:g} to {self.high_px:g} px"


SIZE_CLASSES = tuple(SizeClass(low, high) for low, high in pairwise(SIZES_PX))


@dataclass(frozen=True)
class Scatter:
    """Corners of some tags while nothing moved."""

    frames: int
    """Different frames in which one of them stood still."""
    tags: int
    """Different tags."""
    corners: int
    """Corners measured, all frames and tags."""
    outliers: int
    """Tags in frames that were left out, far off their line."""
    side_px: float
    """Mean side."""
    scatter_px: float
    """Noise of a corner beside the shake, RMS per axis."""
    predicted_px: float
    """RMS per axis of the predicted covariances."""
    ratio: float
    """Noise over prediction, both with their shape: root mean square of the whitened residuals beside the shake."""
    ratio_low: float
    """Lower end of its 95 % interval."""
    ratio_high: float
    lag1: float
    """Correlation of the noise from frame to frame."""
    shake_px: float
    """Of a whole tag, RMS per axis; what its corners' noise leaves in their mean is part of it."""
    shake_ratio: float
    """Shake over what the predicted noise of the corners gives their mean."""
    shake_low: float
    """Lower end of its 95 % interval."""


class Stillness:
    """Finds the still stretches of one camera's tags in portions of the table `detections`.

    The portions come in time order; where they are cut makes no difference.
    """

    def __init__(self) -> None:
        self.at_rest = 0
        """Tags in frames that stood still: rows of the table."""
        self._waiting: dict[Tag, Stretch] = {}
        self._windows: dict[tuple[Tag, SizeClass], _Windows] = {}
        self._recent: dict[SizeClass, set[int]] = {size: set() for size in SIZE_CLASSES}
        self._frames: Counter[SizeClass] = Counter()

    def add(self, columns: Mapping[str, np.ndarray]) -> None:
        """Look at the next rows of the table `detections`, in order of their frames."""
        for tag, stretch in _by_tag(columns):
            if tag in self._waiting:
                stretch = self._waiting.pop(tag).joined(stretch)
            self._waiting[tag] = self._measure(tag, stretch)
        if not len(columns["frame"]):
            return
        # A tag that is away for long begins a new window anyway; what lies before all that wait is settled.
        alive = int(columns["frame"][-1]) - MAX_MISSED
        self._waiting = {tag: s for tag, s in self._waiting.items() if len(s) and s.frame[-1] >= alive}
        settled = min((int(s.frame[0]) for s in self._waiting.values()), default=np.iinfo(np.int64).max)
        for size, frames in self._recent.items():
            late = {frame for frame in frames if frame >= settled}
            self._frames[size] += len(frames) - len(late)
            self._recent[size] = late

    def by_size(self) -> dict[SizeClass, Scatter]:
        """The scatter by size class; only those in which something stood still."""
        found = {}
        for size in SIZE_CLASSES:
            mine = [windows for (_, of_size), windows in self._windows.items() if of_size == size]
            if mine:
                frames = self._frames[size] + len(self._recent[size])
                found[size] = _scatter(mine, len(mine), frames)
        return found

    def by_tag(self) -> dict[tuple[Tag, SizeClass], Scatter]:
        """The scatter of each tag in each size class, in order."""
        ordered = sorted(self._windows, key=lambda key: (key[0], key[1].low_px))
        return {key: _scatter([self._windows[key]], 1, WINDOW * self._windows[key].count) for key in ordered}

    def _measure(self, tag: Tag, stretch: Stretch) -> Stretch:
        """Use up the windows of a tag; what is left is too short for one."""
        start = 0
        breaks = np.flatnonzero(~_follows(stretch.frame)) + 1
        for end in [*breaks.tolist(), len(stretch)]:
            while start + WINDOW <= end:
                part = stretch.part(start, start + WINDOW)
                window = still_window(part)
                if window is None:
                    start += STEP
                    continue
                start += WINDOW
                size = next(c for c in SIZE_CLASSES if window.side_px < c.high_px)
                self._windows.setdefault((tag, size), _Windows()).add(window)
                self._recent[size].update(part.frame.tolist())
                self.at_rest += WINDOW
            if end < len(stretch):
                start = end
        return stretch.part(start, len(stretch))


def _by_tag(columns: Mapping[str, np.ndarray]) -> Iterator[tuple[Tag, Stretch]]:
    """The accepted tags of some rows with usable covariances, one by one."""
    kept = np.flatnonzero(columns["status"] == ACCEPTED)
    uv = np.stack([np.stack([columns[f"{x}{k}"][kept] for x in "uv"], axis=-1) for k in range(4)], axis=1)
    uu, uw, ww = (
        np.stack([columns[f"cov{k}_{name}"][kept] for k in range(4)], axis=1) for name in ("uu", "uv", "vv")
    )
    cov = np.stack([np.stack([uu, uw], axis=-1), np.stack([uw, ww], axis=-1)], axis=-2)
    sound = (uu > 0) & (uu * ww > uw**2) & (uu + ww < 2 * HOPELESS_PX**2)
    good = np.all(sound, axis=1) & np.all(np.isfinite(uv), axis=(1, 2))
    kept, uv, cov = kept[good], uv[good], cov[good]
    family, number = columns["family"][kept], columns["tag_id"][kept]
    for tag in sorted(set(zip(family.tolist(), number.tolist()))):
        rows = np.flatnonzero((number == tag[1]) & (family == tag[0]))
        mine = kept[rows]
        yield tag, Stretch(columns["frame"][mine], uv[rows], cov[rows], columns["side_px"][mine])


def _follows(frame: np.ndarray) -> np.ndarray:
    """(n - 1,) whether each sighting belongs to the same stretch as the one before."""
    step = np.diff(frame.astype(np.int64))
    return (step > 0) & (step <= MAX_MISSED + 1)


def facts(stillness: Stillness) -> dict[str, Any]:
    """The scatter of one camera as plain JSON: ``sizes`` and ``tags``, lists of the fields of `Scatter`."""

    def size_of(size: SizeClass) -> dict[str, Any]:
        return {
            "size": str(size),
            "low_px": size.low_px,
            "high_px": size.high_px if math.isfinite(size.high_px) else None,
        }

    return {
        "sizes": [{**size_of(size), **asdict(found)} for size, found in stillness.by_size().items()],
        "tags": [
            {"family": family, "tag_id": number} | size_of(size) | asdict(found)
            for ((family, number), size), found in stillness.by_tag().items()
        ],
    }


def warnings(camera: str, stillness: Stillness) -> list[str]:
    """A sentence for each size class whose noise is surely above what was predicted."""
    said = []
    for size, found in stillness.by_size().items():
        if found.ratio_low > RATIO_HIGH:
            said.append(
                f"camera '{camera}', tags of {size}: while nothing moves their corners scatter {found.ratio:.1f} "
                f"times as much as predicted ({found.scatter_px:.3f} px, predicted {found.predicted_px:.3f} px); "
                "strong compression, heat haze or a rolling shutter with vibration may be why, and what rests on this "
                "camera is less certain than stated"
            )
    return said


MEDIANS = ("side_px", "noise", "noise_px2", "predicted_px2", "shake", "shake_px2")
"""Fields of a window of which the median over windows is wanted."""


@dataclass
class _Windows:
    """The windows of one tag and size class; a few numbers, however many there are."""

    count: int = 0
    outliers: int = 0
    lag1: float = 0.0
    values: dict[str, Counter[int]] = field(default_factory=lambda: {name: Counter() for name in MEDIANS})
    """Field of a window -> histogram of its logarithm, in bins of `BIN`."""

    def add(self, window: StillWindow) -> None:
        self.count += 1
        self.outliers += window.outliers
        self.lag1 += window.lag1
        for name, histogram in self.values.items():
            histogram[math.floor(math.log(max(getattr(window, name), 1e-12)) / BIN)] += 1


def _scatter(parts: Sequence[_Windows], tags: int, frames: int) -> Scatter:
    """What the windows of some tags say together."""
    count = sum(part.count for part in parts)
    outliers = sum(part.outliers for part in parts)
    lag1 = true_lag1(sum(part.lag1 for part in parts) / count)
    kept = kept_by_line(lag1)
    median = {name: _quantile([part.values[name] for part in parts], 0.5) for name in MEDIANS}
    ratio, shake_ratio = math.sqrt(median["noise"] / kept), math.sqrt(median["shake"])
    sigma = _log_sigma(parts, "noise", 6 * frames * (1 - lag1**2) / (1 + lag1**2))
    return Scatter(
        frames=frames,
        tags=tags,
        corners=4 * (WINDOW * count - outliers),
        outliers=outliers,
        side_px=median["side_px"],
        scatter_px=math.sqrt(median["noise_px2"] / kept),
        predicted_px=math.sqrt(median["predicted_px2"]),
        ratio=ratio,
        ratio_low=ratio * math.exp(-SURE * sigma),
        ratio_high=ratio * math.exp(SURE * sigma),
        lag1=lag1,
        shake_px=math.sqrt(median["shake_px2"]),
        shake_ratio=shake_ratio,
        shake_low=shake_ratio * math.exp(-SURE * _log_sigma(parts, "shake", 2 * frames)),
    )


def _log_sigma(parts: Sequence[_Windows], name: str, values: float) -> float:
    """Standard deviation of the logarithm of a ratio: from how many values it rests on, or from the windows' spread.

    Tags that are seen in the same frame count once: what troubles one of them may trouble all.
    """
    sigma = 1 / math.sqrt(2 * values * (1 - 2 / WINDOW))
    count = sum(part.count for part in parts)
    if count >= FEW_WINDOWS:
        low, high = (_quantile([part.values[name] for part in parts], share) for share in (0.25, 0.75))
        # The quartiles of a normal distribution lie 1.349 sigmas apart, and its median errs by 1.2533 / sqrt(n);
        # half, for the root.
        sigma = max(sigma, 1.2533 * math.log(high / low) / 1.349 / 2 / math.sqrt(count))
    return sigma


def _quantile(histograms: Sequence[Counter[int]], share: float) -> float:
    """A quantile of values that histograms of their logarithms stand for."""
    whole: Counter[int] = Counter()
    for histogram in histograms:
        whole.update(histogram)
    wanted, below = share * whole.total(), 0
    for number in sorted(whole):
        if below + whole[number] >= wanted:
            return math.exp(BIN * (number + (wanted - below) / whole[number]))
        below += whole[number]
    raise AssertionError("no values")
