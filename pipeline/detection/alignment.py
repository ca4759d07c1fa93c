"""One tag's print laid over the picture by Gauss-Newton steps: compiled, because a shift has millions of them.

First a part of the pixels until a step is short, then all that feel an edge. Cells whose residuals stand out are masked
with their neighbourhood as soon as the print nearly lies. What is known of blur and response beforehand enters as
observations of its own, in the same units.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.detection.gauss_newton import BY_CELL, PLAIN, VEILED
from pipeline.detection.image_model import (
    AT_END,
    BLUR,
    GAIN,
    OFFSET,
    PARAMETERS,
    PIXEL_VARIANCE,
    PLACE,
    RESPONSE,
    VEIL_TERMS,
)
from pipeline.detection.integrity import (
    contradicted,
    neighbours,
    noise_on_edges,
    pattern,
    point,
    unevenness,
)
from pipeline.detection.settling import approach, by_parts, settle
from pipeline.detection.straightening import bent_back, ideal_of
from pipeline.detection.veil import bent_light

STANDS, NO_CONTRAST, MISFIT, COVERED, TOO_SMALL, CUT, OVER_EXPOSED, UNDER_EXPOSED, BLURRED = range(9)

MAX_CELLS = 16
COARSE_PIXELS = 200
"""Pixels on edges for the first steps."""
MISFIT_MOST = 0.2
"""What neighbouring residuals share, as a part of the print's pattern, at the most. Right prints gave up to 0.22
(1.5 px of blur, 20 px, 45 degrees), mostly below 0.15; wrong ids from 0.19, mostly above 0.35."""
SHARP = 1.0 / 3.5
"""Blur in cells below which each cell is seen by itself: others could take the brightness of another id."""
MISFIT_MOST_SHARP = 0.3
"""Where cells are wider than 3.5 sigmas of blur: a wrong id is seen cell by cell there."""
COVERED_MOST = 0.5
"""Part of the cells that may be masked."""
UNEVEN = 4.0
"""`unevenness` from which each cell gets a brightness of its own; noise and JPEG gave up to 2.8, shadows 20 to 40."""
UNEVEN_VARIANCE = 5.5
"""What free brightness of the cells adds to the variance of corners, measured on shadows that pass over tags."""
PARTLY, PARTLY_VARIANCE, PARTLY_MISFIT = 0.015, 3.0, 0.02
"""Part of the cells that are masked from which something lies over the print, and what it adds to the variance of
corners by what of it is too little to be masked; twice that at a misfit of the third, five times at twice the third."""
PARTLY_PX = 0.015
"""What it adds besides, on large tags that the noise alone would leave more certain than that."""
MISFIT_MOST_PARTLY = 0.07
"""As `MISFIT_MOST`, where twice `PARTLY` is masked: half-covered prints at their true place gave below 0.06."""
CLIPPED, CLIPPED_VARIANCE = 0.05, 4.5
"""Part of the pixels that are whiter than the camera could record, and what the half of each edge that is lost with
them, and JPEG's ringing beside it, add to the variance of corners."""
SUSPICIOUS = 0.12
"""Misfit from which parts of the print are tried alone."""
HOPELESS = 0.4
"""Misfit beyond which no part fits either: nothing is there, or next to nothing of it."""
UNLIKE_NOTHING = 0.4
"""Part of the cells that are of the wrong brightness, below which a hopeless fit is a covered tag's: 0.08 to 0.38 where
a third of a tag was covered, 0.41 to 0.7 where three quarters were, half where nothing is."""
CONTRADICTED_MOST = 0.1
"""Part of the cells, and of those that carry the id, whose middle may be of the wrong brightness."""
JPEG_SHARE = 1.08
"""Variance of residuals in the whole picture over that of white noise with the same correlation of neighbours: what
longer correlations add, measured at JPEG qualities 70 to 95 and noise 1 to 6."""

# Places in the vector of results.
REASON, BLUR_PX, MOTION_PX, NOISE, CONTRAST, WHOLE, MISFIT_AT, RESPONSE_AT, RESULTS = range(9)


@numba.njit(cache=True, error_model="numpy")
def align_all(grey, prints, across, lenses, bent, uv, prior, most, rooms, out_uv, out_cov, out):
    """Lay the prints of some tags over one picture: `align` for each row of the arrays.

    `across` (k, 2) has the cells across each print and across the quad of its corners. `rooms` are two tuples of
    arrays for the derivatives, residuals and owners of the pixels of one tag, and once more for those of its parts;
    see `linearise`.
    """
    for k in range(len(uv)):
        align(
            grey, prints[k], across[k, 0], across[k, 1], lenses[k], bent, uv[k], prior, most, rooms,
            out_uv[k], out_cov[k], out[k],
        )  # fmt: skip


