"""Where a moving edge and the segments of a line are nearest to each other; compiled.

The edge is the polyline left, middle, right, a line is a chain of straight segments with a radius each. A step from
one epoch to the next is a cubic in Bezier form, for each of the three points. No place on the edge moves faster than
the fastest of their control points, so its distance from anything changes no faster: that is what bounds the search.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.surface.distance_bound import lower_bound

ERROR_M = 0.001
"""No place is missed that is nearer than the one found by more than this."""
COLUMNS = 11
"""Of `measured`."""
_UP = (0.0, 0.0, 1.0)
"""Taken for the line of approach where the edge is on the axis."""
_DEEP = 64
"""Pieces of a step that may wait: each halving leaves one, and thirty of them cut a kilometre into micrometres."""
MIDDLE, HALF, RADIUS = 6, 9, 10
"""Columns of a line's segments (m, 11): start, end, middle, half the length, radius."""


@njit(cache=True, nogil=True)
def steps(time_ns, p, seen, cov, max_step_ns, bend_ns):  # pragma: no cover - compiled
    """Per epoch: is the step after it swept, the longest way that a place of the edge goes in it, largest sigma."""
    n = len(time_ns)
    swept, travel, spread = np.zeros(n, np.bool_), np.zeros(n), np.zeros(n)
    for k in range(n - 1):
        step = time_ns[k + 1] - time_ns[k]
        swept[k] = seen[k] and seen[k + 1] and 0 < step <= max_step_ns
    for k in range(n):
        for i in range(3):
            spread[k] = max(spread[k], np.sqrt(cov[k, i, 0] + cov[k, i, 3] + cov[k, i, 5]))
    control = np.empty((4, 3, 3))
    for k in range(n - 1):
        control_points(k, time_ns, p, swept, bend_ns, control)
        travel[k] = way_of(control)
    return swept, travel, spread


@njit(cache=True, nogil=True)
def control_points(k, time_ns, p, swept, bend_ns, control):  # pragma: no cover - compiled
    """Bezier control points (4, 3, 3) of the step from epoch k: the cubic of `sweep`, where the step is long."""
    step = float(time_ns[k + 1] - time_ns[k])
    bent = swept[k] and step > bend_ns
    for i in range(3):
        for a in range(3):
            here, there = p[k, i, a], p[k + 1, i, a]
            way = there - here
            first, last = way, way
            if bent and k > 0 and swept[k - 1]:
                wait = float(time_ns[k] - time_ns[k - 1])
                first = (wait * way + step * (here - p[k - 1, i, a]) * (step / wait)) / (wait + step)
            if bent and swept[k + 1]:
                ahead = float(time_ns[k + 2] - time_ns[k + 1])
                last = (ahead * way + step * (p[k + 2, i, a] - there) * (step / ahead)) / (step + ahead)
            control[0, i, a] = here
            control[1, i, a] = here + first / 3.0
            control[2, i, a] = there - last / 3.0
            control[3, i, a] = there


@njit(cache=True, nogil=True)
def on_the_way(control, u, edge):  # pragma: no cover - compiled
    """The edge (3, 3) at the part u of a step."""
    v = 1.0 - u
    for i in range(3):
        for a in range(3):
            edge[i, a] = (
                v * v * v * control[0, i, a]
                + 3.0 * u * v * (v * control[1, i, a] + u * control[2, i, a])
                + u * u * u * control[3, i, a]
            )


@njit(cache=True, nogil=True)
def way_of(control):  # pragma: no cover - compiled
    """The longest way that a place of the edge can go in a step with these control points."""
    longest = 0.0
    for j in range(3):
        for i in range(3):
            square = 0.0
            for a in range(3):
                square += (control[j + 1, i, a] - control[j, i, a]) ** 2
            longest = max(longest, square)
    return 3.0 * np.sqrt(longest)


@njit(cache=True, nogil=True)
def between(p, q, a, b):  # pragma: no cover - compiled
    """Distance of two segments, and how far along each its nearest place lies (0 to 1)."""
    uu = uv = vv = ur = vr = 0.0
    for i in range(3):
        u, v, r = q[i] - p[i], b[i] - a[i], p[i] - a[i]
        uu += u * u
        uv += u * v
        vv += v * v
        ur += u * r
        vr += v * r
    s = t = 0.0
    tiny = 1e-18
    if uu <= tiny:
        t = min(max(vr / vv, 0.0), 1.0) if vv > tiny else 0.0
    elif vv <= tiny:
        s = min(max(-ur / uu, 0.0), 1.0)
    else:
        across = uu * vv - uv * uv
        if across > 1e-12 * uu * vv:
            s = min(max((uv * vr - ur * vv) / across, 0.0), 1.0)
        t = (uv * s + vr) / vv
        if t < 0.0:
            t = 0.0
            s = min(max(-ur / uu, 0.0), 1.0)
        elif t > 1.0:
            t = 1.0
            s = min(max((uv - ur) / uu, 0.0), 1.0)
    square = 0.0
    for i in range(3):
        away = p[i] + s * (q[i] - p[i]) - a[i] - t * (b[i] - a[i])
        square += away * away
    return np.sqrt(square), s, t


