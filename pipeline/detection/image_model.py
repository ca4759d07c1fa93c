"""What a camera makes of a print: grey values of each pixel, and how they move with the print's place, light and blur.

A print is a grid of black and white cells. Pixels see it through a homography and through a blur that is a Gaussian
in pixels (lens, motion and the pixel's own square, whose variance is 1/12 px²). In the print's own coordinates, s to
the right and t downwards in cells, the blur has the standard deviations sigma_s, sigma_t and the covariance c. For
c = 0 the blurred print is a sum of products of one-dimensional weights; for the rest

    T = exp(c d/ds d/dt) T0 = T0 + c T0_st + c²/2 T0_sstt + c³/6 T0_ssttt...

is the tetrachoric series, cut after the third power: for the most oblique of views (correlation 0.6) 0.002 of the
contrast is left out at a cell's corner, 0.004 where four cells meet as on a chessboard. Without it, tags seen at 60
degrees had twice the error. The derivatives are cut earlier, and take the blur along where the print is stretched:
they are up to 11 % off in the place and 23 % in the blur then, which costs a step and moves no corner.

    grey = o + o_x x + o_y y + v(x, y) + (g + g_x x + g_y y) R(T),     R(T) = T + q T (1 - T)

with the light o, g and its slopes over the tag, a veil v of what is bent (mostly none, see `veil`), and q for the
camera's response: blur happens in light, a camera records its square root or so, and a blurred edge then lies a third
of a pixel away from where its middle grey is.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.detection.straightening import TERMS

PIXEL_VARIANCE = 1.0 / 12.0
# Places of the parameters in one vector: light (offset, gain, the offset's slopes, the gain's slopes; grey values),
# the homography, the blur (mean variance, and what it has more along x than along y and along one diagonal; px²), the
# response q, and what the ground beyond the print's left, right, upper and lower end is brighter than white.
OFFSET, GAIN, PLACE, BLUR, RESPONSE, GROUND, PARAMETERS = 0, 1, 6, 14, 17, 18, 22
VEIL_TERMS = 12
"""Powers of x and y of the second to fourth order; they stand after the parameters."""

REACH = 3.3
"""Sigmas beyond which an edge is not felt: 0.0005 of the contrast."""
NEAR = 2.6
"""Sigmas from an edge beyond which a pixel tells next to nothing of it; after JPEG, what lies between 2.1
and this still makes corners up to 5 % better."""
FLAT, ON_EDGE, AT_END = 0, 1, 2
NEARLY_WHITE = 243.0
"""What JPEG leaves of white that a camera could not record."""
MAX_LINES = 24
"""Grid lines within reach of a pixel, each way; more means that the print is a grey blob."""

_STEP = 1.0 / 256.0
_X = np.arange(-REACH - 0.5, REACH + 0.5, _STEP)
_CDF = np.array([0.5 * (1.0 + math.erf(x / math.sqrt(2.0))) for x in _X])
_PDF = np.exp(-0.5 * _X * _X) / math.sqrt(2.0 * math.pi)
_FIRST = float(_X[0])


@numba.njit(cache=True, inline="always", fastmath=True, error_model="numpy")
def _weights(s, sigma, n, w, d, dd, ddd):
    """Share of each cell in a pixel at s of one axis, and its three derivatives by s; first cell and their number."""
    first = max(1, math.ceil(s - REACH * sigma))
    last = min(n - 1, math.floor(s + REACH * sigma))
    lines = last - first + 1
    if lines <= 0:
        w[0] = 1.0
        d[0] = dd[0] = ddd[0] = 0.0
        return min(max(math.floor(s), 0), n - 1), 1
    if lines > MAX_LINES:
        return 0, 0
    i1 = 1.0 / sigma
    before, before_d, before_dd, before_ddd = 1.0, 0.0, 0.0, 0.0
    for k in range(lines):
        a = (s - (first + k)) * i1
        f = (a - _FIRST) * 256.0
        j = int(f)
        f -= j
        cdf = _CDF[j] + f * (_CDF[j + 1] - _CDF[j])
        pdf = (_PDF[j] + f * (_PDF[j + 1] - _PDF[j])) * i1
        w[k] = before - cdf
        d[k] = before_d - pdf
        second = -a * pdf * i1
        dd[k] = before_dd - second
        third = (a * a - 1.0) * pdf * i1 * i1
        ddd[k] = before_ddd - third
        before, before_d, before_dd, before_ddd = cdf, pdf, second, third
    w[lines], d[lines], dd[lines], ddd[lines] = before, before_d, before_dd, before_ddd
    return first - 1, lines + 1


@numba.njit(cache=True, inline="always", fastmath=True, error_model="numpy")
def _beyond(a):
    """Share of the blur beyond a line, a sigmas away."""
    if a <= -REACH:
        return 0.0
    f = (min(a, REACH) - _FIRST) * 256.0
    j = int(f)
    return _CDF[j] + (f - j) * (_CDF[j + 1] - _CDF[j])


@numba.njit(cache=True, inline="always", error_model="numpy")
def veil_terms(x, y, terms):
    """Powers of a place in the window, filled in."""
    xx, xy, yy = x * x, x * y, y * y
    terms[0], terms[1], terms[2] = xx, xy, yy
    terms[3], terms[4], terms[5], terms[6] = xx * x, xx * y, yy * x, yy * y
    terms[7], terms[8], terms[9], terms[10], terms[11] = xx * xx, xx * xy, xx * yy, xy * yy, yy * yy


@numba.njit(cache=True, inline="always", error_model="numpy")
def veil(par, x, y, terms):
    """Grey values that the veil adds at a place in the window."""
    veil_terms(x, y, terms)
    total = 0.0
    for i in range(VEIL_TERMS):
        total += par[PARAMETERS + i] * terms[i]
    return total


@numba.njit(cache=True, inline="always", fastmath=True, error_model="numpy")
def _sees_an_edge(cells, n, s, t, reach_s, reach_t, column, row):
    """Whether the cells within reach of a place differ, or the print ends there."""
    left, right = math.floor(s - reach_s), math.floor(s + reach_s)
    top, bottom = math.floor(t - reach_t), math.floor(t + reach_t)
    if left < 0 or top < 0 or right >= n or bottom >= n:
        return True
    here = cells[row, column]
    for j in range(top, bottom + 1):
        for i in range(left, right + 1):
            if cells[j, i] != here:
                return True
    return False


@numba.njit(cache=True, inline="always", fastmath=True, error_model="numpy")
def _row_of_lens(lens, y, row_x, row_y):
    """The window's polynomial along one row of pixels: five coefficients for each coordinate."""
    v = (y - lens[TERMS, 1]) * lens[TERMS + 1, 1]
    k = 0
    for i in range(5):
        row_x[i] = row_y[i] = 0.0
        power = 1.0
        for _ in range(5 - i):
            row_x[i] += lens[k, 0] * power
            row_y[i] += lens[k, 1] * power
            power *= v
            k += 1