@numba.njit(cache=True, error_model="numpy")
def align(grey, cells, n, border, lens, bent, uv, prior, most, rooms, out_uv, out_cov, out):
    """Lay one print over the picture.

    Parameters
    ----------
    grey : (H, W) uint8 array
        The picture.
    cells : (MAX_CELLS, MAX_CELLS) float64 array
        The print, 1 white; the first n rows and columns count.
    n, border : int
        Cells across the print, and across the quad of its corners.
    lens : (TERMS + 2, 2) float64 array
        Straightens the window, see `straightening`; used if `bent`.
    bent : bool
        Whether the lens bends lines.
    uv : (4, 2) float64 array
        Corners to start from, px.
    prior : (5,) float64 array
        Blur px, sigma of its variance px², sigma of its streak px², response, sigma of the response.
    most : int
        About how many pixels on edges are used at the most where the noise is `QUIET`.
    rooms : pair of tuples
        As of `align_all`.
    out_uv : (4, 2) float64 array
        Filled: corners, px.
    out_cov : (8, 8) float64 array
        Filled: their covariance, px².
    out : (RESULTS,) float64 array
        Filled: by the places above.
    """
    lo = 0.5 * (n - border)
    hi = lo + border
    quiet = lo if lo <= 1.0 else 0.0
    height, width = grey.shape
    out_uv[:] = uv
    straight = uv.copy()
    if bent:
        for k in range(4):
            straight[k, 0], straight[k, 1] = ideal_of(uv[k, 0], uv[k, 1], lens)
    area = _area(straight)
    if not area > 30.0:
        out[REASON] = TOO_SMALL
        return
    H = _homography(straight, lo, hi)
    cell_px = math.sqrt(area) / border
    norm, window = _window(H, n, 2.0 + 0.6 * cell_px, width, height)
    if window[2] - window[0] < 4 or window[3] - window[1] < 4:
        out[REASON] = CUT
        return
    at_border = window[0] == 0 or window[1] == 0 or window[2] == width or window[3] == height

    par = np.zeros(PARAMETERS + VEIL_TERMS)
    par[BLUR] = prior[0] ** 2 + PIXEL_VARIANCE
    par[RESPONSE] = prior[3]
    black, white = _first_light(grey, cells, n, lens, bent, H)
    par[OFFSET], par[GAIN] = black, white - black
    if math.isnan(black):
        out[REASON] = CUT
        return
    if par[GAIN] < 4.0:
        out[REASON] = NO_CONTRAST
        if 0.5 * (black + white) < 25.0:
            out[REASON] = UNDER_EXPOSED
        if 0.5 * (black + white) > 235.0:
            out[REASON] = OVER_EXPOSED
        return

    pixels = area * (n / border) ** 2
    room_for, room_for_parts = rooms
    J, r, who = room_for
    masked = np.zeros((MAX_CELLS, MAX_CELLS), np.bool_)
    # Pixels on edges: about three beside each side of each cell.
    on_edges = min(pixels, 5.0 * n * n * cell_px * prior[0])
    coarse = max(1, int(on_edges / COARSE_PIXELS))
    fine = on_edges / most
    flat = max(1, int(cell_px * cell_px / 3.0))

    reason, share = STANDS, 1.0
    place = (lens, bent, norm, window, quiet, lo, hi, cell_px)
    strides = (coarse, fine, flat)
    levels, uneven, parted, strayed = cells, False, False, False
    A = np.zeros((PARAMETERS, PARAMETERS))
    H, m, share = approach(grey, cells, n, masked, H, par, prior, place, strides, room_for)
    misfit = _misfit(J, r, who, m, par)
    if m > 0 and misfit < HOPELESS:
        # What lies over the print shows by now: all pixels beside it would cost more than those of the parts.
        if misfit > SUSPICIOUS or share < 1.0 - PARTLY:
            parted = True
            H, m, A, share, strayed = by_parts(
                grey, cells, n, masked, H, par, prior, place, strides, room_for, room_for_parts
            )
        else:
            H, m, A, share = settle(grey, cells, n, masked, H, par, prior, place, strides, room_for, PLAIN)
            if m > 0 and bent_light(J, r, m, noise_on_edges(r, who, m)[0]):
                H, m, A, share = settle(
                    grey, cells, n, masked, H, par, prior, place, strides, room_for, VEILED
                )
    while m > 0:
        unlike = unevenness(r, who, m, n, par, masked)
        misfit = _misfit(J, r, who, m, par)
        if unlike < UNEVEN and misfit < SUSPICIOUS and (parted or share >= 1.0 - PARTLY):
            break
        if not parted and misfit < HOPELESS:
            # Something lies over the print, and the whole of it gave way: does a part of it fit by itself?
            parted = True
            H, m, A, share, strayed = by_parts(
                grey, cells, n, masked, H, par, prior, place, strides, room_for, room_for_parts
            )
            continue
        if unlike < UNEVEN or misfit > HOPELESS or uneven or math.sqrt(par[BLUR]) > SHARP * cell_px:
            break
        # A shadow's edge across the print is no noise: each cell gets a brightness of its own.
        uneven, levels = True, cells.copy()
        masked[:] = False
        H, m, A, share = settle(grey, levels, n, masked, H, par, prior, place, strides, room_for, BY_CELL)
    if m == 0 or strayed:
        reason = CUT if m == 0 and at_border else COVERED

    sigma, _ = noise_on_edges(r, who, m)
    correlation = neighbours(r, who, m, sigma)
    misfit = _misfit(J, r, who, m, par)
    out[BLUR_PX] = math.sqrt(max(par[BLUR] - PIXEL_VARIANCE, 0.0))
    out[MOTION_PX] = math.sqrt(24.0 * math.sqrt(par[BLUR + 1] ** 2 + par[BLUR + 2] ** 2))
    out[NOISE], out[CONTRAST], out[WHOLE], out[MISFIT_AT] = sigma, par[GAIN], share, misfit
    out[RESPONSE_AT] = par[RESPONSE]
    blur_cells = math.sqrt(par[BLUR]) / cell_px
    partly = share < 1.0 - PARTLY
    clipped = 0
    for k in range(m):
        clipped += who[k, 1] == AT_END
    if misfit > HOPELESS and reason == STANDS:
        every, _ = contradicted(grey, cells, levels, n, lens, bent, H, norm, par)
        if every < UNLIKE_NOTHING * n * n:
            reason = COVERED
    if reason == STANDS:
        if par[GAIN] < 3.0 * sigma:
            reason = NO_CONTRAST
        elif sigma > 0.3 * par[GAIN]:
            reason = MISFIT
        elif misfit > (MISFIT_MOST_SHARP if blur_cells < SHARP else MISFIT_MOST):
            reason = BLURRED if blur_cells > 0.7 else MISFIT
        elif share < 1.0 - 2.0 * PARTLY and misfit > MISFIT_MOST_PARTLY:
            reason = MISFIT
        else:
            every, within = contradicted(grey, cells, levels, n, lens, bent, H, norm, par)
            if within > CONTRADICTED_MOST * (n - 4) ** 2:
                reason = MISFIT if share > 0.9 else COVERED
            elif share < 1.0 - COVERED_MOST or every > CONTRADICTED_MOST * n * n:
                reason = COVERED
    if uneven:
        sigma *= math.sqrt(UNEVEN_VARIANCE)
    elif partly:
        sigma *= math.sqrt(PARTLY_VARIANCE)
    if partly:
        sigma *= math.sqrt(1.0 + (misfit / PARTLY_MISFIT) ** 2)
    if clipped > CLIPPED * m:
        sigma *= math.sqrt(CLIPPED_VARIANCE)
    if reason == STANDS:
        _corners(A, H, lo, hi, norm, lens, bent, sigma, correlation, out_uv, out_cov)
        for k in range(4):
            if partly:
                out_cov[2 * k, 2 * k] += PARTLY_PX**2
                out_cov[2 * k + 1, 2 * k + 1] += PARTLY_PX**2
            if not (0.0 <= out_uv[k, 0] <= width - 1 and 0.0 <= out_uv[k, 1] <= height - 1):
                reason = CUT
    out[REASON] = reason


