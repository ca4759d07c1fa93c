"""One Gauss-Newton step of a print's alignment: what is known beforehand, the solution, and what it moves. Compiled."""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.detection.image_model import (
    BLUR,
    GAIN,
    GROUND,
    PARAMETERS,
    PIXEL_VARIANCE,
    PLACE,
    RESPONSE,
    VEIL_TERMS,
    linearise,
)
from pipeline.detection.integrity import noise_on_edges, point
from pipeline.detection.veil import ROWS, eliminate_veil

COARSE_STEP_PX = 0.6
"""A step this short ends the steps on a part of the pixels."""
PLAIN, BY_CELL, VEILED = range(3)
"""Light: as the model has it; each cell with a brightness of its own; with a veil over the print."""
LEAST_PIXELS, LEAST_ON_EDGES = 40, 30
"""Fewer determine no print."""
LEAST_VARIANCE = 0.06
"""px²; cameras that sharpen show edges steeper than a pixel's own 1/12."""


@numba.njit(cache=True, error_model="numpy")
def step(grey, levels, n, masked, H, par, prior, place, stride, flat, light, room_for):
    """One step from `H` and `par`, which is changed, on one in `stride` pixels near edges and in `flat` of the rest.

    Returns the homography after it, the pixels used (0 if they are too few; nothing is changed then), the normal
    matrix with its priors, the step as it was taken, the veil's after the parameters', and how far it moved a corner,
    px. `room_for` holds derivatives, residuals and owners of the pixels before the step.
    """
    lens, bent, norm, window, quiet, lo, hi, cell_px = place
    J, r, who = room_for
    m = linearise(
        grey, levels, n, masked, masked.any(), lens, bent, np.linalg.inv(H), norm, par, window,
        stride, stride * math.ceil(flat / stride), quiet, J, r, who,
    )  # fmt: skip
    sigma, edge = noise_on_edges(r, who, m)
    if m < LEAST_PIXELS or edge < LEAST_ON_EDGES:
        return H, 0, np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS + VEIL_TERMS), 0.0
    A, b = _normal_equations(J, r, m)
    x = np.zeros(PARAMETERS + VEIL_TERMS)
    K = np.zeros((VEIL_TERMS, PARAMETERS))
    if light == VEILED:
        K, x[PARAMETERS:] = eliminate_veil(A, b, J, r, m, par, sigma)
    if light == BY_CELL:
        # The cells' own brightness and the light over all of them say the same: the light stays.
        for k in range(PLACE):
            A[k, k] += 1e9 * (1.0 + A[k, k])
    of_print = _solve(A, b, par, prior, sigma)
    x[:PARAMETERS] = of_print
    x[PARAMETERS:] -= K @ of_print
    step_px = _furthest(H, lo, hi, norm, x)
    # A step that moves a corner further than a third of a cell left the valley: shorten it.
    part = min(1.0, max(0.35 * cell_px, 0.5) / max(step_px, 1e-12))
    x *= part
    _change(par, x, cell_px)
    return _moved(H, norm, x), m, A, x, step_px * part


@numba.njit(cache=True, error_model="numpy")
def _add_prior(A, b, k, difference, sigma, noise):
    weight = (noise / sigma) ** 2
    A[k, k] += weight
    b[k] += weight * difference


@numba.njit(cache=True, error_model="numpy")
def _add_priors(A, b, par, prior, noise):
    """What is known beforehand, beside observations whose standard deviation is `noise`."""
    _add_prior(A, b, BLUR, prior[0] ** 2 + PIXEL_VARIANCE - par[BLUR], prior[1], noise)
    for k in range(BLUR + 1, BLUR + 3):
        _add_prior(A, b, k, -par[k], prior[2], noise)
    _add_prior(A, b, RESPONSE, prior[3] - par[RESPONSE], prior[4], noise)
    for k in range(GAIN + 1, PLACE):
        _add_prior(A, b, k, -par[k], 0.3 * par[GAIN] + 1.0, noise)
    for k in range(GROUND, PARAMETERS):
        _add_prior(A, b, k, -par[k], par[GAIN], noise)


@numba.njit(cache=True, error_model="numpy")
def _normal_equations(J, r, m):
    """J'J and J'r of the first m rows, a few at a time.

    Larger products are shared out among threads by the library of linear algebra, and summed in another order: one
    process would then find other last digits than two.
    """
    A, b = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    for first in range(0, m, ROWS):
        some = J[first : min(first + ROWS, m)]
        A += some.T @ some
        b += some.T @ r[first : min(first + ROWS, m)]
    return A, b


@numba.njit(cache=True, error_model="numpy")
def _solve(A, b, par, prior, noise):
    """Gauss-Newton step; A is left with the priors in it."""
    _add_priors(A, b, par, prior, noise)
    d = np.sqrt(np.diag(A)) + 1e-12
    scaled = A / d / d.reshape(-1, 1)
    for i in range(PARAMETERS):
        scaled[i, i] += 1e-6
    return np.linalg.solve(scaled, b / d) / d


@numba.njit(cache=True, error_model="numpy")
def _furthest(H, lo, hi, norm, x):
    """How far a step moves the corner that it moves most, px."""
    most = 0.0
    for k in range(4):
        X, Y = point(H, lo if k == 0 or k == 3 else hi, lo if k < 2 else hi)
        a, b = (X - norm[0]) / norm[2], (Y - norm[1]) / norm[2]
        g = a * x[PLACE + 6] + b * x[PLACE + 7]
        dx = norm[2] * (x[PLACE] * a + x[PLACE + 1] * b + x[PLACE + 2] - a * g)
        dy = norm[2] * (x[PLACE + 3] * a + x[PLACE + 4] * b + x[PLACE + 5] - b * g)
        most = max(most, math.sqrt(dx * dx + dy * dy))
    return most


@numba.njit(cache=True, error_model="numpy")
def _moved(H, norm, x):
    """The homography after a step, which acts on the window's own coordinates."""
    W = np.empty((3, 3))
    for i in range(8):
        W[i // 3, i % 3] = x[PLACE + i]
    W[2, 2] = 0.0
    W += np.eye(3)
    into = np.array([[1 / norm[2], 0, -norm[0] / norm[2]], [0, 1 / norm[2], -norm[1] / norm[2]], [0, 0, 1.0]])
    back = np.array([[norm[2], 0, norm[0]], [0, norm[2], norm[1]], [0, 0, 1.0]])
    return back @ W @ into @ H


@numba.njit(cache=True, error_model="numpy")
def _change(par, x, cell_px):
    """Light, blur and response after a step, within what there can be."""
    for i in range(len(x)):
        if i < PLACE or i >= BLUR:
            par[i] += x[i]
    par[BLUR] = min(max(par[BLUR], LEAST_VARIANCE), max(5.0, 0.5 * cell_px * cell_px))
    streak = math.sqrt(par[BLUR + 1] ** 2 + par[BLUR + 2] ** 2)
    most = max(0.9 * (par[BLUR] - PIXEL_VARIANCE), 0.01)
    if streak > most:
        par[BLUR + 1] *= most / streak
        par[BLUR + 2] *= most / streak
    par[RESPONSE] = min(max(par[RESPONSE], -0.9), 0.9)
