"""Corners at the noise floor: the known print is laid over the picture until every grey value agrees.

A tag's decoded quad gives the start; its print, place, light, blur and the camera's response (`image_model`) are then
adjusted together by Gauss-Newton steps, first on a part of the pixels, then on all that feel an edge. Cells whose grey
values stand out from the rest (mud, a rope, a shadow's edge, a hand) are left out with their neighbourhood, so that the
corners beside them rest on the rest of the print. The covariance of the corners is that of the fit, all 8 x 8 of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from pipeline.detection.image_model import (
    GROUND,
    LIGHT,
    PARAMETERS,
    PIXEL_VARIANCE,
    PLACE,
    RESPONSE,
    brightness,
    ideal_of,
    linearise,
)
from pipeline.detection.prints import print_of
from pipeline.geometry import camera

NO_CONTRAST = "no contrast"
MISFIT = "does not fit"
COVERED = "covered"
TOO_SMALL = "too small"
CUT = "cut by the border"
OVER_EXPOSED = "over-exposed"
UNDER_EXPOSED = "under-exposed"
BLURRED = "blurred"
REASONS = ("", NO_CONTRAST, MISFIT, COVERED, TOO_SMALL, CUT, OVER_EXPOSED, UNDER_EXPOSED, BLURRED)

LEAST_VARIANCE = 0.06
"""px²; cameras that sharpen show edges steeper than a pixel's own 1/12."""
MISFIT_MOST = 0.2
"""What neighbouring residuals share, as a share of the print's pattern. Right prints gave up to 0.22 (1.5 px of blur,
20 px, 45 degrees), mostly below 0.15; wrong ids from 0.19, mostly above 0.35. Where cells are wider than 3.5 sigmas of blur a wrong id is seen cell
by cell, and prints that are grey with dirt may misfit up to 0.45."""
MAX_CELLS = 16
FINE_PIXELS = 12_000
COARSE_PIXELS = 450


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
    kin: np.ndarray
    """(n,) correlation of the residuals of neighbouring pixels."""

    def __len__(self) -> int:
        return len(self.uv)


@dataclass(frozen=True)
class Prior:
    """What is known of blur and response before a tag is looked at."""

    blur_px: float = 0.8
    sigma_variance_px2: float = 1.0
    """Standard deviation of the blur's variance."""
    sigma_streak_px2: float = 0.05
    """Standard deviation of what the blur has more one way than the other."""
    response: float = 0.0
    sigma_response: float = 0.02


class Refiner:
    """Refinement for one camera.

    Parameters
    ----------
    intrinsics : (9,) array or None
        Of the camera, order of `pipeline.geometry.camera`. The print's edges are straight before the lens bends them;
        without intrinsics they are taken for straight in the picture.
    prior : Prior
    """

    def __init__(self, intrinsics: np.ndarray | None = None, prior: Prior | None = None):
        self.prior = prior or Prior()
        self._intrinsics = None if intrinsics is None else np.asarray(intrinsics, float)
        if self._intrinsics is not None and not np.any(self._intrinsics[4:]):
            self._intrinsics = None

    def refine(
        self, grey: np.ndarray, family: Sequence[str], tag_id: Sequence[int], uv: np.ndarray
    ) -> Refined:
        """Corners of tags whose ids are known and whose places nearly so.

        Parameters
        ----------
        grey : (H, W) uint8 array
        family, tag_id : (n,) sequences
        uv : (n, 4, 2) array
            Start, within about half a cell of the truth; px.

        Returns
        -------
        Refined
        """
        uv = np.ascontiguousarray(uv, float).reshape(-1, 4, 2)
        n = len(uv)
        out_uv, out_cov, out = np.empty((n, 4, 2)), np.zeros((n, 8, 8)), np.zeros((n, 9))
        lenses = self._lenses(uv)
        p = self.prior
        start = np.array([p.blur_px, p.sigma_variance_px2, p.sigma_streak_px2, p.response, p.sigma_response])
        for k in range(n):
            of = print_of(str(family[k]), int(tag_id[k]))
            cells, size = _padded(of.cells)
            _fit(
                grey, cells, size, of.border, lenses[k], self._intrinsics is not None, uv[k], start,
                out_uv[k], out_cov[k], out[k],
            )  # fmt: skip
        code = out[:, 0].astype(int)
        return Refined(
            uv=out_uv,
            cov=out_cov,
            blur_px=out[:, 1],
            motion_px=out[:, 2],
            noise=out[:, 3],
            contrast=out[:, 4],
            whole=out[:, 5],
            misfit=out[:, 6],
            reason=np.array([REASONS[c] for c in code], object),
            response=out[:, 7],
            kin=out[:, 8],
        )

    def _lenses(self, uv: np.ndarray) -> np.ndarray:
        """Polynomials from picture to undistorted picture over the window of each tag, (n, 12, 2); see `ideal_of`."""
        lenses = np.zeros((len(uv), 12, 2))
        if self._intrinsics is None or not len(uv):
            return lenses
        middle = uv.mean(axis=1)
        half = 0.8 * np.abs(uv - middle[:, None]).max(axis=1) / 0.5 * 0.5 + 3.0
        half = np.maximum(half, 4.0) * 1.25
        lenses[:, 10] = middle
        lenses[:, 11] = 1.0 / half
        at = middle[:, None] + half[:, None] * _SAMPLES
        straight = camera.to_pixels(camera.undistort(at, self._intrinsics), self._intrinsics)
        shift = np.nan_to_num(straight - at)
        lenses[:, :10] = np.einsum("ij,njk->nik", _FITTING, shift)
        return lenses


