"""Homographies: how points of one plane lie in a picture, or in another plane.

``H_target_source`` is ``(..., 3, 3)``: ``[x, y, 1]`` of the source times ``H`` is ``[w u, w v, w]`` of the target.
"""

import numpy as np

MOST_CONDITION = 1e13
"""Of the normal equations; points that do not fix a homography, as three of four on a line, have 1e16 and more."""


def from_points(xy_source, xy_target, weight=None):
    """Homography between points and their images, by the direct linear transform.

    After Hartley and Zisserman, Multiple View Geometry (2004), algorithm 4.2: least squares of the algebraic error in
    normalised coordinates. They take ``|h| = 1``; here the image of the source's mean has ``w = 1``, which leaves eight
    linear equations instead of an eigenvector, and is possible because a mean of points in view is in view.

    Parameters
    ----------
    xy_source, xy_target : (..., m, 2) arrays
        In any units; leading axes are batched over.
    weight : (..., m) array, optional
        Of the squared errors of each point, 0 for one that was not seen; at least four others, not three of them on a
        line. All 1 where left out.

    Returns
    -------
    H_target_source : (..., 3, 3) array
        ``w`` is positive on the points' side of the line that has no image, 1 at their weighted mean. nan where the
        points do not fix a homography.
    """
    p, q = np.asarray(xy_source, np.float64), np.asarray(xy_target, np.float64)
    weight = np.ones(p.shape[:-1]) if weight is None else np.asarray(weight, np.float64)
    p, _, to_source = _normalised(p, weight)
    q, to_target, _ = _normalised(q, weight)
    A = np.zeros(p.shape[:-1] + (2, 8))
    A[..., 0, 0:2], A[..., 0, 2] = p, 1.0
    A[..., 1, 3:5], A[..., 1, 5] = p, 1.0
    A[..., 6:8] = -q[..., :, None] * p[..., None, :]
    rows = A.reshape(A.shape[:-3] + (-1, 8))
    weighed = np.swapaxes((A * weight[..., None, None]).reshape(rows.shape), -1, -2)
    N = weighed @ rows
    b = (weighed @ q.reshape(rows.shape[:-1] + (1,)))[..., 0]
    finite = np.isfinite(N).all(axis=(-1, -2))
    spread = np.abs(np.linalg.eigvalsh(np.where(finite[..., None, None], N, 0.0)))
    fixed = (spread.max(axis=-1) < MOST_CONDITION * spread.min(axis=-1))[..., None]
    h = np.linalg.solve(np.where(fixed[..., None], N, np.eye(8)), np.where(fixed, b, np.nan)[..., None])[
        ..., 0
    ]
    H = np.concatenate([h, np.ones(h.shape[:-1] + (1,))], axis=-1).reshape(h.shape[:-1] + (3, 3))
    return to_target @ H @ to_source


def _normalised(xy, weight):
    """Points about their weighted mean, of order one; the (..., 3, 3) that leads back from them, and that to them."""
    total = weight.sum(-1)[..., None]
    mean = np.einsum("...m,...mi->...i", weight, xy) / total
    d = xy - mean[..., None, :]
    size = np.sqrt(np.einsum("...m,...mi,...mi->...", weight, d, d)[..., None] / total / 2)
    size = np.where(size > 0, size, 1.0)
    back = np.zeros(mean.shape[:-1] + (3, 3))
    back[..., [0, 1], [0, 1]] = size
    back[..., :2, 2] = mean
    back[..., 2, 2] = 1.0
    there = np.zeros_like(back)
    there[..., [0, 1], [0, 1]] = 1.0 / size
    there[..., :2, 2] = -mean / size
    there[..., 2, 2] = 1.0
    return d / size[..., None], back, there
