"""Covariance of a detected corner, from the shape of its quad.

A corner is where two fitted edges meet, so what errs is an edge, along its normal, near that corner. Three causes add:

- a floor from image noise and JPEG;
- what lies one cell away inside the print, which pulls at the edge as soon as cells are narrow: it falls with the width
  of a cell across the edge;
- the other edge of the corner where they do not meet at a right angle: an acute corner is found too far out, an
  obtuse one too far in, by less the longer the edge is.

RMS error per axis in px, `make bench-corner-noise` (tag36h11, lens blur 0.5 to 0.8 px, noise 1 to 3 grey values, JPEG
quality 75 to 90, contrast 90 to 195), and in brackets the mean error away from the tag's centre:

    side px    facing           45 degrees       60 degrees
      16      .144 (-.10)     .188 (-.09)     .283 (-.20)
      20      .094 (-.07)     .140 (-.09)     .205 (-.10)
      25      .052 (-.04)     .093 (-.05)     .158 (-.06)
      30      .028 (-.01)     .059 (-.03)     .125 (-.05)
      40      .022 ( .00)     .027 ( .00)     .073 (-.01)
      60      .020 ( .00)     .021 ( .00)     .036 (+.01)
      80      .021 ( .00)     .023 ( .00)     .026 ( .00)
     120      .022 ( .00)     .024 ( .00)     .027 ( .00)
     160      .018 ( .00)     .020 ( .00)     .024 ( .00)

The error of a small tag is mostly a bias that all its corners share: the tag looks smaller than it is. It is not
corrected, because it follows the blur of the lens, which nobody has measured here: at 20 px it is -0.05 px with a blur
of 0.4 px, -0.09 with 0.8 and -0.16 with 1.2. A correction for the mean blur would take the RMS at 20 px from 0.094
to 0.08 only. The sigma covers the bias (it is fitted to the RMS), but the bias repeats from frame to frame and does
not average out as noise does: a distance from one tag under 30 px is never better than its sigma in one frame.
Beyond the measured blur the sigma is too small: with 1.2 px by 2 to 3 under 30 px, by 1.3 at 60 px.
At 60 degrees fewer than a tenth of 16 px tags are found, and half of 20 px ones.
Not measured: motion blur, mosaic sensors, bent or dirty prints. The
robust loss of the adjustment is for those.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class EdgeNoise:
    """Standard deviation of a fitted edge near one of its corners; fitted to rendered tags by maximum likelihood."""

    floor_px: float = 0.0214
    """Wide and right-angled tags."""
    cell_px: float = 0.244
    """Of cells without width; falls as ``exp(-(width / cell_scale_px) ** cell_power)``."""
    cell_scale_px: float = 2.57
    cell_power: float = 2.24
    skew_px: float = 1.37
    """Per cotangent of the corner's angle; falls as ``exp(-(length / skew_scale_px) ** skew_power)``."""
    skew_scale_px: float = 5.13
    skew_power: float = 0.61


NO_QUAD_PX2 = 100.0
"""Variance of the corners of what is hardly a quad; only mistaken decodings look like that."""


def corner_covariance(uv: np.ndarray, cells: np.ndarray | int, noise: EdgeNoise | None = None) -> np.ndarray:
    """Covariance of each corner of some quads.

    Parameters
    ----------
    uv : (n, 4, 2) array
        Corners in order around the quad, px.
    cells : int or (n,) int array
        Width of each quad in cells of its family, see `prints.cells_across`.
    noise : EdgeNoise
        The model of edges.

    Returns
    -------
    (n, 4, 2, 2) array
        px².
    """
    uv = np.asarray(uv, float)
    along = np.roll(uv, -1, axis=1) - uv  # edge k runs from corner k to corner k + 1
    length = np.maximum(np.linalg.norm(along, axis=-1), 1e-9)
    along = along / length[..., None]
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    width = widths_across(uv) / np.broadcast_to(np.asarray(cells, float)[..., None], length.shape)
    before = np.roll(along, 1, axis=1)
    cosine = np.einsum("...i,...i->...", before, along)
    sine = np.abs(before[..., 0] * along[..., 1] - before[..., 1] * along[..., 0])
    flat = sine < 0.1
    cotangent = np.abs(cosine) / np.maximum(sine, 0.1)

    # At each corner: the edge that ends there and the one that begins there.
    both = [
        edge_sigma(np.roll(width, 1, axis=1), np.roll(length, 1, axis=1), cotangent, noise),
        edge_sigma(width, length, cotangent, noise),
    ]
    N = np.stack([np.roll(normal, 1, axis=1), normal], axis=-2)
    N = np.where(flat[..., None, None], np.eye(2), N)
    N_inverse = np.linalg.inv(N)
    cov = np.einsum("...ij,...j,...kj->...ik", N_inverse, np.stack(both, axis=-1) ** 2, N_inverse)
    return np.where(flat[..., None, None], NO_QUAD_PX2 * np.eye(2), cov)


def edge_sigma(
    cell_width_px: np.ndarray, length_px: np.ndarray, cotangent: np.ndarray, noise: EdgeNoise | None = None
) -> np.ndarray:
    """Standard deviation of an edge along its normal, near one corner, px.

    Parameters
    ----------
    cell_width_px : array
        Width of a cell across the edge.
    length_px : array
        Of the edge.
    cotangent : array
        Of the corner's angle, absolute; 0 at a right angle.
    noise : EdgeNoise
        The model.
    """
    p = noise or EdgeNoise()
    cell = p.cell_px * np.exp(-((cell_width_px / p.cell_scale_px) ** p.cell_power))
    skew = p.skew_px * cotangent * np.exp(-((length_px / p.skew_scale_px) ** p.skew_power))
    return np.sqrt(p.floor_px**2 + cell**2 + skew**2)


def widths_across(uv: np.ndarray) -> np.ndarray:
    """(n, 4) width of each quad across edge k (corner k to k + 1), px: mean distance of the two other corners."""
    uv = np.asarray(uv, float)
    along = np.roll(uv, -1, axis=1) - uv
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    normal /= np.maximum(np.linalg.norm(along, axis=-1), 1e-9)[..., None]
    far = 0.5 * (np.roll(uv, -2, axis=1) + np.roll(uv, -3, axis=1))
    return np.abs(np.einsum("...i,...i->...", far - uv, normal))