_axis = np.linspace(-1.0, 1.0, 5)
_SAMPLES = np.stack(np.meshgrid(_axis, _axis), axis=-1).reshape(-1, 2)
_FITTING = np.linalg.pinv(
    np.stack([_SAMPLES[:, 0] ** i * _SAMPLES[:, 1] ** j for i in range(4) for j in range(4 - i)], axis=1)
)


_padding: dict[int, np.ndarray] = {}


def _padded(cells: np.ndarray) -> tuple[np.ndarray, int]:
    key = id(cells)
    if key not in _padding:
        padded = np.zeros((MAX_CELLS, MAX_CELLS))
        padded[: len(cells), : len(cells)] = cells
        _padding[key] = padded
    return _padding[key], len(cells)


@numba.njit(cache=True, error_model="numpy")
def _homography(uv, lo, hi):
    """(3, 3) from the print's coordinates (cells) to undistorted pixels, by four corners."""
    A = np.zeros((8, 8))
    b = np.empty(8)
    s = np.array([lo, hi, hi, lo])
    t = np.array([lo, lo, hi, hi])
    for k in range(4):
        x, y = uv[k, 0], uv[k, 1]
        A[2 * k] = np.array([s[k], t[k], 1.0, 0.0, 0.0, 0.0, -s[k] * x, -t[k] * x])
        A[2 * k + 1] = np.array([0.0, 0.0, 0.0, s[k], t[k], 1.0, -s[k] * y, -t[k] * y])
        b[2 * k], b[2 * k + 1] = x, y
    h = np.linalg.solve(A, b)
    H = np.ones((3, 3))
    H[0, 0], H[0, 1], H[0, 2] = h[0], h[1], h[2]
    H[1, 0], H[1, 1], H[1, 2] = h[3], h[4], h[5]
    H[2, 0], H[2, 1] = h[6], h[7]
    return H


@numba.njit(cache=True, error_model="numpy")
def _point(H, s, t):
    z = 1.0 / (H[2, 0] * s + H[2, 1] * t + H[2, 2])
    return (H[0, 0] * s + H[0, 1] * t + H[0, 2]) * z, (H[1, 0] * s + H[1, 1] * t + H[1, 2]) * z


