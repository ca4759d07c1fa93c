"""One tag over a few frames: whether it stood still, and how its corners scattered then.

A window is held against a straight line in each coordinate, so that a slow drift (a tripod that sinks, a mount that
warms up) is no scatter. It counts as still when

- what the line covers is not above what noise alone gives it (`SLOPE_SIGMAS`) and `DRIFT_FLOOR_PX`;
- what is left is below `FEW_SIGMAS` predicted sigmas and `FLOOR_PX`: a machine that vibrates by 2 px is not still;
- neighbouring frames do not err nearly alike (`MAX_LAG1`): what is that smooth is a motion, not noise;
- at most `MAX_OUTLIERS` of its frames lie far off, and those are left out.

What is left is whitened with the predicted covariances and taken apart: the shift that the four corners of a tag share
(their mean with the covariances' weights, 2 of 8 degrees of freedom) is its **shake**, the rest is its **noise**. Both
have a mean square of 1 if the prediction is right. They are kept apart because on a machine whose engine runs the shake
is real, and the adjustment follows it: in the sample log the two together are 2.2 and 4.0 times the prediction, the
noise alone 0.57 and 0.66 times.

The four corners are taken as independent, which a fit to a whole print does not make them (correlations up to 0.4):
where the 8x8 covariance of such a fit is right, its 2x2 blocks come out at 1.09 in noise and 0.67 in shake, not at 1.

Noise whose neighbours are alike loses part of its scatter to the line: with a correlation of 0.5 from frame to frame
8 % of its RMS, with 0.7 17 %. `true_lag1` and `kept_by_line` make that good, with what noise of first-order
autoregression is expected to leave.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

WINDOW = 24
"""Sightings that are judged together: long enough to tell noise from motion, and 2.4 s of a 10 Hz camera."""
MAX_MISSED = 2
"""Frames without the tag that a window bears between two sightings."""
MAX_OUTLIERS = 2
FAR_OFF = 6.0
"""A coordinate this many robust sigmas off its line makes its frame an outlier; good noise has one in 5e8."""
FEW_SIGMAS, FLOOR_PX = 3.0, 0.3
"""Scatter up to which a tag is still: so many predicted sigmas plus this; more is a machine that moves or vibrates."""
SLOPE_SIGMAS, DRIFT_FLOOR_PX = 4.0, 0.05
"""The floor, in px over the window, is a drift too small to bend noticeably within it."""
MAX_LAG1 = 0.7
"""A parabola leaves 0.83, a sine of 12 frames 0.89, white noise -0.09; noise with a correlation of 0.7 leaves 0.52."""
STUCK = 1e-6
"""Mean square of the whitened noise below which a camera repeats one picture: the same bytes give the same corners."""


@dataclass(frozen=True)
class Stretch:
    """One tag in n frames."""

    frame: np.ndarray
    """(n,) ascending."""
    uv: np.ndarray
    """(n, 4, 2) px."""
    cov: np.ndarray
    """(n, 4, 2, 2) px²."""
    side_px: np.ndarray
    """(n,)"""

    def __len__(self) -> int:
        return len(self.frame)

    def part(self, start: int, end: int) -> Stretch:
        """Those from `start` up to `end`, exclusive."""
        return Stretch(
            self.frame[start:end], self.uv[start:end], self.cov[start:end], self.side_px[start:end]
        )

    def joined(self, later: Stretch) -> Stretch:
        """These and then those."""
        pairs = zip(vars(self).values(), vars(later).values())
        return Stretch(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class StillWindow:
    """What one still window gives."""

    side_px: float
    noise: float
    """Mean square of the whitened residuals beside the shake; 1 expected."""
    noise_px2: float
    """The same per axis, px²."""
    predicted_px2: float
    """Predicted variance per axis."""
    shake: float
    """Mean square of the whitened shake; 1 expected where nothing shakes."""
    shake_px2: float
    lag1: float
    """Correlation of the noise from frame to frame, as the line leaves it."""
    outliers: int
    """Frames that were left out."""


def still_window(window: Stretch) -> StillWindow | None:
    """The scatter of `WINDOW` sightings, or None where the tag was not still."""
    n = len(window)
    uv = window.uv.reshape(n, 8)
    # Most windows of a working machine end here, at a tenth of the price.
    moved = np.abs(np.sort(uv[-3:], axis=0)[1] - np.sort(uv[:3], axis=0)[1])
    cov = window.cov.mean(axis=0)
    sigma = np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2)
    still = FEW_SIGMAS * sigma + FLOOR_PX
    if np.any(moved.reshape(4, 2) > 10 * still[:, None]):
        return None
    t = window.frame - window.frame.mean()
    far = _far_off(t, uv)
    if far.sum() > MAX_OUTLIERS:
        return None
    t, uv = t[~far], uv[~far]
    t = t - t.mean()
    slope = t @ uv / (t @ t)
    residual = (uv - uv.mean(axis=0) - t[:, None] * slope).reshape(-1, 4, 2)
    left = len(t) - 2
    variance = (residual**2).sum(axis=0) / left
    near = np.diff(window.frame[~far]) == 1
    if np.any(np.sqrt(variance.mean(axis=1)) > still) or near.sum() < n / 2:
        return None

    W = np.linalg.inv(np.linalg.cholesky(cov))  # (4, 2, 2): takes a residual to unit covariance
    whitened = np.einsum("kij,nkj->nki", W, residual)
    if np.mean(whitened**2) < STUCK:
        return None
    smooth = _lag1(whitened, near)
    alike = min(max(true_lag1(smooth), 0.0), MAX_LAG1)
    drift = np.linalg.norm(slope.reshape(4, 2), axis=1) * (t[-1] - t[0])
    drift_sigma = np.sqrt(variance.max(axis=1) * (1 + alike) / (1 - alike) / (t @ t)) * (t[-1] - t[0])
    if smooth > MAX_LAG1 or np.any(drift > SLOPE_SIGMAS * drift_sigma + DRIFT_FLOOR_PX):
        return None

    information = np.swapaxes(W, -1, -2) @ W
    whole = information.sum(axis=0)
    of_mean = np.linalg.inv(whole)
    shake = np.einsum("kij,nkj->ni", information, residual) @ of_mean
    predicted = float(np.mean(sigma**2))
    noise = whitened - np.einsum("kij,nj->nki", W, shake)
    return StillWindow(
        side_px=float(np.median(window.side_px)),
        noise=float(np.sum(noise**2)) / (6 * left),
        # Beside a mean with the weights of C, a corner keeps tr(C) - tr(C of the mean) of its variance.
        noise_px2=predicted
        * float(np.sum((residual - shake[:, None]) ** 2))
        / left
        / float(8 * predicted - 4 * np.trace(of_mean)),
        predicted_px2=predicted,
        shake=float(np.einsum("ni,ij,nj->", shake, whole, shake)) / (2 * left),
        shake_px2=float(np.sum(shake**2)) / (2 * left),
        lag1=_lag1(noise, near),
        outliers=int(far.sum()),
    )


def _far_off(t: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(n,) whether a frame has a coordinate far off a line that outliers do not bend."""
    third = len(t) // 3
    early, late = slice(None, third), slice(-third, None)
    rise = np.median(uv[late], axis=0) - np.median(uv[early], axis=0)
    rest = uv - t[:, None] * rise / (np.median(t[late]) - np.median(t[early]))
    rest = np.abs(rest - np.median(rest, axis=0))
    sigma = 1.4826 * np.median(rest, axis=0)
    # A coordinate whose 24 values happen to lie close must not find outliers where its neighbours have none.
    sigma = np.maximum(sigma, np.sqrt(np.mean(sigma**2)))
    return np.any(rest > FAR_OFF * np.maximum(sigma, 1e-9), axis=1)


