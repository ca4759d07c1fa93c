"""Eq. (3) of the paper with its own and its common part: covariances of every body at every epoch.

``P_xx = H_xx^-1 + Y S^-1 Y'``: the first term is a state's own and averages out over epochs, the second comes
through the statics and does not. A body in the world is a product of edges, some states, some statics; its error is
the linear map ``J_x dx + J_s dz`` of both, and ``dx = own - Y dz``. So its common part is ``M S^-1 M'`` with
``M = J_s - J_x Y``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from pipeline.errors import EstimationError
from pipeline.estimation import sweeps
from pipeline.estimation.linearised import parts, pieces
from pipeline.estimation.parts import Part
from pipeline.estimation.problem import Problem, Weights
from pipeline.estimation.pull import EASE
from pipeline.estimation.values import Values
from pipeline.geometry import se3
from pipeline.network import frames as fr


@dataclass(frozen=True, eq=False)
class Marginals:
    """Covariances of the unknowns."""

    Z: tuple[np.ndarray, ...]
    """(E, b, b) per chain: own part of its state."""
    G: tuple[np.ndarray, ...]
    """(E - 1, b, b) per chain; the own part of neighbouring states is ``Z_k,k+1 = -G_k Z_k+1``."""
    Y: tuple[np.ndarray, ...]
    """(E, b, q) per chain."""
    columns: tuple[np.ndarray, ...]
    """(q,) per chain: statics behind the columns of Y."""
    P_zz: np.ndarray
    """(p, p) covariance of the statics' unknowns; their prior is the identity."""
    log_det: float
    """Of the whole log's normal matrix, in a part's marginals too."""


def marginals_by_part(
    problem: Problem, values: Values, weights: Weights, eased=False
) -> Iterator[tuple[Part, Marginals]]:
    """Covariances at the optimum, without any damping, from the last part of the log to the first.

    Those of the states are of the part's epochs and of its far end. ``eased`` is that of ``Optimum``: the statics then
    know what the measurements tell without the motion prior.
    """
    cut = parts(problem, values, weights)
    linearised = pieces(cut)
    try:
        if eased:
            reduced, alone = sweeps.reduce_twice(pieces(cut, ease=EASE), len(cut))
            S = alone.S
        else:
            reduced = sweeps.reduce(linearised, len(cut))
            S = reduced.S
        P_zz = scipy.linalg.cho_solve(scipy.linalg.cho_factor(S), np.eye(len(S))) if len(S) else S
    except np.linalg.LinAlgError:
        raise EstimationError(
            "the covariances of this log cannot be had: the normal equations are singular at the optimum; "
            "this happens when a sigma in machine.toml or site.toml is wrong by orders of magnitude"
        ) from None
    P_zz = 0.5 * (P_zz + P_zz.T)
    columns = tuple(c.columns for c in linearised(len(cut) - 1).chains)
    for i, found in sweeps.inverses(linearised, reduced):
        yield (
            cut[i],
            Marginals(
                tuple(f.Z for f in found),
                tuple(f.G for f in found),
                tuple(f.Y for f in found),
                columns,
                P_zz,
                reduced.log_det,
            ),
        )


def marginals(problem: Problem, values: Values, weights: Weights, eased=False) -> Marginals:
    """Covariances of a whole log in memory: 2 GB for 100,000 epochs of two bodies."""
    found = [(part, m) for part, m in marginals_by_part(problem, values, weights, eased)][::-1]
    chains = range(len(problem.chains))
    return Marginals(
        tuple(np.concatenate([m.Z[c][: part.epochs] for part, m in found]) for c in chains),
        tuple(np.concatenate([m.G[c] for _, m in found]) for c in chains),
        tuple(np.concatenate([m.Y[c][: part.epochs] for part, m in found]) for c in chains),
        found[0][1].columns,
        found[0][1].P_zz,
        found[0][1].log_det,
    )


@dataclass(frozen=True, eq=False)
class BodyTrack:
    """One body (or ``tool``) at every epoch, in the world."""

    body: str
    T_world_body: np.ndarray
    """(E, 4, 4)."""
    velocity: np.ndarray
    """(E, 6) of the right perturbation, in the body: m/s and rad/s."""
    own: np.ndarray
    """(E, 6, 6) own part of the covariance of ``xi``."""
    M: np.ndarray
    """(E, 6, p) error by the statics' unknowns; the common part is ``M P_zz M'``."""
    variables: tuple[int, ...]
    """The variables between the world and this body."""
    J_x: dict[int, np.ndarray]
    """By chain: (E, 6, b) error by its states; the own part is the sum of ``J_x Z J_x'``."""