@numba.njit(cache=True, error_model="numpy")
def _bent_back(X, Y, lens):
    """The pixel that `ideal_of` brings to X, Y, and the (2, 2) derivative of `ideal_of` there."""
    x, y = X, Y
    D = np.eye(2)
    h = 0.25
    for _ in range(4):
        a, b = ideal_of(x, y, lens)
        ax, bx = ideal_of(x + h, y, lens)
        ay, by = ideal_of(x, y + h, lens)
        D[0, 0], D[0, 1], D[1, 0], D[1, 1] = (ax - a) / h, (ay - a) / h, (bx - b) / h, (by - b) / h
        x, y = x + (X - a), y + (Y - b)
    return x, y, D


@numba.njit(cache=True, error_model="numpy")
def _fit(grey, cells, n, border, lens, bent, uv, start, out_uv, out_cov, out):
    lo = 0.5 * (n - border)
    hi = lo + border
    straight = uv.copy()
    if bent:
        for k in range(4):
            straight[k, 0], straight[k, 1] = ideal_of(uv[k, 0], uv[k, 1], lens)
    out_uv[:] = uv
    height, width = grey.shape
    # The quad must be one: convex, in the order of our corners, and of some size.
    smallest = 1e9
    for k in range(4):
        ax, ay = straight[(k + 1) % 4, 0] - straight[k, 0], straight[(k + 1) % 4, 1] - straight[k, 1]
        bx, by = (
            straight[(k + 2) % 4, 0] - straight[(k + 1) % 4, 0],
            straight[(k + 2) % 4, 1] - straight[(k + 1) % 4, 1],
        )
        smallest = min(smallest, ax * by - ay * bx)
    if not smallest > 30.0:
        out[0] = 4
        return
    H = _homography(straight, lo, hi)
    x0, y0, x1, y1 = 1e9, 1e9, -1e9, -1e9
    for k in range(4):
        X, Y = _point(H, 0.0 if k == 0 or k == 3 else float(n), 0.0 if k < 2 else float(n))
        x0, y0, x1, y1 = min(x0, X), min(y0, Y), max(x1, X), max(y1, Y)
    slack = 2.0 if not bent else 4.0
    window = np.array(
        [
            max(math.floor(x0 - slack), 0),
            max(math.floor(y0 - slack), 0),
            min(math.ceil(x1 + slack) + 1, width),
            min(math.ceil(y1 + slack) + 1, height),
        ]
    )
    if window[2] - window[0] < 4 or window[3] - window[1] < 4:
        out[0] = 5
        return
    norm = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * max(x1 - x0, y1 - y0)])
    area = 0.5 * abs(
        (straight[2, 0] - straight[0, 0]) * (straight[3, 1] - straight[1, 1])
        - (straight[3, 0] - straight[1, 0]) * (straight[2, 1] - straight[0, 1])
    )
    cell_px = math.sqrt(area) / border
    pixels = area * (n / border) ** 2

    room = int(min(FINE_PIXELS, 1.5 * pixels + 100)) + 100
    J, r, who = np.empty((room, PARAMETERS)), np.empty(room), np.empty((room, 3), np.int32)
    masked = np.zeros((MAX_CELLS, MAX_CELLS), np.bool_)
    any_masked = False
    par = np.zeros(PARAMETERS)
    par[14] = start[0] ** 2 + PIXEL_VARIANCE
    par[RESPONSE] = start[3]
    prior_variance = par[14]

    black, white = _first_light(grey, cells, n, lens, bent, H, window)
    par[0], par[1] = black, white - black
    if par[1] < 4.0:
        out[0] = 7 if black + 0.5 * par[1] < 25.0 else (6 if black > 235.0 else 1)
        return

    # Of pixels on edges: about three beside each side of each cell.
    on_edges = min(pixels, 0.6 * n * n * 2.0 * cell_px * 4.0 * start[0])
    coarse = max(1, int(on_edges / COARSE_PIXELS))
    fine = max(1, math.ceil(on_edges / FINE_PIXELS))
    flat = max(1, int(cell_px * cell_px / 5.0))
    sigma = 10.0
    rms_cell = np.zeros(n * n)
    mean_cell = np.zeros(n * n)
    number_cell = np.zeros(n * n)
    code = 0
    share = 1.0
    stage = 0  # 0 coarse, 1 fine, 2 last
    steps = 0
    step_px = 1e9
    m = 0
    total_steps = 0
    while True:
        stride = coarse if stage == 0 else fine
        G = np.linalg.inv(H)
        m, _left_out = linearise(
            grey,
            cells,
            n,
            masked,
            any_masked,
            lens,
            bent,
            G,
            norm,
            par,
            window,
            stride,
            max(flat, stride),
            lo if lo <= 1.0 else 0.0,
            J,
            r,
            who,
        )
        if m < 40:
            code = 5 if window[0] == 0 or window[1] == 0 or window[2] == width or window[3] == height else 3
            break
        edge, square = 0, 0.0
        for k in range(m):
            if who[k, 1] == 1:
                edge += 1
                square += r[k] * r[k]
        if edge < 30:
            code = 3
            break
        sigma = math.sqrt(max(square / max(edge - 12, 8), 0.1))
        # Normal equations with what is known beforehand.
        Jm = J[:m]
        A = Jm.T @ Jm
        b = Jm.T @ r[:m]
        _add_priors(A, b, par, start, prior_variance, sigma, stage)
        d = np.sqrt(np.diag(A)) + 1e-12
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                A[i, j] /= d[i] * d[j]
            A[i, i] += 1e-6
        x = np.linalg.solve(A, b / d) / d
        # A step that moves a corner further than a third of a cell left the valley: shorten it.
        reach = 0.0
        for k in range(4):
            X, Y = _point(H, lo if k == 0 or k == 3 else hi, lo if k < 2 else hi)
            xm, ym = (X - norm[0]) / norm[2], (Y - norm[1]) / norm[2]
            g = xm * x[12] + ym * x[13]
            dx = norm[2] * (x[6] * xm + x[7] * ym + x[8] - xm * g)
            dy = norm[2] * (x[9] * xm + x[10] * ym + x[11] - ym * g)
            reach = max(reach, math.sqrt(dx * dx + dy * dy))
        factor = min(1.0, max(0.35 * cell_px, 0.5) / max(reach, 1e-12))
        step_px = reach * factor
        for i in range(PARAMETERS):
            if i < LIGHT or i >= LIGHT + PLACE:
                par[i] += x[i] * factor
        par[14] = min(max(par[14], LEAST_VARIANCE), max(4.0, 0.5 * cell_px * cell_px) + 1.0)
        streak = math.sqrt(par[15] ** 2 + par[16] ** 2)
        most = 0.9 * (par[14] - PIXEL_VARIANCE)
        if streak > most:
            par[15] *= most / streak
            par[16] *= most / streak
        par[RESPONSE] = min(max(par[RESPONSE], -0.9), 0.9)
        W = np.eye(3)
        W[0, 0] += factor * x[6]
        W[0, 1], W[0, 2] = factor * x[7], factor * x[8]
        W[1, 0] = factor * x[9]
        W[1, 1] += factor * x[10]
        W[1, 2] = factor * x[11]
        W[2, 0], W[2, 1] = factor * x[12], factor * x[13]
        N = np.array(
            [[1 / norm[2], 0, -norm[0] / norm[2]], [0, 1 / norm[2], -norm[1] / norm[2]], [0, 0, 1.0]]
        )
        Ni = np.array([[norm[2], 0, norm[0]], [0, norm[2], norm[1]], [0, 0, 1.0]])
        H = Ni @ W @ N @ H
        steps += 1
        total_steps += 1
        for k in range(m):
            for i in range(PARAMETERS):
                r[k] -= J[k, i] * x[i] * factor
        changed = False
        if stage == 1 or (steps >= 2 and step_px < 0.5):
            changed, share = _mask(J, r, who, m, cells, n, par, masked, rms_cell, mean_cell, number_cell)
            any_masked = any_masked or changed
        if stage == 0:
            if (step_px < 0.15 and not changed) or steps >= 12:
                stage, steps = 1, 0
        elif (step_px < 0.05 and not changed) or steps >= 6:
            break
    edge, square = 0, 0.0
    for k in range(m):
        if who[k, 1] == 1:
            edge += 1
            square += r[k] * r[k]
    sigma = math.sqrt(max(square / max(edge - 12, 8), 0.1))
    pairs, product = 0, 0.0
    for k in range(m - 1):
        if who[k + 1, 2] == who[k, 2] + 1 and who[k, 1] == 1 and who[k + 1, 1] == 1:
            pairs += 1
            product += r[k] * r[k + 1]
    kin = min(max(product / (pairs * sigma * sigma), 0.0), 0.6) if pairs > 0 else 0.0
    middle = J[:m, 1].mean() if m > 0 else 0.0
    pattern = par[1] ** 2 * ((J[:m, 1] - middle) ** 2).mean() if m > 0 else 0.0
    # What the fit is worth.
    out[3], out[4], out[5], out[6], out[7] = (
        sigma,
        par[1],
        share,
        math.sqrt(kin * sigma * sigma / max(pattern, 1.0)),
        par[RESPONSE],
    )
    variance = par[14] - PIXEL_VARIANCE
    streak = math.sqrt(par[15] ** 2 + par[16] ** 2)
    out[1] = math.sqrt(max(variance, 0.0))
    out[2] = math.sqrt(24.0 * streak)
    out[8] = kin
    if code == 0:
        changed, share = _mask(J, r, who, m, cells, n, par, masked, rms_cell, mean_cell, number_cell)
        out[5] = share
        if par[1] < 3.0 * sigma:
            code = 1
        elif sigma > 0.3 * par[1] or out[6] > (MISFIT_MOST if cell_px < 3.5 * math.sqrt(par[14]) else 0.45):
            code = 2
        else:
            against, within = _contradicted(grey, cells, n, lens, bent, H, norm, par)
            if within > 0.1 * (n - 4) ** 2:
                code = 2
            elif share < 0.5 or against > 0.1 * n * n:
                code = 3
    if code == 0:
        Jm = J[:m]
        A = Jm.T @ Jm
        b = np.zeros(PARAMETERS)
        _add_priors(A, b, par, start, prior_variance, sigma, 1)
        d = np.sqrt(np.diag(A)) + 1e-12
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                A[i, j] /= d[i] * d[j]
            A[i, i] += 1e-9
        P = np.linalg.inv(A)
        M = np.zeros((8, 8))
        for k in range(4):
            X, Y = _point(H, lo if k == 0 or k == 3 else hi, lo if k < 2 else hi)
            x, y, D = X, Y, np.eye(2)
            if bent:
                x, y, D = _bent_back(X, Y, lens)
            out_uv[k, 0], out_uv[k, 1] = x, y
            xm, ym = (X - norm[0]) / norm[2], (Y - norm[1]) / norm[2]
            B = np.zeros((2, 8))
            B[0] = norm[2] * np.array([xm, ym, 1.0, 0.0, 0.0, 0.0, -xm * xm, -xm * ym])
            B[1] = norm[2] * np.array([0.0, 0.0, 0.0, xm, ym, 1.0, -ym * xm, -ym * ym])
            M[2 * k : 2 * k + 2] = np.linalg.inv(D) @ B
        # JPEG leaves errors that neighbouring pixels share; information falls as it does for a series that forgets.
        scale = 1.08 * sigma * sigma * (1.0 + kin) / (1.0 - kin)
        place = np.empty((8, 8))
        for i in range(8):
            for j in range(8):
                place[i, j] = P[LIGHT + i, LIGHT + j] / (d[LIGHT + i] * d[LIGHT + j]) * scale
        out_cov[:] = M @ place @ M.T
    out[0] = code