def _lag1(residual: np.ndarray, near: np.ndarray) -> float:
    """Mean product of neighbours (`near`: (n - 1,), whether in frames next to one another) over the mean square."""
    products = np.sum(residual[1:] * residual[:-1], axis=(1, 2))[near].mean()
    return float(products / np.sum(residual**2, axis=(1, 2)).mean())


@cache
def _line_losses() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True lag-1 correlations, what a line through a window leaves of them, and of the variance.

    With ``R = rho ** lag`` the covariance of the noise and ``M`` the projection that takes a line away, the residuals
    have the covariance ``M R M``.
    """
    t = np.arange(WINDOW)
    line = np.stack([np.ones(WINDOW), t - t.mean()], axis=1)
    M = np.eye(WINDOW) - line @ np.linalg.pinv(line)
    lag = np.abs(t[:, None] - t)
    true = np.linspace(-0.95, 0.95, 191)
    seen, kept = np.empty_like(true), np.empty_like(true)
    for k, rho in enumerate(true):
        left = M @ rho**lag @ M
        seen[k] = np.mean(np.diagonal(left, 1)) / np.mean(np.diagonal(left))
        kept[k] = np.trace(left) / (WINDOW - 2)
    return true, seen, kept


def true_lag1(seen: float) -> float:
    """Lag-1 correlation of noise whose residuals from a line have the correlation `seen`."""
    true, left, _ = _line_losses()
    return float(np.interp(seen, left, true))


def kept_by_line(lag1: float) -> float:
    """Part of the variance of noise with that correlation that is found beside the line, 1 for white noise."""
    true, _, kept = _line_losses()
    return float(np.interp(lag1, true, kept))