@numba.njit(cache=True, error_model="numpy")
def _furthest_reach(G, n, vxx, vyy, vxy):
    """Cells beyond which no pixel of the print feels an edge, each way: the most is at one of its corners."""
    H = np.linalg.inv(G)
    reach_s = reach_t = 0.0
    for k in range(4):
        s, t = n * float(k % 2), n * float(k // 2)
        z = H[2, 0] * s + H[2, 1] * t + H[2, 2]  # 1 over G's third row at its pixel
        sx, sy = (G[0, 0] - s * G[2, 0]) * z, (G[0, 1] - s * G[2, 1]) * z
        tx, ty = (G[1, 0] - t * G[2, 0]) * z, (G[1, 1] - t * G[2, 1]) * z
        reach_s = max(reach_s, sx * sx * vxx + 2.0 * sx * sy * vxy + sy * sy * vyy)
        reach_t = max(reach_t, tx * tx * vxx + 2.0 * tx * ty * vxy + ty * ty * vyy)
    return 1.01 * NEAR * math.sqrt(reach_s), 1.01 * NEAR * math.sqrt(reach_t)


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def linearise(
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
    flat_stride,
    quiet,
    J,
    r,
    who,
):
    """Residuals of the pixels of one tag and their derivatives.

    Parameters
    ----------
    grey : (H, W) uint8 array
        The picture.
    cells : (N, N) float64 array
        The print, 1 white; the first n rows and columns count.
    n : int
        Cells across the print.
    masked : (N, N) bool array
        Cells that are not to be used.
    any_masked : bool
        Whether there are such cells.
    lens : (TERMS + 2, 2) float64 array
        Polynomial of the distortion over the window, see `straightening`; used if `bent`.
    bent : bool
        Whether the lens is one that bends lines.
    G : (3, 3) float64 array
        Undistorted pixel -> print, cells.
    norm : (3,) float64 array
        Centre and half size of the window, px.
    par : (PARAMETERS + VEIL_TERMS,) float64 array
        By the places above; slopes per half size, the blur with the pixel's own, the homography's eight unused; after
        them the veil.
    window : (4,) int array
        x0, y0, x1, y1.
    stride, flat_stride : int
        One in so many pixels near an edge is used, and of those that see one cell only; the second is a multiple of
        the first.
    quiet : float64
        Width of the white rim that is part of the print, cells. Only as much of it is used as the border's edge needs.
    J : (m, PARAMETERS) float64 array
        Filled: derivative of the grey value by each parameter.
    r : (m,) float64 array
        Filled: observed minus modelled grey value.
    who : (m, 3) int32 array
        Filled: number of the cell; `ON_EDGE` for a pixel that feels one (1 % of the contrast per px), `AT_END` for one
        at the end of the camera's range, else `FLAT`; place in the picture, row by row.

    Returns
    -------
    int
        Pixels filled in.
    """
    w, d, dd, ddd = np.empty(26), np.empty(26), np.empty(26), np.empty(26)
    e, f, ff, fff = np.empty(26), np.empty(26), np.empty(26), np.empty(26)
    count = 0
    vxx, vyy, vxy = par[BLUR] + par[BLUR + 1], par[BLUR] - par[BLUR + 1], par[BLUR + 2]
    row_x, row_y = np.empty(5), np.empty(5)
    q = par[RESPONSE]
    ground, terms = np.zeros(4), np.empty(VEIL_TERMS)
    veiled = np.any(par[PARAMETERS:] != 0.0)
    room = len(r)
    scale = norm[2]
    reach_s, reach_t = _furthest_reach(G, n, vxx, vyy, vxy)
    for y in range(window[1], window[3]):
        if bent:
            _row_of_lens(lens, y, row_x, row_y)
        # Pixels come in pairs, so that neighbours can be compared however few are taken.
        pair = (window[0] >> 1) + (-((window[0] >> 1) + y)) % stride
        for k in range(2 * max((window[2] - 2 * pair + 2 * stride - 1) // (2 * stride), 0)):
            x = 2 * (pair + (k >> 1) * stride) + (k & 1)
            if x < window[0] or x >= window[2]:
                continue
            X, Y = float(x), float(y)
            if bent:
                u = (x - lens[TERMS, 0]) * lens[TERMS + 1, 0]
                X += row_x[0] + u * (row_x[1] + u * (row_x[2] + u * (row_x[3] + u * row_x[4])))
                Y += row_y[0] + u * (row_y[1] + u * (row_y[2] + u * (row_y[3] + u * row_y[4])))
            z = 1.0 / (G[2, 0] * X + G[2, 1] * Y + G[2, 2])
            s = (G[0, 0] * X + G[0, 1] * Y + G[0, 2]) * z
            t = (G[1, 0] * X + G[1, 1] * Y + G[1, 2]) * z
            if s <= 0.0 or t <= 0.0 or s >= n or t >= n:
                continue
            # Most pixels see one cell only: this tells it of them at a third of the price.
            from_s, from_t = s - math.floor(s), t - math.floor(t)
            if (
                min(from_s, 1.0 - from_s) > reach_s
                and min(from_t, 1.0 - from_t) > reach_t
                and ((x >> 1) + y) % flat_stride != 0
            ):
                continue
            sx, sy = (G[0, 0] - s * G[2, 0]) * z, (G[0, 1] - s * G[2, 1]) * z
            tx, ty = (G[1, 0] - t * G[2, 0]) * z, (G[1, 1] - t * G[2, 1]) * z
            sigma_s = math.sqrt(max(sx * sx * vxx + 2.0 * sx * sy * vxy + sy * sy * vyy, 1e-12))
            sigma_t = math.sqrt(max(tx * tx * vxx + 2.0 * tx * ty * vxy + ty * ty * vyy, 1e-12))
            end = max(min(0.7 * sigma_s, 0.6), quiet - max(3.0 * sigma_s, 0.35))
            if s < end or s > n - end:
                continue
            end = max(min(0.7 * sigma_t, 0.6), quiet - max(3.0 * sigma_t, 0.35))
            if t < end or t > n - end:
                continue
            column, row = int(s), int(t)
            near = _sees_an_edge(cells, n, s, t, NEAR * sigma_s, NEAR * sigma_t, column, row)
            if not near and ((x >> 1) + y) % flat_stride != 0:
                continue
            if any_masked:
                a, b = min(2.0 * sigma_s, 1.0), min(2.0 * sigma_t, 1.0)
                left, right = max(int(s - a), 0), min(int(s + a), n - 1)
                top, bottom = max(int(t - b), 0), min(int(t + b), n - 1)
                if (
                    masked[row, column]
                    or masked[top, left]
                    or masked[top, right]
                    or masked[bottom, left]
                    or masked[bottom, right]
                ):
                    continue
            if count >= room:
                return count
            i0, columns = _weights(s, sigma_s, n, w, d, dd, ddd)
            j0, rows = _weights(t, sigma_t, n, e, f, ff, fff)
            T = Ts = Tt = Tss = Tst = Ttt = Tsst = Tstt = Tsstt = Tsssttt = 0.0
            c = sx * tx * vxx + (sx * ty + sy * tx) * vxy + sy * ty * vyy
            for j in range(rows):
                r0 = r1 = r2 = r3 = 0.0
                for i in range(columns):
                    cell = cells[j0 + j, i0 + i]
                    r0 += cell * w[i]
                    r1 += cell * d[i]
                    r2 += cell * dd[i]
                    r3 += cell * ddd[i]
                T += e[j] * r0
                Ts += e[j] * r1
                Tt += f[j] * r0
                Tss += e[j] * r2
                Tst += f[j] * r1
                Ttt += ff[j] * r0
                Tsst += f[j] * r2
                Tstt += ff[j] * r1
                Tsstt += ff[j] * r2
                Tsssttt += fff[j] * r3
            T += c * (Tst + c * (0.5 * Tsstt + c / 6.0 * Tsssttt))
            Ts += c * Tsst
            Tt += c * Tstt
            Tst += c * Tsstt

            xm, ym = (X - norm[0]) / scale, (Y - norm[1]) / scale
            bright = T + q * T * (1.0 - T)
            gain = par[GAIN] + par[4] * xm + par[5] * ym
            model = par[OFFSET] + par[2] * xm + par[3] * ym + gain * bright
            if veiled:
                model += veil(par, xm, ym, terms)
            # Beyond the print the ground shines in through the blur.
            ground[0] = _beyond(-s / sigma_s)
            ground[1] = _beyond((s - n) / sigma_s)
            ground[2] = _beyond(-t / sigma_t)
            ground[3] = _beyond((t - n) / sigma_t)
            for k in range(4):
                model += par[GROUND + k] * ground[k]
            seen = float(grey[y, x])
            steep = (Ts * sx + Tt * tx) ** 2 + (Ts * sy + Tt * ty) ** 2 > 1e-4
            mark = ON_EDGE if steep else FLAT
            row_J = J[count]
            if (model > 254.5 and seen > NEARLY_WHITE) or (seen < 0.5 and model < 0.5):
                # At the end of its range a camera tells no more than that; JPEG leaves a little less than white.
                for k in range(PARAMETERS):
                    row_J[k] = 0.0
                r[count] = 0.0
                who[count, 2] = -2
                who[count, 0], who[count, 1] = row * n + column, AT_END
                count += 1
                continue
            row_J[0], row_J[1], row_J[2], row_J[3] = 1.0, bright, xm, ym
            row_J[4], row_J[5] = xm * bright, ym * bright
            for k in range(4):
                row_J[GROUND + k] = ground[k]
            if not near:
                for k in range(PLACE, GROUND):
                    row_J[k] = 0.0
            else:
                slope = gain * (1.0 + q * (1.0 - 2.0 * T))
                # The print moves, the pixel stays: minus the gradient.
                gx, gy = -slope * (Ts * sx + Tt * tx) * scale, -slope * (Ts * sy + Tt * ty) * scale
                g = xm * gx + ym * gy
                row_J[6], row_J[7], row_J[8] = gx * xm, gx * ym, gx
                row_J[9], row_J[10], row_J[11] = gy * xm, gy * ym, gy
                row_J[12], row_J[13] = -xm * g, -ym * g
                # Blur spreads as heat does: the derivative by a variance is half the second derivative.
                Txx = sx * sx * Tss + 2.0 * sx * tx * Tst + tx * tx * Ttt
                Tyy = sy * sy * Tss + 2.0 * sy * ty * Tst + ty * ty * Ttt
                Txy = sx * sy * Tss + (sx * ty + sy * tx) * Tst + tx * ty * Ttt
                row_J[BLUR] = 0.5 * slope * (Txx + Tyy)
                row_J[BLUR + 1] = 0.5 * slope * (Txx - Tyy)
                row_J[BLUR + 2] = slope * Txy
                row_J[RESPONSE] = gain * T * (1.0 - T)
            r[count] = seen - min(model, 255.0)
            who[count, 2] = y * grey.shape[1] + x
            who[count, 0], who[count, 1] = row * n + column, mark
            count += 1
    return count


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def brightness(cells, n, G, X, Y, par, scratch):
    """Blurred print at an undistorted pixel, 0 black to 1 white; parameters as of `linearise`, `scratch` (5, 26)."""
    z = 1.0 / (G[2, 0] * X + G[2, 1] * Y + G[2, 2])
    s = (G[0, 0] * X + G[0, 1] * Y + G[0, 2]) * z
    t = (G[1, 0] * X + G[1, 1] * Y + G[1, 2]) * z
    sx, sy = (G[0, 0] - s * G[2, 0]) * z, (G[0, 1] - s * G[2, 1]) * z
    tx, ty = (G[1, 0] - t * G[2, 0]) * z, (G[1, 1] - t * G[2, 1]) * z
    vxx, vyy, vxy = par[BLUR] + par[BLUR + 1], par[BLUR] - par[BLUR + 1], par[BLUR + 2]
    w, e, d, dd, ddd = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    sigma_s = math.sqrt(max(sx * sx * vxx + 2.0 * sx * sy * vxy + sy * sy * vyy, 1e-12))
    sigma_t = math.sqrt(max(tx * tx * vxx + 2.0 * tx * ty * vxy + ty * ty * vyy, 1e-12))
    i0, columns = _weights(s, sigma_s, n, w, d, dd, ddd)
    j0, rows = _weights(t, sigma_t, n, e, d, dd, ddd)
    T = 0.0
    for j in range(rows):
        for i in range(columns):
            T += cells[j0 + j, i0 + i] * w[i] * e[j]
    return T + par[RESPONSE] * T * (1.0 - T)
