"""Parts of a print that fit by themselves where something lies over the rest. Compiled, see `alignment`.

A cover whose edge runs along a side of the tag is taken for that side, and the homography gives way: every cell then
misfits a little, and none stands out. Of 1,000 tags under covers 17 were wrong by 5 to 8 of their sigmas before parts
were tried, and one was after.
"""

from __future__ import annotations

import numba
import numpy as np

from pipeline.detection.gauss_newton import change, furthest, moved, normal_equations, solve
from pipeline.detection.image_model import GAIN, linearise
from pipeline.detection.integrity import mask, noise_on_edges, rms_of_cells

COARSE_STEP_PX = 0.15
BETTER = 0.5
"""Part of the whole's mean square that a part must get below: sharpened photographs misfit everywhere a little."""


@numba.njit(cache=True, error_model="numpy")
def best_part(grey, cells, n, masked, H, par, prior, place, strides, room_for):
    """Fit parts of the print alone, and take the one by which most of the print lies well, if the whole does not.

    The parts: without four tenths at one side, without a corner, and without the rim. How well the print lies is the
    mean square residual of its cells, none counted for more than 12 % of the contrast, so that a covered cell is a
    covered cell however bright its cover is. True if a part was better; `H`, `par` and `masked` are then those of it.
    """
    lens, bent, norm, window, quiet, lo, hi, cell_px = place
    coarse, _, flat = strides
    J, r, who = room_for
    nothing = np.zeros_like(masked)
    rms = np.empty(n * n)
    first_H, first_par = H.copy(), par.copy()
    best = -1.0
    for part in range(10):
        trial_H, trial_par = first_H.copy(), first_par.copy()
        if part > 0:
            held = _held_out(part, n, masked.shape[0])
            for _ in range(3):
                m = linearise(
                    grey, cells, n, held, True, lens, bent, np.linalg.inv(trial_H), norm, trial_par, window,
                    coarse, max(flat, coarse), quiet, J, r, who,
                )  # fmt: skip
                sigma, edge = noise_on_edges(r, who, m)
                if m < 40 or edge < 30:
                    break
                A, b = normal_equations(J, r, m)
                x = solve(A, b, trial_par, prior, sigma)
                step_px = furthest(trial_H, lo, hi, norm, x)
                x *= min(1.0, max(0.35 * cell_px, 0.5) / max(step_px, 1e-12))
                trial_H = moved(trial_H, norm, x)
                change(trial_par, x, cell_px)
                if step_px < COARSE_STEP_PX:
                    break
        m = linearise(
            grey, cells, n, nothing, False, lens, bent, np.linalg.inv(trial_H), norm, trial_par, window,
            coarse, max(flat, coarse), quiet, J, r, who,
        )  # fmt: skip
        rms_of_cells(r, who, m, n, rms)
        cap, total = 0.12 * first_par[GAIN], 0.0
        for c in range(n * n):
            if rms[c] >= 0.0:
                total += min(rms[c], cap) ** 2
        if part == 0:
            best = BETTER * total
        elif total < best:
            H[:] = trial_H
            par[:] = trial_par
            masked[:] = False
            mask(r, who, m, n, par, masked, 3.0)
            best = total
    return not np.array_equal(H, first_H)


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
