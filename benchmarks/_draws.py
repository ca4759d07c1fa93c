"""Random views of tags for the benchmarks of seeing, and what became of each: found, refined, how far off."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks._tag_picture import Shot, View
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.refine import Refiner
from pipeline.detection.windows import POSSIBLE, locate

FRAME = (1280, 960)
IDS = {"tag36h11": 587, "tag25h9": 35, "tag16h5": 30, "tagStandard41h12": 2115}
NOT_FOUND = "not found"


def draw_view(rng: np.random.Generator, side_px: float, tilt_deg: float, family: str = "tag36h11") -> View:
    """A tag of given size and tilt anywhere in the frame of a lens, over the ranges that the bars speak of.

    Blur 0.5 to 1.5 px, noise 1 to 6 grey values, light slope 0 to 20 %, JPEG 70 to 95, contrast 60 to 195; k1 -0.15 to
    0.05 with focal lengths from 900 to 1731 px, so that edges bow by up to 1.5 px across a tag of 160 px.
    """
    focal = rng.uniform(900, 1731)
    lens = (
        focal,
        focal * rng.uniform(0.995, 1.005),
        FRAME[0] / 2 + rng.uniform(-15, 15),
        FRAME[1] / 2 + rng.uniform(-15, 15),
        rng.uniform(-0.15, 0.05),
        rng.uniform(0, 0.02),
        rng.uniform(-0.001, 0.001),
        rng.uniform(-0.001, 0.001),
        0.0,
    )
    black = rng.uniform(25, 60)
    return View(
        family,
        int(rng.integers(IDS[family])),
        side_px,
        tilt_deg,
        axis_deg=rng.uniform(0, 360),
        roll_deg=rng.uniform(0, 360),
        centre=(float(rng.uniform(150, FRAME[0] - 150)), float(rng.uniform(150, FRAME[1] - 150))),
        lens=lens,
        blur_px=rng.uniform(0.5, 1.5),
        noise=rng.uniform(1, 6),
        quality=int(rng.integers(70, 96)),
        black=black,
        white=black + rng.uniform(60, 160),
        slope=rng.uniform(0, 0.2),
        slope_deg=rng.uniform(0, 360),
    )


def fair_weather(view: View) -> View:
    """The same tag as a good camera sees it by day: blur 0.6, noise 2, JPEG 85, contrast 150, even light."""
    return replace(view, blur_px=0.6, noise=2.0, quality=85, black=40.0, white=190.0, slope=0.0)


@dataclass(frozen=True)
class Outcome:
    """What became of one view."""

    reason: str
    """"" where refined corners stand, else why not."""
    start_uv: np.ndarray
    """(4, 2) error of the corners that refinement began with, px; nan if not found."""
    error: np.ndarray
    """(4, 2) error of the refined corners, px; nan if they do not stand."""
    cov: np.ndarray
    """(8, 8) px²."""

    @property
    def stands(self) -> bool:
        """Whether there are corners to be believed."""
        return not self.reason

    def whitened(self) -> np.ndarray:
        """(8,) error divided by the root of its covariance."""
        return np.linalg.solve(np.linalg.cholesky(self.cov), self.error.ravel())

    def corner_distances(self) -> np.ndarray:
        """(4,) Mahalanobis distance of each corner by its own 2 x 2."""
        return np.sqrt([self.error[k] @ np.linalg.solve(self.block(k), self.error[k]) for k in range(4)])

    def corners_whitened(self) -> np.ndarray:
        """(8,) error of each corner divided by the root of its own 2 x 2."""
        halves = [np.linalg.solve(np.linalg.cholesky(self.block(k)), self.error[k]) for k in range(4)]
        return np.concatenate(halves)

    def block(self, k: int) -> np.ndarray:
        """(2, 2) covariance of one corner, px²."""
        return self.cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]


LOST = Outcome(NOT_FOUND, np.full((4, 2), np.nan), np.full((4, 2), np.nan), np.full((8, 8), np.nan))


def search(view: View, shot: Shot, finder: TagFinder) -> np.ndarray | None:
    """(4, 2) corners of the tag as the search finds it; None if it does not, or finds it twice."""
    found = finder.find(shot.grey)
    mine = np.flatnonzero((found.tag_id == view.tag_id) & (found.family == view.family))
    return found.uv[mine[0]] if len(mine) == 1 else None


def follow(view: View, shot: Shot, predicted: np.ndarray, reach_px: float) -> np.ndarray | None:
    """(4, 2) corners where the cells of the tag fit best around a prediction; None where they fit nowhere."""
    uv, score = locate(
        shot.grey, [view.family], [view.tag_id], predicted[None, None], np.array([1]), np.array([reach_px])
    )
    return uv[0] if score[0] >= POSSIBLE else None


def refine(view: View, shot: Shot, start: np.ndarray | None) -> Outcome:
    """The corners after refinement from a start."""
    if start is None:
        return LOST
    fit = Refiner(shot.intrinsics).refine(shot.grey, [view.family], [view.tag_id], start[None])
    reason = str(fit.reason[0])
    if not reason and not (np.all(np.isfinite(fit.cov[0])) and np.linalg.eigvalsh(fit.cov[0])[0] > 0):
        reason = "covariance is none"
    error = np.full((4, 2), np.nan) if reason else fit.uv[0] - shot.uv
    return Outcome(reason, start - shot.uv, error, fit.cov[0])


def rms(values) -> float:
    """Root of the mean square, nan of nothing."""
    values = np.asarray(values, float)
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
