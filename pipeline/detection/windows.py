"""Where a tag that is known is in another picture: places tried by how well its cells fit, and a decoder for the rest.

The refinement needs a start within half a cell. Places are tried by the correlation of the print's cells with the grey
values under their centres: a hundred pixels a place, so that a few hundred places cost less than a tenth of
a millisecond. Cells are wide compared with the blur, so nothing needs to be rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numba
import numpy as np

from pipeline.config.site import DetectionSettings
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.prints import print_of

GOOD = 0.75
"""Correlation with which a place is believed without looking further; half a cell off it is 0.5 to 0.6."""
POSSIBLE = 0.4
"""Correlation below which refinement is not tried. It says nothing of the id: black border and white rim alone give
a tag of another id 0.7."""
THERE = 0.8
"""Correlation with which the likeliest guess is taken for the place and only climbed from."""
STEPS_AWAY = 14
"""Most steps to each side of a guess; 29 x 29 places."""

CORNER = 0.3
"""Of a cell, from its centre: where its edges are felt, blur of a third of a cell notwithstanding."""

ENOUGH = 0.7
"""Part of a print's cells that must lie in the picture: the white rim of a tag at the border may be cut off."""

SMALL_PX = 25.0
LARGE_PX = 50.0
SHARPENING = 0.5
"""For enlarged windows: enlarging blurs."""


