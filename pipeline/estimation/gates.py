"""What is no measurement: gross corners, and pictures that show a marker in its flip.

A flipped picture (the other of the two poses that a planar marker can have) of a marker that nearly faces its camera is
off by a few sigmas in every corner, and by many in none. Against a body's motion it holds its own: Huber's loss settles
half-way between the flip and the truth, 6.8 deg off both where they are 13.6 deg apart. So pictures are also judged as
wholes: one that no chance explains is set aside, and taken back unless everything else still has the marker where the
other of its own two poses is. A machine that jerks contradicts its pictures too, but not by a flip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from pipeline.estimation.normal import corner_lengths
from pipeline.estimation.parts import Part
from pipeline.estimation.problem import Problem, Weights, huber, lengths
from pipeline.estimation.residuals import Corners, sensor_residuals
from pipeline.estimation.values import Values
from pipeline.geometry import camera as camera_model
from pipeline.geometry import so3
from pipeline.network import frames as fr
from pipeline.network import planar

GROSS = 3.0
"""After Huber has converged, what is further off than this many times its threshold is no measurement: its weight
becomes zero, and the rest is adjusted again. Gated from the start, a bad start would throw away good corners."""
DOUBT = 1e-3
"""Chance of a picture's sum of squares below which it is set aside for one round. Of two flipped pictures in a row,
each of which holds the other, the smaller had 3e-4."""
WINDOW, SHARE = 41, 0.25
"""Of so many pictures of one marker in one camera around a doubtful one, at most this share is set aside: what is off
for longer is a mount, a survey or a density, and no picture."""

NEAR = 0.5
"""How far the other pose may be from the expected one, of how far the shown one is. With 1, three of 800 pictures of a
machine that moved thirty times as abruptly as its densities say were taken for flips."""


@dataclass(frozen=True, eq=False)
class Misfit:
    """How well each sighting of a group (n,) fits."""

    square: np.ndarray
    """Sum of Huber-weighted squares of the corners that are not gross."""
    count: np.ndarray
    """How many components they have."""


def gross(parts: list[Part], problem: Problem, weights: Weights) -> tuple[Weights, list[Misfit]]:
    """Weights that leave out what is a gross outlier at the parts' values, and how the rest fits."""
    limit = GROSS * weights.huber
    corners: list[list[np.ndarray]] = [[] for _ in problem.corners]
    squares: list[list[np.ndarray]] = [[] for _ in problem.corners]
    sensors: list[list[np.ndarray]] = [[] for _ in problem.sensors]
    for part in parts:
        for rows, sums, group in zip(corners, squares, part.problem.corners, strict=True):
            length = corner_lengths(part.problem, part.values, group)
            alive = length <= limit
            weight, _ = huber(length, weights.huber, alive)
            rows.append(alive)
            sums.append(np.sum(weight * np.where(alive, length, 0.0) ** 2, axis=1))
        for rows, readings in zip(sensors, part.problem.sensors, strict=True):
            r, _ = sensor_residuals(readings, part.values, problem.statics, jacobians=False)
            with np.errstate(invalid="ignore"):
                rows.append(lengths(r, 1) <= limit)
    alive_corners = tuple(map(np.concatenate, corners))
    fits = [
        Misfit(np.concatenate(s), 2 * alive.sum(axis=1))
        for s, alive in zip(squares, alive_corners, strict=True)
    ]
    gated = replace(weights, corners=alive_corners, sensors=tuple(map(np.concatenate, sensors)))
    return gated, fits