@numba.njit(cache=True, error_model="numpy")
def _add_priors(A, b, par, start, prior_variance, sigma, stage):
    s2 = sigma * sigma
    w = s2 / start[1] ** 2
    A[14, 14] += w
    b[14] += w * (prior_variance - par[14])
    w = s2 / start[2] ** 2
    for k in (15, 16):
        A[k, k] += w
        b[k] -= w * par[k]
    w = s2 / start[4] ** 2
    A[17, 17] += w
    b[17] += w * (start[3] - par[17])
    w = s2 / (0.3 * par[1] + 1.0) ** 2
    for k in range(2, 6):
        A[k, k] += w
        b[k] -= w * par[k]
    w = s2 / par[1] ** 2
    for k in range(GROUND, GROUND + 4):
        A[k, k] += w
        b[k] -= w * par[k]
    A[0, 0] += 1e-6
    A[1, 1] += 1e-6


@numba.njit(cache=True, error_model="numpy")
def _first_light(grey, cells, n, lens, bent, H, window):
    """Grey values of black and of white: medians over the middles of the cells."""
    blacks, whites = np.empty(n * n), np.empty(n * n)
    nb, nw = 0, 0
    height, width = grey.shape
    for j in range(n):
        for i in range(n):
            X, Y = _point(H, i + 0.5, j + 0.5)
            x, y = round(X), round(Y)
            if bent:
                a, b, _ = _bent_back(X, Y, lens)
                x, y = round(a), round(b)
            if x < 0 or y < 0 or x >= width or y >= height:
                continue
            if cells[j, i] > 0.5:
                whites[nw] = grey[y, x]
                nw += 1
            else:
                blacks[nb] = grey[y, x]
                nb += 1
    if nb < 4 or nw < 4:
        return 0.0, 0.0
    return np.median(blacks[:nb]), np.median(whites[:nw])


