"""What an error of the intrinsics does to a tag: how far from its place it is seen, in metres at the working distance.

A small tag faces the camera at a given distance, all over the picture in turn. Wrong intrinsics shift its corners, and
its place follows: across the view by the direction of its rays, along it by its size in the picture (0.1 % of focal
length is 10 mm at 10 m). Its attitude is held: of a small tag that faces the camera the corners hardly tell it, and the
whole board does. A rotation of the whole picture is taken out, as mrcal does: mounts are calibrated and
benchmarks seen with the same intrinsics, and take it up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from pipeline.geometry import so3
from pipeline.geometry.lenses import Lens

TAG_PART = 0.03
"""Side of the tag as a part of its distance: 0.3 m at 10 m."""
COLUMNS = 15
"""Places across the picture; as many down as its shape asks for."""
CHANCE = 1e-3
"""Probability at which halves of a recording differ by more than chance."""
_NEWTON_STEPS = 6


@dataclass(frozen=True)
class Placing:
    """Standard deviations of a tag's place over the picture."""

    uv: np.ndarray
    """(r, c, 2) px."""
    across_m: np.ndarray
    """(r, c): root mean square of the two axes across the view."""
    along_m: np.ndarray
    """(r, c): towards or away from the camera."""
    worst_m: float
    total_m: float
    """Root mean square over the picture of the length of the error."""


@dataclass(frozen=True)
class Difference:
    """How far apart two calibrations place a tag, and how far they should."""

    uv: np.ndarray
    """(r, c, 2) px."""
    found_m: np.ndarray
    """(r, c): length of the difference."""
    predicted_m: np.ndarray
    """(r, c): root of its expected square, from both covariances."""
    ratio: float
    """Root mean square of what was found over that of what was predicted."""
    limit: float
    """Of the ratio, beyond which it is no chance."""

    @property
    def found_rms_m(self) -> float:
        """Over the picture."""
        return float(np.sqrt(np.mean(self.found_m**2)))

    @property
    def predicted_rms_m(self) -> float:
        """Over the picture."""
        return float(np.sqrt(np.mean(self.predicted_m**2)))

    @property
    def fits(self) -> bool:
        """Whether the two agree as well as their covariances say."""
        return self.ratio <= self.limit


def places_over(size: tuple[int, int]) -> np.ndarray:
    """(r, c, 2) pixels over a picture of (width, height) px, its borders too."""
    rows = max(round(COLUMNS * size[1] / size[0]), 3)
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, COLUMNS), np.linspace(0, size[1] - 1, rows))
    return np.stack([u, v], axis=-1)


def placing(
    lens: Lens, intrinsics: np.ndarray, covariance: np.ndarray, size: tuple[int, int], distance_m: float
) -> Placing:
    """Standard deviations of where a tag is seen, over the picture.

    Parameters
    ----------
    lens : Lens
        Its model.
    intrinsics : (n,) array
        In the model's order.
    covariance : (n, n) array
        Of the intrinsics.
    size : (width, height)
        Of the picture, px.
    distance_m : float
        From the camera to the tag.
    """
    uv = places_over(size)
    d, D = _displacement(lens, intrinsics, uv.reshape(-1, 2), distance_m)
    cov = D @ covariance @ np.swapaxes(D, 1, 2)
    along2 = np.einsum("gi,gij,gj->g", d, cov, d)
    all2 = np.trace(cov, axis1=1, axis2=2)
    shape = uv.shape[:2]
    return Placing(
        uv=uv,
        across_m=np.sqrt(np.maximum(all2 - along2, 0) / 2).reshape(shape),
        along_m=np.sqrt(np.maximum(along2, 0)).reshape(shape),
        worst_m=float(np.sqrt(np.nanmax(all2))),
        total_m=float(np.sqrt(np.nanmean(all2))),
    )


