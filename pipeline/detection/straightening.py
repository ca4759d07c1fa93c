"""Where pixels would be if the lens drew straight lines: a grid over the picture, and a polynomial for each window.

The print's edges are straight before the lens bends them. The inverse of a lens model takes a few rounds per point;
done once on a grid, and interpolated by cubics, it costs next to nothing per tag, whatever the model.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.geometry import camera

STEP_PX = 16.0
BEYOND = 8
"""Steps that the grid reaches out of the picture: windows of tags at its border do."""
TERMS = 15
"""Of a polynomial of the fourth degree in two variables. Over tags of 200 px it is good to 0.001 px at f = 1731 px,
k1 = -0.12, and to 0.006 px at k1 = -0.3; over 100 px to 0.0003 px. Where k1 = -0.3 goes with f = 1100 px, 0.001 px over
100 px and 0.03 px over 200 px are left, and 0.05 and 0.6 px in the very corner of the picture."""
ACROSS = 6
"""Samples across a window, each way."""


def powers(at: np.ndarray) -> np.ndarray:
    """Terms u^i v^j, i + j <= 4, in the order in which `ideal_of` takes them; (..., 2) -> (..., TERMS)."""
    return np.stack([at[..., 0] ** i * at[..., 1] ** j for i in range(5) for j in range(5 - i)], axis=-1)


_axis = np.linspace(-1.0, 1.0, ACROSS)
_SAMPLES = np.stack(np.meshgrid(_axis, _axis), axis=-1).reshape(-1, 2)
_FITTING = np.ascontiguousarray(np.linalg.pinv(powers(_SAMPLES)))


class Straightening:
    """What straightens the pictures of one camera.

    Parameters
    ----------
    intrinsics : (9,) array
        Order of `pipeline.geometry.camera`.
    shape : (int, int)
        Height and width of its pictures, px.
    """

    def __init__(self, intrinsics: np.ndarray, shape: tuple[int, int]):
        rows, columns = (math.ceil(size / STEP_PX) + 1 + 2 * BEYOND for size in shape)
        at = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        uv = (at - BEYOND) * STEP_PX
        straight = camera.to_pixels(camera.undistort(uv, intrinsics), intrinsics)
        self._shift = np.ascontiguousarray(np.nan_to_num(straight - uv))

    def windows(self, uv: np.ndarray) -> np.ndarray:
        """Polynomials over the windows of tags with corners (n, 4, 2); (n, TERMS + 2, 2), see `ideal_of`."""
        lenses = np.zeros((len(uv), TERMS + 2, 2))
        if len(uv):
            _windows(np.ascontiguousarray(uv, float), self._shift, _SAMPLES, _FITTING, lenses)
        return lenses


@numba.njit(cache=True, error_model="numpy")
def _windows(uv, shift, samples, fitting, lenses):
    for k in range(len(uv)):
        u, v = uv[k, :, 0].mean(), uv[k, :, 1].mean()
        half = 4.0
        for c in range(4):
            half = max(half, abs(uv[k, c, 0] - u), abs(uv[k, c, 1] - v))
        half = 1.5 * half + 4.0
        lenses[k, TERMS, 0], lenses[k, TERMS, 1] = u, v
        lenses[k, TERMS + 1, 0] = lenses[k, TERMS + 1, 1] = 1.0 / half
        for s in range(len(samples)):
            du, dv = _interpolated(shift, u + half * samples[s, 0], v + half * samples[s, 1])
            for term in range(TERMS):
                lenses[k, term, 0] += fitting[term, s] * du
                lenses[k, term, 1] += fitting[term, s] * dv


@numba.njit(cache=True, inline="always", error_model="numpy")
def _interpolated(shift, u, v):
    """Catmull-Rom's cubics between the points of the grid."""
    rows, columns = shift.shape[0], shift.shape[1]
    x = min(max(u / STEP_PX + BEYOND, 1.0), columns - 2.001)
    y = min(max(v / STEP_PX + BEYOND, 1.0), rows - 2.001)
    i, j = int(x), int(y)
    a, b = x - i, y - j
    wu = (
        -0.5 * a + a * a - 0.5 * a**3,
        1 - 2.5 * a * a + 1.5 * a**3,
        0.5 * a + 2 * a * a - 1.5 * a**3,
        0.5 * (a**3 - a * a),
    )
    wv = (
        -0.5 * b + b * b - 0.5 * b**3,
        1 - 2.5 * b * b + 1.5 * b**3,
        0.5 * b + 2 * b * b - 1.5 * b**3,
        0.5 * (b**3 - b * b),
    )
    du, dv = 0.0, 0.0
    for row in range(4):
        for column in range(4):
            w = wv[row] * wu[column]
            du += w * shift[j - 1 + row, i - 1 + column, 0]
            dv += w * shift[j - 1 + row, i - 1 + column, 1]
    return du, dv


@numba.njit(cache=True, inline="always", error_model="numpy")
def ideal_of(x, y, lens):
    """Where a pixel would be if the lens drew straight lines, by the polynomial of its window.

    Rows of `lens`: coefficients of the shift, px; the window's middle, px; one over its half size.
    """
    u = (x - lens[TERMS, 0]) * lens[TERMS + 1, 0]
    v = (y - lens[TERMS, 1]) * lens[TERMS + 1, 1]
    X, Y = x, y
    k = 0
    power_u = 1.0
    for i in range(5):
        power = power_u
        for _ in range(5 - i):
            X += lens[k, 0] * power
            Y += lens[k, 1] * power
            power *= v
            k += 1
        power_u *= u
    return X, Y


@numba.njit(cache=True, error_model="numpy")
def bent_back(X, Y, lens):
    """The pixel that `ideal_of` brings to X, Y, and the (2, 2) derivative of `ideal_of` there.

    Newton's steps from the middle of the window. Rounds that add the shift back, from X, Y itself, ended 0.01 px off
    with k1 = -0.3 at f = 1731 px, and 10 px off in the corner of a picture at f = 1100 px.
    """
    x, y, per_px = lens[TERMS, 0], lens[TERMS, 1], lens[TERMS + 1, 0]
    a, b = x + lens[0, 0], y + lens[0, 1]
    D = np.eye(2)
    D[0, 0] += lens[5, 0] * per_px
    D[1, 0] += lens[5, 1] * per_px
    D[0, 1] += lens[1, 0] * per_px
    D[1, 1] += lens[1, 1] * per_px
    h = 1e-3
    for _ in range(8):
        det = D[0, 0] * D[1, 1] - D[0, 1] * D[1, 0]
        dx = (D[1, 1] * (X - a) - D[0, 1] * (Y - b)) / det
        dy = (D[0, 0] * (Y - b) - D[1, 0] * (X - a)) / det
        x, y = x + dx, y + dy
        if abs(dx) + abs(dy) < 1e-4:
            break
        a, b = ideal_of(x, y, lens)
        ax, bx = ideal_of(x + h, y, lens)
        ay, by = ideal_of(x, y + h, lens)
        D[0, 0], D[0, 1], D[1, 0], D[1, 1] = (ax - a) / h, (ay - a) / h, (bx - b) / h, (by - b) / h
    return x, y, D
