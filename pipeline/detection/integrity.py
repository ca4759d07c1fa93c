"""What is wrong with a fit: its noise, cells that stand out, cells that say another id. Compiled for `alignment`."""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.detection.image_model import AT_END, GAIN, OFFSET, ON_EDGE, VEIL_TERMS, brightness, veil
from pipeline.detection.straightening import bent_back


@numba.njit(cache=True, inline="always", error_model="numpy")
def point(H, s, t):
    """Undistorted pixel of a place on the print."""
    z = 1.0 / (H[2, 0] * s + H[2, 1] * t + H[2, 2])
    return (H[0, 0] * s + H[0, 1] * t + H[0, 2]) * z, (H[1, 0] * s + H[1, 1] * t + H[1, 2]) * z


@numba.njit(cache=True, error_model="numpy")
def noise_on_edges(r, who, m):
    """Standard deviation of the residuals on edges, grey values, and how many there are."""
    edge, square = 0, 0.0
    for k in range(m):
        if who[k, 1] == ON_EDGE:
            edge += 1
            square += r[k] * r[k]
    return math.sqrt(max(square / max(edge - 12, 8), 0.1)), edge


@numba.njit(cache=True, error_model="numpy")
def neighbours(r, who, m, sigma):
    """Correlation of the residuals of pixels beside each other, on edges; 0 to 0.6, beyond which it is no noise."""
    pairs, product = 0, 0.0
    for k in range(m - 1):
        if who[k + 1, 2] == who[k, 2] + 1 and who[k, 1] == ON_EDGE and who[k + 1, 1] == ON_EDGE:
            pairs += 1
            product += r[k] * r[k + 1]
    return min(max(product / (pairs * sigma * sigma), 0.0), 0.6) if pairs > 0 else 0.0


@numba.njit(cache=True, error_model="numpy")
def pattern(J, m, par):
    """Standard deviation of the modelled print over the pixels used, grey values."""
    if m == 0:
        return 0.0
    mean, square = 0.0, 0.0
    for k in range(m):
        mean += J[k, GAIN]
        square += J[k, GAIN] ** 2
    mean /= m
    return par[GAIN] * math.sqrt(max(square / m - mean * mean, 0.0))


@numba.njit(cache=True, error_model="numpy")
def rms_of_cells(r, who, m, n, rms):
    """Root mean square residual of each cell into `rms`, -1 where no pixel was used; how many were."""
    number = np.zeros(n * n)
    rms[:] = 0.0
    for k in range(m):
        if who[k, 1] != AT_END:
            rms[who[k, 0]] += r[k] * r[k]
            number[who[k, 0]] += 1.0
    for c in range(n * n):
        rms[c] = math.sqrt(rms[c] / number[c]) if number[c] > 0 else -1.0
    return number


@numba.njit(cache=True, error_model="numpy")
def mask(r, who, m, n, par, masked, times):
    """Mark cells with residuals of `times` the usual; whether the marks changed, and the share of cells not marked."""
    rms = np.empty(n * n)
    number = rms_of_cells(r, who, m, n, rms)
    usual = np.empty(n * n)
    have = 0
    for c in range(n * n):
        if number[c] >= 3:
            usual[have] = rms[c]
            have += 1
    if have < 8:
        return False, 0.0
    middle = max(np.median(usual[:have]), 0.8)
    changed, kept = False, 0
    for j in range(n):
        for i in range(n):
            c = j * n + i
            if masked[j, i]:
                continue
            # Of few pixels the rms itself is uncertain; beside a covered cell a little is suspicious.
            beside = (
                masked[j, max(i - 1, 0)]
                or masked[j, min(i + 1, n - 1)]
                or masked[max(j - 1, 0), i]
                or masked[min(j + 1, n - 1), i]
            )
            limit = middle * ((1.4 if beside else times) + 4.0 / math.sqrt(max(number[c], 1.0)))
            if not beside:
                limit += 0.02 * par[GAIN]
            if number[c] > 0 and rms[c] > limit:
                masked[j, i] = True
                changed = True
            else:
                kept += 1
    return changed, kept / (n * n)


@numba.njit(cache=True, error_model="numpy")
def unevenness(r, who, m, n, par, masked):
    """Mean square of what cells are too bright or too dark, over what noise leaves; 1 where there is but noise.

    0 where it is less than 4 % of the contrast: on a large tag the least of dirt is beyond noise.
    """
    total, square, number = np.zeros(n * n), np.zeros(n * n), np.zeros(n * n)
    for k in range(m):
        if who[k, 1] != AT_END:
            c = who[k, 0]
            total[c] += r[k]
            square[c] += r[k] * r[k]
            number[c] += 1.0
    between, within, means, cells = 0.0, 0.0, 0.0, 0
    for c in range(n * n):
        if number[c] >= 4 and not masked[c // n, c % n]:
            mean = total[c] / number[c]
            means += mean * mean
            between += number[c] * mean * mean
            within += (square[c] - number[c] * mean * mean) / (number[c] - 1.0)
            cells += 1
    if cells == 0 or means < cells * (0.04 * par[GAIN]) ** 2:
        return 0.0
    return between / max(within, 0.3 * cells)


@numba.njit(cache=True, error_model="numpy")
def level(r, who, m, n, par, masked, levels):
    """Give each cell the brightness that its pixels show, `levels` (0 black, 1 white) changed in place."""
    total, number = np.zeros(n * n), np.zeros(n * n)
    for k in range(m):
        if who[k, 1] != AT_END:
            total[who[k, 0]] += r[k]
            number[who[k, 0]] += 1.0
    for j in range(n):
        for i in range(n):
            c = j * n + i
            if number[c] >= 4 and not masked[j, i]:
                # Pixels at a cell's edge show its neighbours too: what is left comes with the next step.
                levels[j, i] += total[c] / number[c] / par[GAIN]


@numba.njit(cache=True, error_model="numpy")
def contradicted(grey, cells, levels, n, lens, bent, H, norm, par):
    """Cells, masked or not, whose middle is not as bright as it should be: of all, and of those that carry the id."""
    height, width = grey.shape
    G, scratch, terms = np.linalg.inv(H), np.empty((5, 26)), np.empty(VEIL_TERMS)
    every, within = 0, 0
    for j in range(n):
        for i in range(n):
            X, Y = point(H, i + 0.5, j + 0.5)
            x, y = X, Y
            if bent:
                x, y, _ = bent_back(X, Y, lens)
            if not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0):
                continue
            left, top = int(x), int(y)
            a, b = x - left, y - top
            seen = (1 - b) * ((1 - a) * grey[top, left] + a * grey[top, left + 1]) + b * (
                (1 - a) * grey[top + 1, left] + a * grey[top + 1, left + 1]
            )
            u, v = (X - norm[0]) / norm[2], (Y - norm[1]) / norm[2]
            dark, gain = par[OFFSET] + par[2] * u + par[3] * v, par[GAIN] + par[4] * u + par[5] * v
            dark += veil(par, u, v, terms)
            # Blur only draws a cell towards its neighbours: most need not be blurred to know.
            level = min(max(levels[j, i], 0.0), 1.0)
            if levels[j, i] == cells[j, i] and abs(seen - min(dark + gain * level, 255.0)) < 0.1 * par[GAIN]:
                continue
            model = dark + gain * brightness(levels, n, G, X, Y, par, scratch)
            if abs(seen - min(model, 255.0)) > 0.4 * par[GAIN] or abs(levels[j, i] - cells[j, i]) > 0.65:
                every += 1
                if 2 <= i < n - 2 and 2 <= j < n - 2:
                    within += 1
    return every, within
