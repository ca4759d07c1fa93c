"""Which touch has a typing error, in which coordinate and of what size: data snooping after Baarda.

For an error of the shape ``h`` in the given coordinates, with the residuals ``v``, their weights ``P`` (the inverse of
the covariance of the noise) and ``Q_v = P^-1 - J cov J'``:

    w = h'P v / sqrt(h'P Q_v P h)   ~ N(0, 1) without it          size = h'P v / (h'P Q_v P h)

Tried are each coordinate of each touch, and of each known point, where one typing error is in all its touches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from pipeline.calibration.touches import Adjusted

RISK = 1e-3
"""That any of the coordinates is named though none is wrong."""
AXES = ("easting", "northing", "elevation")
UNSEEN = 1e-6
"""Share of an error that must show in the residuals for it to be looked for at all."""


@dataclass(frozen=True)
class Suspect:
    """One coordinate that may be wrong."""

    touch: int
    """Index of the touch, -1 if it is a known point's."""
    point: int
    """Index of the known point, -1 if it is a touch's."""
    axis: int
    """0 easting, 1 northing, 2 elevation."""
    w: float
    """Normalised; its sign is that of the error."""
    size_m: float
    """Given minus right."""
    sigma_m: float
    """Of the size."""
    critical: float
    """Bound of |w|."""

    @property
    def wrong(self) -> bool:
        return abs(self.w) > self.critical


def suspects(found: Adjusted, points: int) -> list[Suspect]:
    """Every coordinate with its test, the worst first.

    Parameters
    ----------
    found : Adjusted
        By `bucket.robust`, or by least squares.
    points : int
        Number of known points.
    """
    n = len(found.touches)
    shapes: list[tuple[int, int, int, np.ndarray]] = []
    for i in range(n):
        for axis in range(3):
            h = np.zeros(3 * n)
            h[3 * i + axis] = 1.0
            shapes.append((i, -1, axis, h))
    for k in range(points):
        of_point = np.array([touch.point == k for touch in found.touches])
        if of_point.sum() < 2:
            continue  # the same as that of its only touch
        for axis in range(3):
            h = np.zeros((n, 3))
            h[of_point, axis] = 1.0
            shapes.append((-1, k, axis, h.ravel()))
    P = np.linalg.inv(found.noise)
    Q = found.noise - found.J @ found.covariance @ found.J.T
    normal, spread = P @ found.residual.ravel(), P @ Q @ P
    critical = float(norm.isf(0.5 * RISK / max(len(shapes), 1)))
    tested = []
    for touch, point, axis, h in shapes:
        told = float(h @ spread @ h)
        if told < UNSEEN * float(h @ P @ h):
            continue
        seen = float(h @ normal)
        tested.append(
            Suspect(touch, point, axis, seen / np.sqrt(told), seen / told, 1.0 / np.sqrt(told), critical)
        )
    return sorted(tested, key=lambda s: -abs(s.w))
