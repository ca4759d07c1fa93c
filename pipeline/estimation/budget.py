"""Where the uncertainty of the cutting edge's elevation comes from, by what the machine did, and how long it lasts.

The vertical sigma of one median epoch hides what decides: while the machine swings the own part is twice that of
a machine at rest, and in a gap the motion prior is all there is. So epochs are sorted by how the edge moves, and each
class has a budget of its own; the correlation time says over how long the own part does not average out.
"""

from __future__ import annotations

import numpy as np

from pipeline.estimation.marginals import BodyTrack, Marginals, vertical_budget
from pipeline.estimation.problem import Problem
from pipeline.estimation.repeated import SOURCE as CORNERS
from pipeline.estimation.values import Values
from pipeline.network import frames as fr
from pipeline.network.model import SOURCES

CLASSES = ("digging", "swinging", "parked", "tramming", "bridged")
REST_M_S = 0.02
"""Slower than this the edge is parked: less than the vertical sigma in half a second."""
SWING_RAD_S = 0.1
"""Turning about the vertical faster than this is swinging; digging stays in the plane of the boom."""
TRAM_M_S = 0.15
"""Speed of the carrier, where it does not swing."""
STARTS = 200
"""Epochs whose correlation with later ones is followed."""
HORIZON = 400
"""Epochs it is followed for; an own part that lasts longer is said to last at least that long."""


def epoch_classes(problem: Problem, values: Values, track: BodyTrack, seen):
    """What the machine was doing at each epoch: (E,) int array, index into ``CLASSES``.

    ``track`` is that of the tool; ``seen`` (E,) bool, where every link to the datum was observed.
    """
    R = track.T_world_body[:, :3, :3]
    speed = np.linalg.norm(track.velocity[:, :3], axis=1)
    yaw = np.abs(np.einsum("nj,nj->n", R[:, 2], track.velocity[:, 3:]))
    out = np.zeros(len(R), dtype=np.int64)
    roots = [
        k
        for k in track.variables
        if problem.tie.variables[k].kind == "moving"
        and problem.tie.frames.edges[fr.body_frame(problem.tie.variables[k].body)].parent == fr.WORLD
    ]
    for k in roots:
        out[np.linalg.norm(values.rate[k][:, :3], axis=1) > TRAM_M_S] = 3
    out[yaw > SWING_RAD_S] = 1
    out[speed < REST_M_S] = 2
    out[~seen] = 4
    return out


def vertical_budgets(
    problem: Problem, found: Marginals, track: BodyTrack, rows, classes
) -> tuple[dict, dict]:
    """Median standard deviation of the elevation of the cutting edge's middle by source, m.

    ``rows`` (k,) are the published epochs, ``classes`` (E,) those of ``epoch_classes``.

    Returns
    -------
    whole : dict of str to float
        Over all observed epochs.
    by_class : dict of str to dict
        The same for each class that occurs, with ``epochs``, how many, and ``sigma``, that of all sources together.
    """
    sources = [*SOURCES, CORNERS] if any(s.source == CORNERS for s in problem.network.statics) else [*SOURCES]
    groups = {
        source: np.concatenate(
            [problem.statics.columns[k] for k, s in enumerate(problem.network.statics) if s.source == source]
            or [np.array([], dtype=np.int64)]
        )
        for source in sources
    }
    if len(rows) == 0:
        return {}, {}
    parts = vertical_budget(track, found.P_zz, groups, rows)
    here = classes[rows]

    def medians(use):
        return {name: round(float(np.sqrt(np.median(v[use]))), 6) for name, v in parts.items()}

    by_class = {}
    for c, name in enumerate(CLASSES):
        use = here == c
        if np.any(use):
            whole = np.sqrt(np.median(np.sum([v[use] for v in parts.values()], axis=0)))
            by_class[name] = {"epochs": int(use.sum()), "sigma": round(float(whole), 6)} | medians(use)
    observed = here != CLASSES.index("bridged")
    return (medians(observed) if np.any(observed) else {}), by_class


def correlation_time(problem: Problem, found: Marginals, track: BodyTrack, rows, classes) -> dict:
    """How long the own part of the cutting edge's elevation stays the same error, seconds.

    The own covariance of two epochs is ``Z_k,k+j = (-G_k) ... (-G_k+j-1) Z_k+j``. The time is that after which their
    correlation has fallen to 1/e, by interpolation; epochs nearer than that are not independent witnesses.

    Returns
    -------
    dict of str to float
        ``median`` over all published epochs, ``longest`` (95 % are shorter), and the median by class; empty where
        nothing moves.
    """
    if len(rows) < 3 or not track.J_x:
        return {}
    starts = np.unique(np.linspace(rows[0], rows[-1] - 1, min(STARTS, len(rows) - 1)).astype(int))
    found_s = np.array([_fall(problem, found, track, k, rows[-1]) for k in starts.tolist()])
    here = classes[starts]
    times = {"median": np.median(found_s), "longest": np.quantile(found_s, 0.95)}
    times |= {name: np.median(found_s[here == c]) for c, name in enumerate(CLASSES) if np.any(here == c)}
    return {name: round(float(value), 3) for name, value in times.items()}


def _fall(problem: Problem, found: Marginals, track: BodyTrack, k: int, last: int) -> float:
    t = problem.epochs.time_s
    up = track.T_world_body[:, 2, :3]
    carried = {c: up[k] @ J_x[k, :3] for c, J_x in track.J_x.items()}
    start = sum(float(a @ found.Z[c][k] @ a) for c, a in carried.items())
    at = 1.0
    for j in range(k + 1, min(last, k + HORIZON) + 1):
        covariance, variance = 0.0, 0.0
        for c, J_x in track.J_x.items():
            carried[c] = -carried[c] @ found.G[c][j - 1]
            m = up[j] @ J_x[j, :3]
            forward = found.Z[c][j] @ m
            covariance += float(carried[c] @ forward)
            variance += float(m @ forward)
        before, at = at, covariance / max(np.sqrt(start * variance), 1e-300)
        if at < np.exp(-1.0):
            share = (before - np.exp(-1.0)) / max(before - at, 1e-12)
            return float(t[j - 1] + share * (t[j] - t[j - 1]) - t[k])
    return float(t[min(last, k + HORIZON)] - t[k])