@numba.njit(cache=True, error_model="numpy")
def _area(uv):
    """Area of a convex quad in the order of our corners, px²; 0 of any other."""
    least = 1e9
    for k in range(4):
        a, b, c = uv[k], uv[(k + 1) % 4], uv[(k + 2) % 4]
        least = min(least, (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]))
    if not least > 0.0:
        return 0.0
    return 0.5 * abs(
        (uv[2, 0] - uv[0, 0]) * (uv[3, 1] - uv[1, 1]) - (uv[3, 0] - uv[1, 0]) * (uv[2, 1] - uv[0, 1])
    )


@numba.njit(cache=True, error_model="numpy")
def _homography(uv, lo, hi):
    """(3, 3) from the print's coordinates (cells) to undistorted pixels, by four corners."""
    A, b = np.zeros((8, 8)), np.empty(8)
    for k in range(4):
        s, t = lo if k == 0 or k == 3 else hi, lo if k < 2 else hi
        x, y = uv[k, 0], uv[k, 1]
        A[2 * k, 0], A[2 * k, 1], A[2 * k, 2], A[2 * k, 6], A[2 * k, 7] = s, t, 1.0, -s * x, -t * x
        A[2 * k + 1, 3], A[2 * k + 1, 4], A[2 * k + 1, 5] = s, t, 1.0
        A[2 * k + 1, 6], A[2 * k + 1, 7] = -s * y, -t * y
        b[2 * k], b[2 * k + 1] = x, y
    h = np.linalg.solve(A, b)
    H = np.ones((3, 3))
    for i in range(8):
        H[i // 3, i % 3] = h[i]
    return H


@numba.njit(cache=True, error_model="numpy")
def _window(H, n, slack, width, height):
    """Middle and half size of the print in undistorted pixels, and the pixels x0, y0, x1, y1 around it."""
    x0, y0, x1, y1 = 1e9, 1e9, -1e9, -1e9
    for k in range(4):
        X, Y = point(H, 0.0 if k == 0 or k == 3 else float(n), 0.0 if k < 2 else float(n))
        x0, y0, x1, y1 = min(x0, X), min(y0, Y), max(x1, X), max(y1, Y)
    norm = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * max(x1 - x0, y1 - y0)])
    window = np.array(
        [
            int(min(max(x0 - slack, 0.0), width)),
            int(min(max(y0 - slack, 0.0), height)),
            int(max(min(x1 + slack + 2.0, width), 0.0)),
            int(max(min(y1 + slack + 2.0, height), 0.0)),
        ]
    )
    return norm, window