def body_track(problem: Problem, values: Values, found: Marginals, frame: str, name: str) -> BodyTrack:
    """Pose of a frame in the world with both parts of its covariance, composed exactly to first order."""
    E, p = len(problem.epochs.time_ns), problem.statics.size
    path = problem.tie.frames.path(fr.WORLD, frame)
    children, T = fr.along(path, lambda edge: values.edge_pose(problem.statics, edge))
    T = np.broadcast_to(T, (E, 4, 4)).copy()
    velocity = np.zeros((E, 6))
    M = np.zeros((E, 6, p))
    J_chain: dict[int, np.ndarray] = {}
    for step, T_world_child in zip(path, children, strict=True):
        assert step.sign > 0
        J = se3.Ad(se3.inverse(T) @ T_world_child)  # felt in the child, carried to the end of the path
        index = step.edge.index
        if step.edge.kind == "static":
            M[:, :, problem.statics.columns[index]] += J @ problem.statics.sensitivity(index, values.z)
            continue
        c, at = problem.place(index)
        J_x = J_chain.setdefault(c, np.zeros((E, 6, problem.chain_size(c))))
        if step.edge.kind == "joint":
            J_turn = step.edge.ratio * J[:, :, 5]
            J_x[:, :, at.start] += J_turn
            late = problem.statics.clock_error(index, values.z, values.time_s)
            J_x[:, :, at.start + 1] -= J_turn * np.broadcast_to(late, E)[:, None]
            turning = J_turn * values.rate[index][:, None]
            velocity += turning
            clock = problem.statics.clocks[index]
            if clock is not None:
                by_clock = problem.statics.lateness_by(clock, values.z, values.time_s)
                M[:, :, problem.statics.columns[clock]] -= turning[..., None] * by_clock[:, None]
        else:
            J_x[:, :, at.start : at.start + 6] += J
            velocity += np.einsum("nij,nj->ni", J, values.rate[index])
    own = np.zeros((E, 6, 6))
    for c, J_x in J_chain.items():
        own += J_x @ found.Z[c] @ np.swapaxes(J_x, -1, -2)
        M[:, :, found.columns[c]] -= J_x @ found.Y[c]
    variables = tuple(s.edge.index for s in path if s.edge.kind != "static")
    return BodyTrack(name, T, velocity, own, M, variables, J_chain)


def common_part(track: BodyTrack, P_zz):
    """(E, 6, 6) common part of the covariance of ``xi``."""
    return track.M @ P_zz @ np.swapaxes(track.M, -1, -2)


def vertical_budget(track: BodyTrack, P_zz, groups: dict[str, np.ndarray], rows):
    """Where the vertical sigma of a body's origin comes from, as variances that add up.

    The statics' priors and the measurements are independent of one another. The error of the statics is
    ``S^-1 (error of priors - error of measurements)``, so the variance from the priors of group g is
    ``|M S^-1 [:, g]|²``; what remains of ``M S^-1 M'`` came in through the measurements that calibrated the statics.

    Parameters
    ----------
    track : BodyTrack
        Of the body.
    P_zz : (p, p) array
        ``S^-1``.
    groups : dict of str to (r,) int array
        Columns of each group.
    rows : (k,) int array
        Epochs that count.

    Returns
    -------
    dict of str to (k,) array
        Variances, m²: ``own``, one per group, and ``statics from measurements``.
    """
    up = track.T_world_body[rows, 2, :3]  # the world's vertical in the body
    m = np.einsum("ni,nip->np", up, track.M[rows][:, :3])
    by_prior = m @ P_zz
    parts = {"own": np.einsum("ni,nij,nj->n", up, track.own[rows][:, :3, :3], up)}
    for name, columns in groups.items():
        parts[name] = np.sum(by_prior[:, columns] ** 2, axis=1)
    common = np.einsum("np,np->n", by_prior, m)
    parts["statics from measurements"] = np.maximum(common - np.sum(by_prior**2, axis=1), 0.0)
    return parts