def doubtful(problem: Problem, fits: list[Misfit]) -> list[np.ndarray]:
    """Sightings whose picture of a marker no chance explains: per group (n,) bool.

    The chance is that of chi-square, scaled by the log's own median: a sigma that is stated too small is no flip.
    """
    out = [np.zeros(len(g.epoch), dtype=bool) for g in problem.corners]
    for pair in sorted({(g.camera, g.marker) for g in problem.corners}):
        groups = [k for k, g in enumerate(problem.corners) if (g.camera, g.marker) == pair]
        at, picture = np.unique(
            np.concatenate([problem.corners[k].epoch for k in groups]), return_inverse=True
        )
        square = np.bincount(picture, np.concatenate([fits[k].square for k in groups]))
        count = np.bincount(picture, np.concatenate([fits[k].count for k in groups])).astype(int)
        used = np.flatnonzero(count)
        if len(used) == 0:
            continue
        sizes = np.arange(1, count.max() + 1)
        middle = np.r_[1.0, scipy.stats.chi2.median(sizes)][count]
        limit = np.r_[np.inf, scipy.stats.chi2.isf(DOUBT, sizes)][count]
        bad = square > limit * max(1.0, float(np.median((square / middle)[used])))
        n = min(WINDOW, len(at))
        near = np.clip(np.arange(len(at)) - n // 2, 0, len(at) - n)
        before = np.r_[0, np.cumsum(bad)]
        bad &= before[near + n] - before[near] <= SHARE * n
        ends = np.cumsum([0, *(len(problem.corners[k].epoch) for k in groups)])
        for k, a, b in zip(groups, ends, ends[1:], strict=False):
            out[k] = bad[picture[a:b]]
    return out


def flipped(problem: Problem, values: Values, aside: list[np.ndarray]) -> list[np.ndarray]:
    """Those of the sightings set aside whose picture shows the marker in its flip: per group (n,) bool.

    Of both planar poses of the picture alone the one that fits it better is much further, in rotation, from where
    everything else has the marker than the other one.

    Parameters
    ----------
    problem, values : Problem, Values
        Adjusted without what is set aside.
    aside : list of (n,) bool arrays
        Of ``doubtful``.
    """
    out = [np.zeros(len(g.epoch), dtype=bool) for g in problem.corners]
    for pair in sorted({(g.camera, g.marker) for g in problem.corners}):
        groups = [
            (bad, out[k], g)
            for k, (g, rows) in enumerate(zip(problem.corners, aside, strict=True))
            if (g.camera, g.marker) == pair and len(bad := np.flatnonzero(rows))
        ]
        if not groups:
            continue
        epoch = np.concatenate([g.epoch[bad] for bad, _, g in groups])
        p = np.concatenate([g.p_marker[bad] for bad, _, g in groups])
        uv = np.concatenate([g.uv[bad] for bad, _, g in groups])
        intrinsics = problem.statics.value(groups[0][2].intrinsics, values.z)
        R = np.concatenate([_expected(problem, values, g, bad) for bad, _, g in groups])
        at, picture = np.unique(epoch, return_inverse=True)
        flip = np.zeros(len(at), dtype=bool)
        for i in range(len(at)):
            tags = picture == i
            shown, other = _both(p[tags].reshape(-1, 3), uv[tags].reshape(-1, 2), intrinsics)
            away, near = (so3.log(R[tags][0].T @ pose) for pose in (shown, other))
            # Of nan, where the corners fix no pose, this is False.
            flip[i] = np.linalg.norm(near) < NEAR * np.linalg.norm(away)
        ends = np.cumsum([len(bad) for bad, _, _ in groups])[:-1]
        for (bad, of_group, _), yes in zip(groups, np.split(flip[picture], ends), strict=True):
            of_group[bad] = yes
    return out


def _both(p_marker, uv, intrinsics):
    """Rotations of both planar poses of one picture of a marker, the one that fits it better first."""
    xy = camera_model.undistort(uv, intrinsics)
    found = np.isfinite(xy).all(axis=-1)
    p, xy = p_marker[found], xy[found]
    if len(p) < 4:
        return np.full((2, 3, 3), np.nan)
    T = planar.both_poses(p[None, :, :2], xy[None], np.ones((1, len(p))))[0]
    q = p @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3]
    off = np.sum((q[..., :2] / q[..., 2:] - xy) ** 2, axis=(-1, -2))
    return T[np.argsort(off), :3, :3]


def _expected(problem: Problem, values: Values, group: Corners, rows):
    """Rotations of a marker in a camera at some rows of a group, (k, 3, 3)."""
    epoch = group.epoch[rows]
    _, T = fr.along(group.path, lambda edge: values.edge_pose(problem.statics, edge, epoch))
    return np.broadcast_to(T, (len(epoch), 4, 4))[:, :3, :3]


def without(weights: Weights, aside: list[np.ndarray]) -> Weights:
    """The same weights, with some sightings left out."""
    corners = tuple(alive & ~bad[:, None] for alive, bad in zip(weights.corners, aside, strict=True))
    return replace(weights, corners=corners)
