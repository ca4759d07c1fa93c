"""Covariance of a detected corner, from the shape of its quad."""

from __future__ import annotations

import numpy as np

# Standard deviation of a fitted edge, px, by the width of the tag across that edge, px.
_WIDTH_PX = np.array([10.0, 14.0, 20.0, 28.0, 40.0, 80.0, 160.0])
_SIGMA_PX = np.array([0.20, 0.15, 0.09, 0.03, 0.015, 0.012, 0.012])


def corner_covariance(uv: np.ndarray) -> np.ndarray:
    """Covariance of each corner of some quads.

    A corner is where two fitted edges meet: an error of either along its normal moves the corner.

    Parameters
    ----------
    uv : (n, 4, 2) array
        Corners in order around the quad, px.

    Returns
    -------
    (n, 4, 2, 2) array
        px².
    """
    uv = np.asarray(uv, float)
    along = np.roll(uv, -1, axis=1) - uv  # edge k runs from corner k to corner k + 1
    length = np.linalg.norm(along, axis=-1)
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / length[..., None]
    width = widths_across(uv)
    sigma = edge_sigma(width)
    before = np.roll(normal, 1, axis=1)
    N = np.stack([before, normal], axis=-2)
    N_inverse = np.linalg.inv(N)
    variances = np.stack([np.roll(sigma, 1, axis=1), sigma], axis=-1) ** 2
    return np.einsum("...ij,...j,...kj->...ik", N_inverse, variances, N_inverse)


def widths_across(uv: np.ndarray) -> np.ndarray:
    """(n, 4) width of each quad across edge k (corner k to k + 1), px: mean distance of the two other corners."""
    uv = np.asarray(uv, float)
    along = np.roll(uv, -1, axis=1) - uv
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    normal /= np.linalg.norm(along, axis=-1)[..., None]
    far = 0.5 * (np.roll(uv, -2, axis=1) + np.roll(uv, -3, axis=1))
    return np.abs(np.einsum("...i,...i->...", far - uv, normal))


def edge_sigma(width_px: np.ndarray) -> np.ndarray:
    """Standard deviation of a fitted edge along its normal, px."""
    return np.exp(np.interp(np.log(width_px), np.log(_WIDTH_PX), np.log(_SIGMA_PX)))