@numba.njit(cache=True, error_model="numpy")
def _contradicted(grey, cells, n, lens, bent, H, norm, par):
    """Cells, masked or not, whose middle is not as bright as it should be: of all, and of those that carry the id."""
    height, width = grey.shape
    G = np.linalg.inv(H)
    every, within = 0, 0
    for j in range(n):
        for i in range(n):
            X, Y = _point(H, i + 0.5, j + 0.5)
            x, y = X, Y
            if bent:
                x, y, _ = _bent_back(X, Y, lens)
            left, top = math.floor(x), math.floor(y)
            if left < 0 or top < 0 or left + 1 >= width or top + 1 >= height:
                continue
            a, b = x - left, y - top
            seen = (1 - b) * ((1 - a) * grey[top, left] + a * grey[top, left + 1]) + b * (
                (1 - a) * grey[top + 1, left] + a * grey[top + 1, left + 1]
            )
            T = brightness(cells, n, G, X, Y, par)
            xm, ym = (X - norm[0]) / norm[2], (Y - norm[1]) / norm[2]
            model = par[0] + par[2] * xm + par[3] * ym + (par[1] + par[4] * xm + par[5] * ym) * T
            if abs(seen - min(model, 255.0)) > 0.4 * par[1]:
                every += 1
                if 2 <= i < n - 2 and 2 <= j < n - 2:
                    within += 1
    return every, within


