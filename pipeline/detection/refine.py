"""Corners at the noise floor: the known print is laid over the picture until every grey value agrees.

A tag's decoded quad gives the start; its print, place, light, blur and the camera's response (`image_model`) are then
adjusted together by Gauss-Newton steps, first on a part of the pixels, then on all that feel an edge. Cells whose grey
values stand out from the rest (mud, a rope, a shadow's edge, a hand) are left out with their neighbourhood, so that the
corners beside them rest on the rest of the print. The covariance of the corners is that of the fit, all 8 x 8 of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.detection.alignment import (
    BLUR_PX,
    CONTRAST,
    MAX_CELLS,
    MISFIT_AT,
    MOTION_PX,
    NOISE,
    REASON,
    RESPONSE_AT,
    RESULTS,
    WHOLE,
    align_all,
)
from pipeline.detection.image_model import PARAMETERS
from pipeline.detection.prints import print_of
from pipeline.detection.straightening import TERMS, Straightening

NO_CONTRAST = "no contrast"
MISFIT = "does not fit"
COVERED = "covered"
TOO_SMALL = "too small"
CUT = "cut by the border"
OVER_EXPOSED = "over-exposed"
UNDER_EXPOSED = "under-exposed"
BLURRED = "blurred"
ALL_PIXELS = 12_000
"""More than tags of 250 px have on their edges."""
Room = tuple[np.ndarray, np.ndarray, np.ndarray]
REASONS = ("", NO_CONTRAST, MISFIT, COVERED, TOO_SMALL, CUT, OVER_EXPOSED, UNDER_EXPOSED, BLURRED)
"""By the numbers of `alignment`."""


@dataclass(frozen=True)
class Refined:
    """Tags of one picture after refinement; the fields of a tag that does not stand are those of its last try."""

    uv: np.ndarray
    """(n, 4, 2) corners top-left, top-right, bottom-right, bottom-left, as the lens shows them; px."""
    cov: np.ndarray
    """(n, 8, 8) covariance of u0 v0 u1 v1 u2 v2 u3 v3; px²."""
    blur_px: np.ndarray
    """(n,) standard deviation of the blur, mean over the directions, without the pixel's own."""
    motion_px: np.ndarray
    """(n,) length of the streak whose variance is what the blur has more one way than the other."""
    noise: np.ndarray
    """(n,) residual on edges, grey values."""
    contrast: np.ndarray
    """(n,) grey values from black to white."""
    whole: np.ndarray
    """(n,) share of the print's cells that were used."""
    misfit: np.ndarray
    """(n,) what the residuals of neighbouring pixels share, as a share of the print's pattern; see `MISFIT_MOST`."""
    reason: np.ndarray
    """(n,) object array: "" where the fit stands, else one of `REASONS`."""
    response: np.ndarray
    """(n,) q of the camera's response."""

    def __len__(self) -> int:
        return len(self.uv)


@dataclass(frozen=True)
class Prior:
    """What is known of blur and response before a tag is looked at."""

    blur_px: float = 0.8
    sigma_variance_px2: float = 1.0
    """Standard deviation of the blur's variance."""
    sigma_streak_px2: float = 0.3
    """Standard deviation of what the blur has more one way than the other."""
    response: float = 0.0
    sigma_response: float = 0.3
    """Cameras record about the square root of the light: on photographs 0.25 to 0.55 was found, on sharpened ones 0.
    Left free it costs nothing: the errors of rendered tags did not grow by 1 %."""


class Refiner:
    """Refinement for one camera.

    Parameters
    ----------
    intrinsics : (9,) array or None
        Of the camera, order of `pipeline.geometry.camera`. The print's edges are straight before the lens bends them;
        without intrinsics they are taken for straight in the picture.
    prior : Prior
        Of blur and response.
    """

    def __init__(self, intrinsics: np.ndarray | None = None, prior: Prior | None = None):
        p = prior or Prior()
        self._prior = np.array(
            [p.blur_px, p.sigma_variance_px2, p.sigma_streak_px2, p.response, p.sigma_response]
        )
        bends = intrinsics is not None and bool(np.any(np.asarray(intrinsics)[4:]))
        self._intrinsics = np.asarray(intrinsics, float) if bends else None
        self._rooms: tuple[Room, Room] | None = None
        self._straightening: dict[tuple[int, ...], Straightening] = {}

    def refine(
        self,
        grey: np.ndarray,
        family: Sequence[str],
        tag_id: Sequence[int],
        uv: np.ndarray,
        pixels: int = ALL_PIXELS,
    ) -> Refined:
        """Corners of tags whose ids are known and whose places nearly so.

        Parameters
        ----------
        grey : (H, W) uint8 array
            The picture.
        family, tag_id : (n,) sequences
            What is printed.
        uv : (n, 4, 2) array
            Start, within about half a cell of the truth; px.
        pixels : int
            About how many pixels on edges are used for each tag at the most.

        Returns
        -------
        Refined
        """
        uv = np.ascontiguousarray(uv, float).reshape(-1, 4, 2)
        n = len(uv)
        corners, cov, results = np.empty((n, 4, 2)), np.zeros((n, 8, 8)), np.zeros((n, RESULTS))
        if n:
            prints, across = _padded(tuple(zip(family, tag_id)))
            align_all(
                grey, prints, across, self._lenses(uv, grey.shape), self._intrinsics is not None, uv, self._prior,
                pixels, self._rooms_for(pixels), corners, cov, results,
            )  # fmt: skip
        return Refined(
            uv=corners,
            cov=cov,
            blur_px=results[:, BLUR_PX],
            motion_px=results[:, MOTION_PX],
            noise=results[:, NOISE],
            contrast=results[:, CONTRAST],
            whole=results[:, WHOLE],
            misfit=results[:, MISFIT_AT],
            response=results[:, RESPONSE_AT],
            reason=np.array([REASONS[int(code)] for code in results[:, REASON]], object),
        )

    def _rooms_for(self, pixels: int) -> tuple[Room, Room]:
        # Noisy tags take up to nine times as many pixels, and as many again lie off the edges. The system gives memory
        # page by page as it is used, so that room for many costs nothing; asked for anew it would cost for each tag.
        rows = 20 * pixels + 100
        if self._rooms is None or len(self._rooms[0][1]) < rows:
            a, b = (
                (np.empty((rows, PARAMETERS)), np.empty(rows), np.empty((rows, 3), np.int32))
                for _ in range(2)
            )
            self._rooms = a, b
        return self._rooms

    def _lenses(self, uv: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        if self._intrinsics is None:
            return np.zeros((len(uv), TERMS + 2, 2))
        if shape not in self._straightening:
            self._straightening[shape] = Straightening(self._intrinsics, (shape[0], shape[1]))
        return self._straightening[shape].windows(uv)


@lru_cache(maxsize=4096)
def _padded(tags: tuple[tuple[str, int], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Prints in grids of `MAX_CELLS`, as every family has them; cells across each, and across its quad."""
    prints, across = np.zeros((len(tags), MAX_CELLS, MAX_CELLS)), np.empty((len(tags), 2), np.int64)
    for k, (family, tag_id) in enumerate(tags):
        of = print_of(family, tag_id)
        prints[k, : len(of.cells), : len(of.cells)] = of.cells
        across[k] = len(of.cells), of.border
    return prints, across