@njit(cache=True, nogil=True)
def nearest(edge, segments, at):  # pragma: no cover - compiled
    """Distance of an edge (3, 3) from the surface of a line; `at` gets segment, half of the edge, and both places."""
    best = np.inf
    reach = 0.0
    for i in range(0, 3, 2):
        square = 0.0
        for a in range(3):
            square += (edge[i, a] - edge[1, a]) ** 2
        reach = max(reach, np.sqrt(square))
    # The nearest of the last time goes first: it rules out most of the others by their distance from the middle.
    hint = int(at[0])
    for number in range(-1, len(segments)):
        j = number if number >= 0 else hint
        square = 0.0
        for a in range(3):
            square += (edge[1, a] - segments[j, MIDDLE + a]) ** 2
        limit = best + reach + segments[j, HALF] + segments[j, RADIUS]
        if square >= limit * limit:
            continue
        for i in range(2):
            distance, s, t = between(edge[i], edge[i + 1], segments[j, :3], segments[j, 3:6])
            if distance - segments[j, RADIUS] < best:
                best = distance - segments[j, RADIUS]
                at[0], at[1], at[2], at[3] = j, i, s, t
    return best


@njit(cache=True, nogil=True)
def dip(control, before, after, enough, segments, at):  # pragma: no cover - compiled
    """The smallest distance within a step and where it is (0 to 1), `ERROR_M` at most above the true one.

    `before` and `after` are the distances at its ends. Nothing that is not below `enough` is looked for. A piece of the
    step is done with when its way is too short to get nearer, or when it stays behind a plane that the line is all
    before: that of its middle, which does for an edge that is dragged along a pipe.
    """
    best, place = (before, 0.0) if before <= after else (after, 1.0)
    edge, n = np.empty((3, 3)), np.empty(3)
    piece, ends = np.empty((_DEEP, 4, 3, 3)), np.empty((_DEEP, 4))
    piece[0] = control
    ends[0, 0], ends[0, 1], ends[0, 2], ends[0, 3] = 0.0, 1.0, before, after
    count = 1
    while count > 0:
        count -= 1
        a, b, at_a, at_b = ends[count, 0], ends[count, 1], ends[count, 2], ends[count, 3]
        way = way_of(piece[count])
        if 0.5 * (at_a + at_b - way) >= min(best, enough) - ERROR_M or count + 2 > _DEEP:
            continue
        u = 0.5 * (a + b)
        on_the_way(piece[count], 0.5, edge)
        at_u = nearest(edge, segments, at)
        if at_u < best:
            best, place = at_u, u
        if _behind(piece[count], way, edge, at, segments, min(best, enough) - ERROR_M, n):
            continue
        # The nearer half comes last onto the pile: it is looked at first and may spare the other.
        later_first = at_a <= at_b
        for i in range(3):
            for c in range(3):
                p0, p1, p2, p3 = (
                    piece[count, 0, i, c],
                    piece[count, 1, i, c],
                    piece[count, 2, i, c],
                    piece[count, 3, i, c],
                )
                q0, q1, q2 = 0.5 * (p0 + p1), 0.5 * (p1 + p2), 0.5 * (p2 + p3)
                r0, r1 = 0.5 * (q0 + q1), 0.5 * (q1 + q2)
                first, last = (count + 1, count) if later_first else (count, count + 1)
                piece[first, 0, i, c], piece[first, 1, i, c], piece[first, 2, i, c] = p0, q0, r0
                piece[last, 1, i, c], piece[last, 2, i, c], piece[last, 3, i, c] = r1, q2, p3
                piece[first, 3, i, c] = piece[last, 0, i, c] = 0.5 * (r0 + r1)
        first, last = (count + 1, count) if later_first else (count, count + 1)
        ends[first, 0], ends[first, 1], ends[first, 2], ends[first, 3] = a, u, at_a, at_u
        ends[last, 0], ends[last, 1], ends[last, 2], ends[last, 3] = u, b, at_u, at_b
        count += 2
    return best, place