def locate(
    grey: np.ndarray,
    family: Sequence[str],
    tag_id: Sequence[int],
    guesses: np.ndarray,
    number: np.ndarray,
    reach_px: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The best place of each of some tags near some guesses, and how well its cells correlate there.

    Parameters
    ----------
    grey : (H, W) uint8 array
        The picture.
    family, tag_id : (k,) sequences
        Which tags.
    guesses : (k, h, 4, 2) array
        Corners, px; the likeliest first.
    number : (k,) int array
        How many of the h guesses there are.
    reach_px : (k,) array
        How far from each guess to look, when none fits as it is.

    Returns
    -------
    (k, 4, 2) array
        Corners: the guess, moved but not turned.
    (k,) array
        Correlation, -1 to 1; -1 where every place would leave the picture.
    """
    k = len(tag_id)
    uv, score = np.empty((k, 4, 2)), np.full(k, -1.0)
    for i in range(k):
        pattern, border = _pattern(family[i], int(tag_id[i]))
        score[i] = _locate(grey, pattern, border, guesses[i], int(number[i]), float(reach_px[i]), uv[i])
    return uv, score


@cache
def _pattern(family: str, tag_id: int) -> tuple[np.ndarray, int]:
    """Cells of a print without their mean, their squares adding up to 1; and the width of its quad in cells."""
    of = print_of(family, tag_id)
    pattern = of.cells - of.cells.mean()
    return np.ascontiguousarray(pattern / np.linalg.norm(pattern)), of.border


@numba.njit(cache=True)
def _centres(uv, n, border, at):
    """Fill `at` (n * n, 2) with the pixels under the centres of the cells."""
    # Square to quadrilateral, closed form (Heckbert 1989).
    dx1, dy1 = uv[1, 0] - uv[2, 0], uv[1, 1] - uv[2, 1]
    dx2, dy2 = uv[3, 0] - uv[2, 0], uv[3, 1] - uv[2, 1]
    sx = uv[0, 0] - uv[1, 0] + uv[2, 0] - uv[3, 0]
    sy = uv[0, 1] - uv[1, 1] + uv[2, 1] - uv[3, 1]
    det = dx1 * dy2 - dx2 * dy1
    if abs(det) < 1e-9:
        return False
    g, h = (sx * dy2 - dx2 * sy) / det, (dx1 * sy - sx * dy1) / det
    a, b, c = uv[1, 0] - uv[0, 0] + g * uv[1, 0], uv[3, 0] - uv[0, 0] + h * uv[3, 0], uv[0, 0]
    d, e, f = uv[1, 1] - uv[0, 1] + g * uv[1, 1], uv[3, 1] - uv[0, 1] + h * uv[3, 1], uv[0, 1]
    low = 0.5 * (n - border)
    for j in range(n):
        t = (j + 0.5 - low) / border
        for i in range(n):
            s = (i + 0.5 - low) / border
            w = g * s + h * t + 1.0
            if w < 0.1:
                return False
            at[j * n + i, 0] = (a * s + b * t + c) / w
            at[j * n + i, 1] = (d * s + e * t + f) / w
    return True


@numba.njit(cache=True)
def _correlation(grey, at, pattern, dx, dy, smooth):
    """Of the cells with the grey values under their centres moved by (dx, dy): interpolated, or of the nearest pixels,
    three times as fast. Cells outside the picture do not count; -1 where they are too many.
    """
    height, width = grey.shape
    total, square, product, mean, norm = 0.0, 0.0, 0.0, 0.0, 0.0
    n = len(at)
    inside = 0
    half = 0.0 if smooth else 0.5
    for k in range(n):
        x, y = at[k, 0] + dx + half, at[k, 1] + dy + half
        if not (x >= 0.0 and y >= 0.0 and x < width - 1.0 + half and y < height - 1.0 + half):
            continue
        i, j = int(x), int(y)
        if smooth:
            fx, fy = x - i, y - j
            top = grey[j, i] + fx * (float(grey[j, i + 1]) - float(grey[j, i]))
            low = grey[j + 1, i] + fx * (float(grey[j + 1, i + 1]) - float(grey[j + 1, i]))
            value = top + fy * (low - top)
        else:
            value = float(grey[j, i])
        inside += 1
        total += value
        square += value * value
        product += pattern[k] * value
        mean += pattern[k]
        norm += pattern[k] * pattern[k]
    if inside < ENOUGH * n:
        return -1.0
    spread = square - total * total / inside
    print_spread = norm - mean * mean / inside
    # Grey values that hardly differ correlate with anything: 2 levels is less than any print keeps.
    return (product - mean * total / inside) / np.sqrt(max(spread, 4.0 * inside) * max(print_spread, 1e-3))


@numba.njit(cache=True)
def _locate(grey, pattern, border, guesses, number, reach_px, uv):
    n = len(pattern)
    flat = pattern.ravel()
    at = np.empty((n * n, 2))
    fine, quarter = np.empty((4 * n * n, 2)), np.empty(4 * n * n)
    if _centres(guesses[0], n, border, at):
        # A tag that goes its way is where it was expected.
        cell = _cell_px(guesses[0], border)
        _four_each(at, flat, n, fine, quarter)
        best = _correlation(grey, fine, quarter, 0.0, 0.0, True)
        if best > THERE:
            return _climb(grey, fine, quarter, best, 0.0, 0.0, 0.2 * cell, guesses[0], uv)
    best, best_dx, best_dy, which = -1.0, 0.0, 0.0, 0
    uv[:] = guesses[0]
    for wide in range(2):
        for k in range(number):
            quad = guesses[k]
            cell = _cell_px(quad, border)
            near = False
            for other in range(k):
                apart = 0.0
                for corner in range(4):
                    apart = max(apart, abs(quad[corner, 0] - guesses[other, corner, 0]))
                    apart = max(apart, abs(quad[corner, 1] - guesses[other, corner, 1]))
                near = near or apart < 0.25 * cell
            if near or not _centres(quad, n, border, at):
                continue
            step = (0.3 if wide == 0 else 0.45) * cell
            away = 2 if wide == 0 else min(int(np.ceil(reach_px / step)), STEPS_AWAY)
            for j in range(-away, away + 1):
                for i in range(-away, away + 1):
                    score = _correlation(grey, at, flat, i * step, j * step, wide == 0)
                    if score > best:
                        best, best_dx, best_dy, which = score, i * step, j * step, k
            # A likely guess that fits needs no other.
            if best > 0.85:
                break
        if best > GOOD:
            break
    if best <= -1.0:
        return best
    if not _centres(guesses[which], n, border, at):
        return -1.0
    _four_each(at, flat, n, fine, quarter)
    best = _correlation(grey, fine, quarter, best_dx, best_dy, True)
    step = 0.2 * _cell_px(guesses[which], border)
    return _climb(grey, fine, quarter, best, best_dx, best_dy, step, guesses[which], uv)


@numba.njit(cache=True)
def _cell_px(quad, border):
    """Width of a cell, px, along the shorter of two sides."""
    along = np.sqrt((quad[1, 0] - quad[0, 0]) ** 2 + (quad[1, 1] - quad[0, 1]) ** 2)
    down = np.sqrt((quad[3, 0] - quad[0, 0]) ** 2 + (quad[3, 1] - quad[0, 1]) ** 2)
    return max(min(along, down) / border, 0.5)


@numba.njit(cache=True)
def _four_each(at, flat, n, fine, quarter):
    """Four points a cell, near its corners, into `fine`, with the pattern there.

    Cells are flat inside, so their centres place a wide cell badly: half a cell off the fit is as good. These feel
    every edge.
    """
    for j in range(n):
        for i in range(n):
            k = j * n + i
            # Along and down the cell, from its neighbours' centres.
            ax, ay = at[k + 1 if i + 1 < n else k, 0], at[k + 1 if i + 1 < n else k, 1]
            ax, ay = ax - at[k if i + 1 < n else k - 1, 0], ay - at[k if i + 1 < n else k - 1, 1]
            bx, by = at[k + n if j + 1 < n else k, 0], at[k + n if j + 1 < n else k, 1]
            bx, by = bx - at[k if j + 1 < n else k - n, 0], by - at[k if j + 1 < n else k - n, 1]
            for corner in range(4):
                s, t = CORNER * (2 * (corner % 2) - 1), CORNER * (2 * (corner // 2) - 1)
                fine[4 * k + corner, 0] = at[k, 0] + s * ax + t * bx
                fine[4 * k + corner, 1] = at[k, 1] + s * ay + t * by
                quarter[4 * k + corner] = 0.5 * flat[k]


@numba.njit(cache=True)
def _climb(grey, fine, quarter, best, dx, dy, step, quad, uv):
    """From a place up to the best one beside it, which goes into `uv`; its correlation.

    Along rows and columns by `step` px, and from there by the top of a parabola each way. A grid of 27 places, down to
    a twentieth of a cell, took three times as long and was no nearer.
    """
    left = right = above = below = best
    for _ in range(6):
        left = _correlation(grey, fine, quarter, dx - step, dy, True)
        right = _correlation(grey, fine, quarter, dx + step, dy, True)
        above = _correlation(grey, fine, quarter, dx, dy - step, True)
        below = _correlation(grey, fine, quarter, dx, dy + step, True)
        if max(left, right) <= best and max(above, below) <= best:
            break
        ways = np.array([left, right, above, below])
        way = int(np.argmax(ways))
        best = ways[way]
        dx += (-step, step, 0.0, 0.0)[way]
        dy += (0.0, 0.0, -step, step)[way]
        left = right = above = below = best
    bend = left - 2.0 * best + right
    if bend < 0.0:
        dx += 0.5 * step * (left - right) / bend
    bend = above - 2.0 * best + below
    if bend < 0.0:
        dy += 0.5 * step * (above - below) / bend
    for corner in range(4):
        uv[corner, 0] = quad[corner, 0] + dx
        uv[corner, 1] = quad[corner, 1] + dy
    return best


class WindowDecoder:
    """The decoder, for the neighbourhood of one tag: small tags enlarged and sharpened, large ones decimated."""

    def __init__(self, settings: DetectionSettings | None = None):
        self._settings = settings or DetectionSettings()
        self._finders: dict[tuple[str, int], TagFinder] = {}

    def find(
        self, grey: np.ndarray, family: str, tag_id: int, uv: np.ndarray, reach_px: float
    ) -> np.ndarray | None:
        """Corners of a tag within `reach_px` of where it was, (4, 2) -> (4, 2); None if it is not decoded there."""
        side = float(np.sqrt(max(cv2.contourArea(uv.astype(np.float32)), 1.0)))
        margin = reach_px + 0.35 * side + 4.0
        low = np.maximum(np.floor(uv.min(axis=0) - margin), 0).astype(int)
        high = np.minimum(np.ceil(uv.max(axis=0) + margin), [grey.shape[1] - 1, grey.shape[0] - 1]).astype(
            int
        )
        if np.any(high - low < 8):
            return None
        window = np.ascontiguousarray(grey[low[1] : high[1] + 1, low[0] : high[0] + 1])
        zoom = 2 if side < SMALL_PX else 1
        decimate = 2 if side > LARGE_PX else 1
        if zoom > 1:
            window = cv2.resize(window, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        found = self._finder(family, zoom, decimate).find(window)
        mine = np.flatnonzero(
            (found.tag_id == tag_id)
            & (found.hamming <= self._settings.max_hamming)
            & (found.margin >= self._settings.min_margin)
        )
        if not len(mine):
            return None
        at = (found.uv[mine] + 0.5) / zoom - 0.5 + low
        away = np.linalg.norm(at.mean(axis=1) - uv.mean(axis=0), axis=1)
        return np.asarray(at[np.argmin(away)])

    def _finder(self, family: str, zoom: int, decimate: int) -> TagFinder:
        key = family, zoom * 10 + decimate
        if key not in self._finders:
            sharpening = max(self._settings.decode_sharpening, SHARPENING if zoom > 1 else 0.0)
            changed = {"quad_decimate": float(decimate), "decode_sharpening": sharpening}
            self._finders[key] = TagFinder([family], self._settings.model_copy(update=changed))
        return self._finders[key]