def difference(
    lens: Lens,
    one: tuple[np.ndarray, np.ndarray],
    other: tuple[np.ndarray, np.ndarray],
    size: tuple[int, int],
    distance_m: float,
) -> Difference:
    """How far apart two independent calibrations of one lens place a tag.

    Parameters
    ----------
    lens : Lens
        Its model.
    one, other : pairs of (n,) and (n, n) arrays
        Intrinsics and their covariance.
    size : (width, height)
        Of the picture, px.
    distance_m : float
        From the camera to the tag.
    """
    uv = places_over(size)
    flat = uv.reshape(-1, 2)
    d, D = _displacement(lens, one[0], flat, distance_m)
    p = _facing(d, distance_m)
    moved = _seen_with(lens, other[0], lens.project(p, one[0]), d, distance_m) - distance_m * d
    good = np.all(np.isfinite(moved), axis=1) & np.all(np.isfinite(D), axis=(1, 2))
    V = -so3.hat(d[good]).reshape(-1, 3)
    turn, *_ = np.linalg.lstsq(V, moved[good].ravel(), rcond=None)
    moved = moved + np.einsum("gij,j->gi", so3.hat(d), turn)
    cov = one[1] + other[1]
    predicted2 = np.einsum("gin,nm,gim->g", D, cov, D)
    # The mean square is a sum of squares with unequal weights: about a chi-square (Satterthwaite).
    root = np.linalg.cholesky(cov + 1e-15 * np.diag(np.diag(cov)))
    weights = np.linalg.eigvalsh(root.T @ np.einsum("gin,gim->nm", D[good], D[good]) @ root)
    degrees = weights.sum() ** 2 / np.sum(weights**2)
    found2 = np.sum(moved**2, axis=1)
    return Difference(
        uv=uv,
        found_m=np.sqrt(found2).reshape(uv.shape[:2]),
        predicted_m=np.sqrt(predicted2).reshape(uv.shape[:2]),
        ratio=float(np.sqrt(found2[good].sum() / predicted2[good].sum())),
        limit=float(np.sqrt(chi2.isf(CHANCE, degrees) / degrees)),
    )


def _facing(d: np.ndarray, distance_m: float) -> np.ndarray:
    """(g, 4, 3) corners of tags that face the camera, at a distance along unit vectors (g, 3)."""
    right = np.cross([0.0, 1.0, 0.0], d)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(d, right)
    half = 0.5 * TAG_PART * distance_m
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    around = signs[None, :, :1] * right[:, None] + signs[None, :, 1:] * down[:, None]
    return np.asarray(distance_m * d[:, None] + half * around)


def _displacement(
    lens: Lens, k: np.ndarray, uv: np.ndarray, distance_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Directions (g, 3) of pixels and how a tag there moves with the intrinsics, (g, 3, n), no rotation left in it."""
    d, _ = lens.directions(uv, k)
    p = _facing(d, distance_m)
    _, J_p, J_k = lens.project_with_jacobians(p, k)
    good = np.all(np.isfinite(J_k), axis=(1, 2, 3))
    D = np.full((len(d), 3, len(lens)), np.nan)
    J_x = J_p[good].reshape(-1, 8, 3)
    # More intrinsics shift the corners; the place that explains the same corners goes the other way.
    J_xt = np.swapaxes(J_x, 1, 2)
    moved = -np.linalg.solve(J_xt @ J_x, J_xt @ J_k[good].reshape(-1, 8, len(lens)))
    V = -so3.hat(d[good]).reshape(-1, 3)
    flat = moved.reshape(-1, len(lens))
    turn, *_ = np.linalg.lstsq(V, flat, rcond=None)
    D[good] = (flat - V @ turn).reshape(moved.shape)
    return d, D


def _seen_with(lens: Lens, k: np.ndarray, uv: np.ndarray, d: np.ndarray, distance_m: float) -> np.ndarray:
    """Where tags are seen (g, 3) whose corners are (g, 4, 2) px, by Gauss-Newton from where they face the camera."""
    around = _facing(d, distance_m) - distance_m * d[:, None]
    centre = distance_m * d
    for _ in range(_NEWTON_STEPS):
        found, J_p, _ = lens.project_with_jacobians(centre[:, None] + around, k)
        bad = ~np.all(np.isfinite(found), axis=(1, 2))
        J_x = np.where(bad[:, None, None, None], 0.0, J_p).reshape(-1, 8, 3)
        J_xt = np.swapaxes(J_x, 1, 2)
        miss = np.where(bad[:, None, None], 0.0, uv - found).reshape(-1, 8, 1)
        step = np.linalg.solve(J_xt @ J_x + 1e-12 * np.eye(3), J_xt @ miss)[..., 0]
        centre = np.where(bad[:, None], np.nan, centre + step)
    return centre