@njit(cache=True, nogil=True)
def _behind(control, way, edge, at, segments, limit, n):  # pragma: no cover - compiled
    """Whether a piece with this middle `edge`, of which `nearest` told `at`, stays beyond `limit` from the line."""
    j, i = int(at[0]), int(at[1])
    size = 0.0
    for c in range(3):
        n[c] = edge[i, c] + at[2] * (edge[i + 1, c] - edge[i, c])
        n[c] -= segments[j, c] + at[3] * (segments[j, 3 + c] - segments[j, c])
        size += n[c] * n[c]
    if size < 1e-18:
        return False
    size = np.sqrt(size)
    for c in range(3):
        n[c] /= size
    floor, reach = np.inf, 0.0
    for point in range(3):
        square = 0.0
        for c in range(3):
            square += (edge[point, c] - edge[1, c]) ** 2
        reach = max(reach, np.sqrt(square))
        for k in range(4):
            height = 0.0
            for c in range(3):
                height += n[c] * (control[k, point, c] - edge[1, c])
            floor = min(floor, height)
    for other in range(len(segments)):
        square = start = end = 0.0
        for c in range(3):
            square += (edge[1, c] - segments[other, MIDDLE + c]) ** 2
            start += n[c] * (segments[other, c] - edge[1, c])
            end += n[c] * (segments[other, 3 + c] - edge[1, c])
        if floor - max(start, end) - segments[other, RADIUS] >= limit:
            continue
        if np.sqrt(square) - segments[other, HALF] - segments[other, RADIUS] - reach - 0.5 * way < limit:
            return False
    return True


@njit(cache=True, nogil=True)
def _product(c, x, y):  # pragma: no cover - compiled
    """``x' C y`` of an upper triangle (6,)."""
    return (
        x[0] * (c[0] * y[0] + c[1] * y[1] + c[2] * y[2])
        + x[1] * (c[1] * y[0] + c[3] * y[1] + c[4] * y[2])
        + x[2] * (c[2] * y[0] + c[4] * y[1] + c[5] * y[2])
    )


@njit(cache=True, nogil=True)
def measured(
    edge, distance, at, k, u, cov, common, segments, variance, table, row
):  # pragma: no cover - compiled
    """What `nearest` found of an edge at the part u of the step from epoch k, with its sigmas, into `row` (`COLUMNS`).

    Nearest place of the edge and of the axis, distance, sigmas own, common and of the line, bound. Places between the
    three points of the edge, and between two epochs, take the sigmas of both in proportion: were their errors not the
    same, the true sigma would be smaller.
    """
    j, i = int(at[0]), int(at[1])
    n, e, f = row[:3], row[3:6], row[6:9]  # until the end: along, and two directions across
    length = distance + segments[j, RADIUS]
    for a in range(3):
        n[a] = edge[i, a] + at[2] * (edge[i + 1, a] - edge[i, a])
        n[a] -= segments[j, a] + at[3] * (segments[j, 3 + a] - segments[j, a])
        n[a] = n[a] / length if length > 1e-9 else _UP[a]
    e[0], e[1], e[2] = (-n[1], n[0], 0.0) if abs(n[2]) < 0.9 else (0.0, -n[2], n[1])
    size = np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    for a in range(3):
        e[a] /= size
    for a in range(3):
        f[a] = n[(a + 1) % 3] * e[(a + 2) % 3] - n[(a + 2) % 3] * e[(a + 1) % 3]
    own = shared = ee = ff = ef = 0.0
    for corner in range(4):
        epoch, point = k + corner // 2, i + corner % 2
        weight = (u if corner // 2 else 1.0 - u) * (at[2] if corner % 2 else 1.0 - at[2])
        if weight > 0.0:
            c = cov[epoch, point]
            whole, part = _product(c, n, n), _product(common[epoch, point], n, n)
            own += weight * np.sqrt(max(whole - part, 0.0))
            shared += weight * np.sqrt(max(part, 0.0))
            ee += weight * _product(c, e, e)
            ff += weight * _product(c, f, f)
            ef += weight * _product(c, e, f)
    ee += _product(variance, e, e)
    ff += _product(variance, f, f)
    ef += _product(variance, e, f)
    of_line = _product(variance, n, n)
    sideways = 0.5 * (ee + ff) + np.sqrt(0.25 * (ee - ff) ** 2 + ef * ef)
    sigma = np.sqrt(own * own + shared * shared + of_line)
    bound = lower_bound(length, sigma, np.sqrt(sideways), table) - segments[j, RADIUS]
    for a in range(3):
        row[a] = edge[i, a] + at[2] * (edge[i + 1, a] - edge[i, a])
        row[3 + a] = segments[j, a] + at[3] * (segments[j, 3 + a] - segments[j, a])
    row[6], row[7], row[8], row[9], row[10] = distance, own, shared, np.sqrt(of_line), bound
