"""Parts of a print that fit by themselves where something lies over the rest. Compiled, see `alignment`.

A cover whose edge runs along a side of the tag is taken for that side, and the homography gives way: every cell then
misfits a little, and none stands out. Of 1,000 tags under covers 260 were believed before parts were tried, 17 of them
wrong by 5 to 8 of their sigmas; 295 were after, and one of them wrong.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.detection.gauss_newton import COARSE_STEP_PX, PLAIN, step
from pipeline.detection.image_model import GAIN, linearise
from pipeline.detection.integrity import mask, rms_of_cells

BETTER = 0.7
"""Part of the whole's mean square that a part must get below: sharpened photographs misfit everywhere a little. At 0.5
a white cover along a side stayed the print's own rim (7 sigmas off)."""


@numba.njit(cache=True, error_model="numpy")
def best_part(grey, cells, n, masked, H, par, prior, place, strides, room_for):
    """Fit parts of the print alone, and begin again with the one by which most of the print lies well.

    The parts: without four tenths at one side, without a corner, and without the rim. How well the print lies is the
    mean square residual of its cells, none counted for more than 12 % of the contrast, so that a covered cell is a
    covered cell however bright its cover is. The whole stays where no part is better by far; cells are masked anew
    either way, as more of them stand out on the way to a place than there. Returns the homography; `par` and `masked`
    are changed.
    """
    lens, bent, norm, window, quiet, _, _, _ = place
    coarse, _, flat = strides
    coarse *= 2
    J, r, who = room_for
    nothing = np.zeros_like(masked)
    rms = np.empty(n * n)
    first_H, first_par = H.copy(), par.copy()
    best = -1.0
    for part in range(10):
        trial_H, trial_par = first_H.copy(), first_par.copy()
        if part > 0:
            held = _held_out(part, n, masked.shape[0])
            for _ in range(2):
                trial_H, used, _, _, step_px = step(
                    grey, cells, n, held, trial_H, trial_par, prior, place, coarse, flat, PLAIN, room_for
                )
                if used == 0 or step_px < COARSE_STEP_PX:
                    break
        m = linearise(
            grey, cells, n, nothing, False, lens, bent, np.linalg.inv(trial_H), norm, trial_par, window,
            coarse, coarse * math.ceil(flat / coarse), quiet, J, r, who,
        )  # fmt: skip
        rms_of_cells(r, who, m, n, rms)
        cap, total = 0.12 * first_par[GAIN], 0.0
        for c in range(n * n):
            if rms[c] >= 0.0:
                total += min(rms[c], cap) ** 2
        if part == 0 or total < best:
            H = trial_H
            par[:] = trial_par
            masked[:] = False
            mask(r, who, m, n, par, masked, 3.0)
            best = BETTER * total if part == 0 else total
    return H


@numba.njit(cache=True, error_model="numpy")
def _held_out(part, n, size):
    """Cells that part number 1 to 9 of a print leaves out."""
    held = np.zeros((size, size), np.bool_)
    wide = int(0.4 * n + 0.5)
    for j in range(n):
        for i in range(n):
            s, t = (i, n - 1 - i)[part % 2], (j, n - 1 - j)[part // 2 % 2]
            if part <= 2:
                held[j, i] = (i, n - 1 - i)[part - 1] < wide
            elif part <= 4:
                held[j, i] = (j, n - 1 - j)[part - 3] < wide
            elif part <= 8:
                held[j, i] = s + t < 0.8 * n
            else:
                held[j, i] = min(min(i, n - 1 - i), min(j, n - 1 - j)) < 2
    return held