@numba.njit(cache=True, error_model="numpy")
def _first_light(grey, cells, n, lens, bent, H):
    """Grey values of black and of white: medians over the middles of the cells."""
    blacks, whites = np.empty(n * n), np.empty(n * n)
    nb, nw = 0, 0
    height, width = grey.shape
    for j in range(n):
        for i in range(n):
            x, y = point(H, i + 0.5, j + 0.5)
            if bent:
                x, y, _ = bent_back(x, y, lens)
            if not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0):
                continue
            value = grey[int(y + 0.5), int(x + 0.5)]
            if cells[j, i] > 0.5:
                whites[nw] = value
                nw += 1
            else:
                blacks[nb] = value
                nb += 1
    if nb < 4 or nw < 4:
        return np.nan, np.nan
    return np.median(blacks[:nb]), np.median(whites[:nw])


@numba.njit(cache=True, error_model="numpy")
def _misfit(J, r, who, m, par):
    """What the residuals of neighbouring pixels share, as a part of the print's pattern."""
    if m == 0:
        return 0.0
    sigma, _ = noise_on_edges(r, who, m)
    return math.sqrt(neighbours(r, who, m, sigma)) * sigma / max(pattern(J, m, par), 1.0)


@numba.njit(cache=True, error_model="numpy")
def _corners(A, H, lo, hi, norm, lens, bent, sigma, correlation, out_uv, out_cov):
    """Corners in the picture and their covariance from the last normal matrix, priors and all."""
    d = np.sqrt(np.diag(A)) + 1e-12
    scaled = A / d / d.reshape(-1, 1)
    for i in range(PARAMETERS):
        scaled[i, i] += 1e-9
    P = np.linalg.inv(scaled) / d / d.reshape(-1, 1)
    M = np.zeros((8, 8))
    for k in range(4):
        X, Y = point(H, lo if k == 0 or k == 3 else hi, lo if k < 2 else hi)
        x, y, D = X, Y, np.eye(2)
        if bent:
            x, y, D = bent_back(X, Y, lens)
        out_uv[k, 0], out_uv[k, 1] = x, y
        a, b = (X - norm[0]) / norm[2], (Y - norm[1]) / norm[2]
        B = np.zeros((2, 8))
        B[0, 0], B[0, 1], B[0, 2], B[0, 6], B[0, 7] = a, b, 1.0, -a * a, -a * b
        B[1, 3], B[1, 4], B[1, 5], B[1, 6], B[1, 7] = a, b, 1.0, -b * a, -b * b
        M[2 * k : 2 * k + 2] = norm[2] * np.linalg.inv(D) @ B
    # JPEG leaves errors that neighbouring pixels share; information falls as it does for a series that forgets.
    inflation = JPEG_SHARE * sigma * sigma * (1.0 + correlation) / (1.0 - correlation)
    place = np.ascontiguousarray(P[PLACE:BLUR, PLACE:BLUR]) * inflation
    out_cov[:] = M @ place @ M.T