@numba.njit(cache=True, error_model="numpy")
def _mask(J, r, who, m, cells, n, par, masked, rms, mean, number):
    """Mark cells whose residuals stand out; whether the marks changed, and the share of cells that are not marked."""
    for k in range(n * n):
        rms[k] = mean[k] = number[k] = 0.0
    for k in range(m):
        c = who[k, 0]
        if who[k, 1] == 2:
            continue
        rms[c] += r[k] * r[k]
        mean[c] += r[k]
        number[c] += 1.0
    few = np.empty(n * n)
    have = 0
    for c in range(n * n):
        if number[c] > 0:
            rms[c] = math.sqrt(rms[c] / number[c])
            mean[c] /= number[c]
            if number[c] >= 3:
                few[have] = rms[c]
                have += 1
    if have < 8:
        return False, 0.0
    usual = max(np.median(few[:have]), 0.8)
    changed = False
    kept = 0
    for j in range(n):
        for i in range(n):
            c = j * n + i
            if masked[j, i]:
                continue
            limit = usual * (3.0 + 4.0 / math.sqrt(max(number[c], 1.0))) + 0.02 * par[1]
            if number[c] > 0 and rms[c] > limit:
                masked[j, i] = True
                changed = True
            else:
                kept += 1
    return changed, kept / (n * n)
