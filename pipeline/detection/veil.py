"""A veil of light over a print, as a low sun or a dirty lens lays it: what of it no slope describes. Compiled.

The light over a print is an offset and a gain with slopes, see `image_model`. A hot spot beside the tag is bent, and
the edges of the print gave way to what was left of it: 0.08 px where the noise leaves 0.01, and 2.3 times what sigma
said. So where the residuals are bent a polynomial of the fourth order is added to the grey values. It is eliminated
from the normal equations first: what is sure of the print falls by what the two have in common.
"""

from __future__ import annotations

import numba
import numpy as np

from pipeline.detection.image_model import GAIN, PARAMETERS, VEIL_TERMS, veil_terms

ROWS = 384
"""Pixels in one product of matrices, here and in `gauss_newton`, which says why."""
BENT_SIGMAS = 8.0
"""How surely the residuals must be bent. Of 1,000 evenly lit tags 36 were at 4.5, 15 at 6 and 4 here, whose corners
were up to twice as far off with the veil as without."""


@numba.njit(cache=True, error_model="numpy")
def bent_light(J, r, m, sigma):
    """Whether residuals, whose standard deviation is `sigma`, follow a bend over the print beyond chance."""
    terms, product, square = np.empty(VEIL_TERMS), np.zeros(VEIL_TERMS), np.zeros(VEIL_TERMS)
    for k in range(m):
        veil_terms(J[k, 2], J[k, 3], terms)
        for i in range(VEIL_TERMS):
            product[i] += terms[i] * r[k]
            square[i] += terms[i] * terms[i]
    return np.any(np.abs(product) > BENT_SIGMAS * sigma * np.sqrt(square))


@numba.njit(cache=True, error_model="numpy")
def eliminate_veil(A, b, J, r, m, par, noise):
    """Take the veil out of normal equations of the first m rows, changed in place.

    Returns ``K`` and ``c``: the veil changes by ``c - K x`` where the parameters change by ``x``.
    """
    C, c = np.zeros((VEIL_TERMS, VEIL_TERMS)), np.zeros(VEIL_TERMS)
    B = np.zeros((PARAMETERS, VEIL_TERMS))
    some = np.empty((ROWS, VEIL_TERMS))
    for first in range(0, m, ROWS):
        last = min(first + ROWS, m)
        for k in range(first, last):
            veil_terms(J[k, 2], J[k, 3], some[k - first])
        Q = some[: last - first]
        C += Q.T @ Q
        B += J[first:last].T @ Q
        c += Q.T @ r[first:last]
    weight = (noise / (0.3 * par[GAIN] + 1.0)) ** 2
    for i in range(VEIL_TERMS):
        C[i, i] += weight
        c[i] -= weight * par[PARAMETERS + i]
    K, change = np.linalg.solve(C, B.T.copy()), np.linalg.solve(C, c)
    A -= B @ K
    b -= B @ change
    return np.ascontiguousarray(K), change


@numba.njit(cache=True, error_model="numpy")
def without_veil(J, r, m, change):
    """Residuals of the first m rows after a change of the veil, in place."""
    terms = np.empty(VEIL_TERMS)
    for k in range(m):
        veil_terms(J[k, 2], J[k, 3], terms)
        for i in range(VEIL_TERMS):
            r[k] -= terms[i] * change[i]
