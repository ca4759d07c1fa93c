"""Steps of a print's alignment until nothing moves: on a part of the pixels, on all that are asked for, by parts.

Compiled for `alignment`, which judges what they leave.
"""

from __future__ import annotations

import math

import numba

from pipeline.detection.gauss_newton import BY_CELL, COARSE_STEP_PX, PLAIN, VEILED, step
from pipeline.detection.image_model import BLUR, GAIN, PARAMETERS
from pipeline.detection.integrity import level, mask, noise_on_edges, point
from pipeline.detection.parts import best_part
from pipeline.detection.veil import without_veil

QUIET = 0.02
"""Noise over contrast for which a limit of pixels is meant; noisier tags get more of them, by its square."""
FINE_STEP_PX, FINEST_STEP_PX = 0.2, 0.005
"""A step this short is the last one: edges are as steep on either side, so what it leaves undone is of the third order.
The second where every pixel is used: two starts then end a third of a sigma apart. With 0.1 for the first there were a
tenth more steps on a part of the pixels, and corners were no nearer to the truth in the third digit."""
CALM = 0.04
"""Residuals over contrast after one coarse step, up to which it may be the only one; where something lies over the
print they are larger, and cells stand out from the second step on."""
STRAYED_PX = 1.2
"""How far a print may go from where a part of it lay. A cover along one side took it 2 px away, to a place that seemed
good and was 7 sigmas off; at 0.6 a third of what is covered and stands would be lost."""
MORE_PARTLY = 2.0
"""Of which at most so many times the contrast's share counts."""


@numba.njit(cache=True, error_model="numpy")
def approach(grey, cells, n, masked, H, par, prior, place, strides, room_for):
    """Steps on a part of the pixels until they are short; marks cells in `masked`, changes `par`.

    Returns the homography, how many pixels were used (0 where too few were left; their residuals are those after the
    last step) and the share of cells not masked.
    """
    coarse, _, flat = strides
    _, r, who = room_for
    share, steps = 1.0, 0
    while True:
        H, m, _, sigma, step_px = _stepped(
            grey, cells, n, masked, H, par, prior, place, coarse, flat, PLAIN, room_for
        )
        if m == 0:
            return H, 0, share
        steps += 1
        changed = False
        if steps >= 2 and step_px < 0.5:
            changed, share = mask(r, who, m, n, par, masked, 3.0)
        short = step_px < COARSE_STEP_PX and not changed
        if (short and (steps >= 2 or sigma < CALM * par[GAIN])) or steps >= 8:
            return H, m, share


@numba.njit(cache=True, error_model="numpy")
def settle(grey, levels, n, masked, H, par, prior, place, strides, room_for, light):
    """Steps on all pixels that are asked for until they are short; marks cells in `masked`, changes `par`.

    With fewer pixels as long as they move: how many the noise asks for is known when they no longer do. Returns as
    `approach` does, the normal matrix with its priors after the pixels.
    """
    _, fine, flat = strides
    _, r, who = room_for
    share, steps, more, uneven = 1.0, 0, 1.0, light == BY_CELL
    while True:
        stride = max(1, math.ceil(fine / more))
        H, m, A, sigma, step_px = _stepped(
            grey, levels, n, masked, H, par, prior, place, stride, flat, light, room_for
        )
        if m == 0:
            return H, 0, A, share
        steps += 1
        changed, share = mask(r, who, m, n, par, masked, 2.0 if uneven else 3.0)
        if uneven:
            level(r, who, m, n, par, masked, levels)
        short = step_px < (FINE_STEP_PX if stride > 1 else FINEST_STEP_PX)
        still = (short and not changed and not uneven) or steps >= 6
        if uneven or (still and more == 1.0):
            most = 3.0 if share == 1.0 else MORE_PARTLY
            more = min(max(sigma / (QUIET * max(par[GAIN], 1.0)), 1.0), most) ** 2
        if steps >= 8 or (still and max(1, math.ceil(fine / more)) >= stride):
            return H, m, A, share


@numba.njit(cache=True, error_model="numpy")
def by_parts(grey, cells, n, masked, H, par, prior, place, strides, room_for, room_for_parts):
    """The print laid by the part of it that fits by itself, as `settle` does; and whether it strayed from that part:
    then it gave way to what lies over it.
    """
    lo, hi = place[5], place[6]
    of_part = best_part(grey, cells, n, masked, H, par, prior, place, strides, room_for_parts)
    H, m, A, share = settle(grey, cells, n, masked, of_part, par, prior, place, strides, room_for, PLAIN)
    return H, m, A, share, m > 0 and _apart(of_part, H, lo, hi) > STRAYED_PX


@numba.njit(cache=True, error_model="numpy")
def _apart(H, other, lo, hi):
    """How far two homographies put the corner that they agree on least, px."""
    most = 0.0
    for k in range(4):
        s, t = lo if k == 0 or k == 3 else hi, lo if k < 2 else hi
        x, y = point(H, s, t)
        u, v = point(other, s, t)
        most = max(most, math.sqrt((u - x) ** 2 + (v - y) ** 2))
    return most


@numba.njit(cache=True, error_model="numpy")
def _stepped(grey, levels, n, masked, H, par, prior, place, stride, flat, light, room_for):
    """`step`, with the residuals as they are after it; their standard deviation in place of the step.

    How far it moved counts the width of the blur too: where that is still on its way, so is all else. Without it one of
    150 tags was left 5.5 sigmas off, its blur half-way.
    """
    blur_px = math.sqrt(par[BLUR])
    H, m, A, x, step_px = step(grey, levels, n, masked, H, par, prior, place, stride, flat, light, room_for)
    J, r, who = room_for
    for k in range(m):
        for i in range(PARAMETERS):
            r[k] -= J[k, i] * x[i]
    if light == VEILED:
        without_veil(J, r, m, x[PARAMETERS:])
    return H, m, A, noise_on_edges(r, who, m)[0], max(step_px, abs(math.sqrt(par[BLUR]) - blur_px))
