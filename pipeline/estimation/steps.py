"""Scores and information of a step of a static at every instant: what the change test in time asks of a log.

For a static ``s`` and an instant ``tau`` the alternative is one more unknown ``delta``, a step of that static from
``tau`` on. Its score and its information, with all states and statics free, are those of one more column of the
border that is zero before ``tau`` (Rao's test). With ``B_k`` the border, ``C(tau)`` the statics' own information from
``tau`` on, and ``Z``, ``G``, ``Y``, ``S`` of the arrow, everything is a sum from the end of the log:

    R_k = Z_k B_k - G_k R_k+1                     Q(tau) = sum over k >= tau of  B_k' R_k + R_k' B_k - B_k' Z_k B_k
    N(tau) = C(tau) - sum of B_k' Y_k             I = C(tau) - Q(tau) - N(tau) S^-1 N(tau)'        (blocks of s)
    g(tau) = sum of J' w r + B_k' dx_k + C_k dz   delta = -I^-1 g          T = g' I^-1 g

so all statics and all instants together cost about as much as the marginals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.linalg
from numba import njit

from pipeline.estimation import sweeps
from pipeline.estimation.gauss_newton import HOLD
from pipeline.estimation.linearised import parts, pieces
from pipeline.estimation.parts import Part
from pipeline.estimation.problem import Problem, Weights, huber, lengths, unchecked_statics
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.estimation.values import Values
from pipeline.network import frames as fr


@dataclass(frozen=True, eq=False)
class Sums:
    """Scores and information of a step of every tested static (q unknowns in all) from each candidate instant on."""

    at: np.ndarray
    """(K,) rising epochs; the first is 0."""
    rows: dict[int, np.ndarray]
    """Per tested static: its places among the q."""
    g: np.ndarray
    """(K, q) efficient scores."""
    own: np.ndarray
    """(K, q, q) information of the steps once the states are eliminated; right in the blocks of one static."""
    cross: np.ndarray
    """(K, q, p) of the steps with the statics, once the states are eliminated."""
    P_zz: np.ndarray
    """(p, p)."""


def mounts_and_sensors(problem: Problem) -> set[int]:
    """Statics that may change: poses of benchmarks, mounts of cameras and markers, curves and offsets of sensors."""
    network, frames = problem.network, problem.tie.frames
    hosts = {fr.camera_frame(c.name) for c in network.cameras} | {
        fr.marker_frame(m.name) for m in network.markers
    }
    met = {
        edge.index
        for frame, edge in frames.edges.items()
        if edge.kind == "static" and frame.split(" after ")[0] in hosts
    }
    for readings in problem.sensors:
        met |= {readings.sensor.curve, readings.sensor.offset}
    return met


def testable(problem: Problem) -> list[int]:
    """Those of them that are not exact in the files, and that more than one thing in the log speaks of."""
    held = set(unchecked_statics(problem).tolist())
    columns = problem.statics.columns
    return [
        s
        for s in sorted(mounts_and_sensors(problem))
        if len(columns[s]) and not held & set(columns[s].tolist())
    ]


def sums(problem: Problem, values: Values, weights: Weights, at) -> Sums:
    """Scores and information for steps at the epochs ``at``; O(epochs), one part of the log in memory at a time."""
    p, K = problem.statics.size, len(at)
    cut, held = parts(problem, values, weights), unchecked_statics(problem)

    def hold(i: int, piece: sweeps.Piece) -> sweeps.Piece:
        C = piece.C.copy()
        C[held, held] += HOLD if i == 0 else 0.0
        return replace(piece, C=C)

    linearised = pieces(cut, finish=hold)
    reduced = sweeps.reduce(linearised, len(cut))
    P_zz = scipy.linalg.cho_solve(scipy.linalg.cho_factor(reduced.S), np.eye(p))
    tested = testable(problem)
    columns = [problem.statics.columns[s] for s in tested]
    owner = np.repeat(tested, [len(c) for c in columns])
    rows = {s: np.flatnonzero(owner == s) for s in tested}
    place = np.full(p, -1)
    place[np.concatenate([*columns, np.array([], dtype=np.int64)]).astype(np.int64)] = np.arange(len(owner))
    g, info, states = np.zeros((K, len(owner))), np.zeros((K, len(owner), p)), np.zeros((K, len(owner), p))
    own = np.zeros((K, len(owner), len(owner)))
    tails: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    steps = sweeps.steps(linearised, reduced)
    for (i, inverses), (_, moved) in zip(sweeps.inverses(linearised, reduced), steps, strict=True):
        part, n = cut[i], cut[i].epochs
        ends = np.clip([*at.tolist(), len(problem.epochs.time_ns)], part.start, part.stop) - part.start
        _measure(part, ends, place, g, info)
        for c, (chain, found, dx) in enumerate(zip(linearised(i).chains, inverses, moved, strict=True)):
            here = np.flatnonzero(place[chain.columns] >= 0)
            if len(here) == 0:
                continue
            to = place[chain.columns[here]]
            B = np.ascontiguousarray(chain.B[:n, :, here])
            if c not in tails:
                tails[c] = np.zeros((B.shape[1], len(here))), np.zeros((len(here), len(here)))
            Q = np.zeros((K, len(here), len(here)))
            _tails(found.Z, found.G, B, owner[to], at - part.start, *tails[c], Q)
            own[np.ix_(np.arange(K), to, to)] -= Q
            for j, (a, b) in enumerate(pairwise(ends.tolist())):
                if b > a:
                    B_j = B[a:b].reshape(-1, len(here))
                    told = B_j.T @ found.Y[a:b].reshape(len(B_j), -1)
                    states[np.ix_(np.array([j]), to, chain.columns)] += told[None]
                    g[j, to] += B_j.T @ dx[a:b].ravel()
    own += _from_the_end(info[:, :, place >= 0][:, :, np.argsort(place[place >= 0])])
    g += info @ reduced.dz
    return Sums(at, rows, _from_the_end(g), own, _from_the_end(info - states), P_zz)


def _from_the_end(parts):
    return np.cumsum(parts[::-1], axis=0)[::-1].copy()


def _measure(part: Part, ends, place, g, info) -> None:
    """Add a part's gradient (K, q) of the tested statics and their information (K, q, p), with the states held.

    ``ends`` (K + 1,) are those of the stretches, in the part's epochs.
    """
    problem, values, weights = part.problem, part.values, part.weights

    def add(epoch, r, J, group, alive, share):
        if not J.statics:
            return
        weight = np.repeat(huber(lengths(r, group), weights.huber, alive)[0], group, axis=1)
        use = weight > 0
        weight = weight * share
        z = np.concatenate([problem.statics.columns[s] for s in J.statics])
        A = np.where(use[..., None], np.concatenate(list(J.statics.values()), axis=-1), 0.0)
        r = np.where(use, r, 0.0)
        here = np.flatnonzero(place[z] >= 0)
        to = place[z[here]]
        for j, (a, b) in enumerate(pairwise(np.searchsorted(epoch, ends).tolist())):
            if b > a:
                A_j = A[a:b].reshape(-1, len(z))
                wA = A_j[:, here] * weight[a:b].reshape(-1, 1)
                info[np.ix_(np.array([j]), to, z)] += (wA.T @ A_j)[None]
                g[j, to] += r[a:b].ravel() @ wA

    for corners, alive in zip(problem.corners, weights.corners, strict=True):
        r, J = corner_residuals(corners, values, problem.statics)
        add(corners.epoch, r, J, 2, alive, corners.share[:, None])
    for readings, alive in zip(problem.sensors, weights.sensors, strict=True):
        r, J = sensor_residuals(readings, values, problem.statics)
        add(readings.epoch, r, J, 1, alive, 1.0)


@njit(cache=True, error_model="numpy")
def _tails(Z, G, B, owner, at, R, total, out):
    """``Q(tau)`` at each candidate of a part, blocks of one static only, into out (K, q, q).

    ``owner`` is the static of a column. ``R`` (b, q) and the sum ``total`` (q, q) come from the part that follows, and
    go to the one before; candidates beyond this part are left alone.
    """
    n, b, q = B.shape
    new = np.zeros((b, q))
    j = len(at) - 1
    while j >= 0 and at[j] >= n:
        j -= 1
    for k in range(n - 1, -1, -1):
        for c in range(q):
            for i in range(b):
                s = 0.0
                d = 0.0
                for m in range(b):
                    s += Z[k, i, m] * B[k, m, c]
                    if k < len(G):
                        d += G[k, i, m] * R[m, c]
                new[i, c] = s - 2.0 * d
            # new is Z B - 2 G R: its product with B is the sum's symmetric part before it is made symmetric.
        for c in range(q):
            for e in range(q):
                if owner[c] == owner[e]:
                    s = 0.0
                    for i in range(b):
                        s += B[k, i, c] * new[i, e]
                    total[c, e] += s
        for c in range(q):
            for i in range(b):
                s = 0.0
                for m in range(b):
                    s += Z[k, i, m] * B[k, m, c]
                R[i, c] = 0.5 * (new[i, c] + s)
        while j >= 0 and at[j] == k:
            for c in range(q):
                for e in range(q):
                    out[j, c, e] = 0.5 * (total[c, e] + total[e, c])
            j -= 1


def step_of(found: Sums, columns, j: int):
    """Step of one static from candidate j on: (r,), its covariance under white noise (r, r), and T."""
    ix = np.ix_(columns, columns)
    N = found.cross[j][columns]
    info = found.own[j][ix] - N @ found.P_zz @ N.T
    values, vectors = np.linalg.eigh(0.5 * (info + info.T))
    # A direction that this log does not tell (less than a hundredth of the file's own information, or lost in the
    # rounding of what was taken off) stays out.
    floor = max(1e-2, 1e-9 * float(np.trace(found.own[0][ix])))
    inverse = np.where(values > floor, 1 / np.maximum(values, floor), 0.0)
    cov = (vectors * inverse) @ vectors.T
    g = found.g[j][columns]
    return -cov @ g, cov, float(g @ cov @ g)
