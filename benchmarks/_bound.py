"""The Cramer-Rao bound of a rendered tag's corners: how well its pixels can tell them at all.

From numeric derivatives of the renderer with respect to the eight corner coordinates and to what an estimator does
not know either: gain, offset, two slopes of the light, blur. Noise counts as independent between pixels with the RMS
of what separates the picture from its noise-free one on the print, so the errors of JPEG and of rounding are in. Only
pixels on the print count, its quiet zone included, and the white is taken to go on beyond it: the print's outer
edge, against a background nobody knows, tells nothing. Blurred background reaches into the quiet zone, though, and of
that the bound knows nothing: without the outermost 2 px of the print it is 1.4 times as large at 20 px facing, 2 times
at 20 px and 60 degrees, 1.03 times at 40 px and the same from 80 px on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks import _light
from benchmarks._tag_picture import Shot, Sight, View, cells, coarse, print_light

STEP_PX = 0.05
FINE = 2
"""Of the derivatives: the bound is the same as with 8 within 1 %."""


def corner_bound(view: View, shot: Shot, sigma: float | None = None) -> np.ndarray:
    """Smallest covariance an unbiased estimate of the corners can have.

    Parameters
    ----------
    view : View
        How the tag was seen; shadow, glare and covers are left out of account, motion and response count as known.
    shot : Shot
        What came of it.
    sigma : float
        Of the noise, grey values; left out, measured on the print.

    Returns
    -------
    (8, 8) array
        px², order u0 v0 u1 v1 u2 v2 u3 v3.
    """
    sigma = noise(shot) if sigma is None else sigma
    J = _derivatives(view, shot)
    return sigma**2 * np.linalg.inv(J.T @ J)[:8, :8]


def ideal_fit(view: View, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
    """The bound, and the error of one linear least-squares fit on the derivatives at the truth: (8, 8), (8,).

    The fit knows the renderer and weighs all pixels of the print alike. The errors of JPEG are not independent
    between pixels (what is left of the noise is slow, as is what tells of blurred edges), so such a fit is
    not at the bound either, and what it attains is what can be asked of one that does not know the code of JPEG.
    """
    J = _derivatives(view, shot)
    inverse = np.linalg.inv(J.T @ J)
    error = inverse @ (J.T @ (shot.grey - shot.clean)[shot.inside])
    return noise(shot) ** 2 * inverse[:8, :8], error[:8]


def noise(shot: Shot) -> float:
    """RMS of what separates the picture's print from the noise-free one, grey values."""
    return float(np.sqrt(np.mean((shot.grey - shot.clean)[shot.inside] ** 2)))


def _derivatives(view: View, shot: Shot) -> np.ndarray:
    print_, border = cells(view.family, view.tag_id)
    where = Sight(np.eye(3), shot.intrinsics, shot.grey.shape)
    u, v = np.meshgrid(*(np.arange(n) for n in shot.grey.shape[::-1]))
    u, v = u - shot.uv[:, 0].mean(), v - shot.uv[:, 1].mean()
    side = np.linalg.norm(np.roll(shot.uv, -1, 0) - shot.uv, axis=1).max()
    angle = np.deg2rad(view.slope_deg)
    lit = (1 + view.slope * (np.cos(angle) * u + np.sin(angle) * v) / side) * view.exposure

    black, bright = (_light.decode(grey, view.gamma) for grey in (view.black, view.white))
    contrast = bright - black

    def seen(uv: np.ndarray, blur_px: float) -> np.ndarray:
        white, _ = print_light(print_, border, where.moved(uv), FINE)
        white = coarse(_light.blur(replace(view, blur_px=blur_px), white, FINE), FINE)
        return _light.encode(lit * (black + contrast * white), view.gamma)[shot.inside].astype(float)

    columns = []
    for k in range(8):
        step = np.zeros(8)
        step[k] = STEP_PX
        ends = [seen(shot.uv + sign * step.reshape(4, 2), view.blur_px) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * STEP_PX))
    now = seen(shot.uv, view.blur_px)
    columns.append((seen(shot.uv, view.blur_px + STEP_PX) - now) / STEP_PX)
    light = _light.decode(now, view.gamma)
    per_light = now / (view.gamma * light)  # of the response
    factors = lit[shot.inside], light, u[shot.inside] * light / side, v[shot.inside] * light / side
    columns += [per_light * factor for factor in factors]
    return np.array(columns).T
