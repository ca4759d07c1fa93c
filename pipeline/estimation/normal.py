"""The normal equations of a problem, or of a part of one, as an arrow; and its cost, epoch by epoch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.estimation import blocks, corner_kernels, motion, motion_kernels
from pipeline.estimation.arrow import Chain
from pipeline.estimation.problem import (
    LOST,
    Problem,
    Weights,
    first_residual,
    huber,
    lengths,
    motion_residual,
)
from pipeline.estimation.residuals import TURN_COLUMN, Corners, Jacobians, sensor_residuals
from pipeline.estimation.values import Values, along


def cost_by_epoch(problem: Problem, values: Values, weights: Weights):
    """Robust cost at every epoch, and that of the statics' priors.

    Returns
    -------
    local : (E,) array
        Corners and readings of the epoch, motion up to the next, and at the first epoch its weak prior.
    prior : float
    """
    local = np.zeros(len(problem.epochs.time_ns))
    for group, alive in zip(problem.corners, weights.corners, strict=True):
        way, sign = _way(problem, values, group)
        corner_kernels.corner_costs(
            group.epoch,
            group.p_marker,
            group.uv,
            group.whitener,
            group.share,
            alive,
            way,
            sign,
            problem.statics.value(group.intrinsics, values.z),
            _constant(problem, values, group),
            weights.huber,
            LOST,
            local,
        )
    for readings, alive in zip(problem.sensors, weights.sensors, strict=True):
        r, _ = sensor_residuals(readings, values, problem.statics, jacobians=False)
        np.add.at(local, readings.epoch, huber(lengths(r, 1), weights.huber, alive)[1].sum(axis=-1))
    for k, variable in enumerate(problem.tie.variables):
        if variable.kind == "moving":
            motion_kernels.motion_costs(
                values.pose[k],
                values.rate[k],
                problem.dt_s,
                motion.whitening(problem.dt_s, problem.densities[k]),
                local,
            )
        else:
            e, _, _ = motion_residual(problem, values, k, jacobians=False)
            local[:-1] += 0.5 * np.sum(e**2, axis=-1)
        if problem.opens:
            local[0] += 0.5 * np.sum(first_residual(problem, values, k)[0] ** 2)
    return local, 0.5 * float(values.z @ values.z) if problem.opens else 0.0


def corner_lengths(problem: Problem, values: Values, group: Corners):
    """Lengths of the whitened residuals of every corner of a group, (n, 4); nan where one is behind the camera."""
    way, sign = _way(problem, values, group)
    out = np.empty((len(group.epoch), 4))
    intrinsics = problem.statics.value(group.intrinsics, values.z)
    constant = _constant(problem, values, group)
    corner_kernels.corner_lengths(
        group.p_marker, group.uv, group.whitener, way, sign, intrinsics, constant, out
    )
    return out


def linearise(problem: Problem, values: Values, weights: Weights, newton=False):
    """Normal equations at the given values, after re-weighting.

    Parameters
    ----------
    problem : Problem
        All measurements.
    values : Values
        Where to linearise.
    weights : Weights
        What counts; the robust weights follow from the residuals at ``values``.
    newton : bool
        Take the curvature of Huber's loss as it is: beyond the threshold there is none along the residual. For steps
        only; re-weighting alone converges linearly, 40 iterations where this takes 10. Never for covariances.

    Returns
    -------
    chains : list of Chain
    C : (p, p) array
    g_z : (p,) array
    """
    chains, C, g_z = _of_measurements(problem, values, weights, newton)
    _add_motion(problem, values, chains)
    return chains, C, g_z


def linearise_twice(problem: Problem, values: Values, weights: Weights, ease: float, newton=False):
    """The same, and the chains once more with the motion prior eased, as ``pull`` asks for.

    Returns
    -------
    chains : list of Chain
    eased : list of Chain
        With densities of motion that are ``ease`` times larger, and without its residuals in the gradient.
    C : (p, p) array
    g_z : (p,) array
    """
    chains, C, g_z = _of_measurements(problem, values, weights, newton)
    measured = [(chain.D.copy(), chain.g.copy()) for chain in chains]
    _add_motion(problem, values, chains)
    eased = [
        Chain(D + (chain.D - D) / ease, chain.A / ease, g, chain.B, chain.columns)
        for chain, (D, g) in zip(chains, measured, strict=True)
    ]
    return chains, eased, C, g_z


def _of_measurements(problem: Problem, values: Values, weights: Weights, newton):
    """What corners, readings and the priors of statics and of the first epoch make of it."""
    E, p = len(problem.epochs.time_ns), problem.statics.size
    columns = [_columns(problem, c) for c in range(len(problem.chains))]
    chains = [
        Chain(np.zeros((E, b, b)), np.zeros((E - 1, b, b)), np.zeros((E, b)), np.zeros((E, b, len(q))), q)
        for b, q in zip(map(problem.chain_size, range(len(columns))), columns, strict=True)
    ]
    C, g_z = np.zeros((p, p)), np.zeros(p)
    for group, alive in zip(problem.corners, weights.corners, strict=True):
        _add_corners(problem, chains, C, g_z, group, values, weights.huber, alive, newton)
    for readings, alive in zip(problem.sensors, weights.sensors, strict=True):
        r, J = sensor_residuals(readings, values, problem.statics)
        _add_readings(problem, chains, C, g_z, readings.epoch, r, J, weights.huber, alive, newton)
    if problem.opens:
        for k in range(len(problem.tie.variables)):
            c, at = problem.place(k)
            e, J = first_residual(problem, values, k)
            chains[c].D[0, at, at] += J.T @ J
            chains[c].g[0, at] += J.T @ e
        C += np.eye(p)
        g_z += values.z
    return chains, C, g_z


def _add_motion(problem: Problem, values: Values, chains) -> None:
    for k, variable in enumerate(problem.tie.variables):
        c, at = problem.place(k)
        chain = chains[c]
        if variable.kind == "moving":
            motion_kernels.add_motion(
                values.pose[k],
                values.rate[k],
                problem.dt_s,
                motion.whitening(problem.dt_s, problem.densities[k]),
                at.start,
                chain.D,
                chain.A,
                chain.g,
            )
        else:
            e, J_1, J_2 = motion_residual(problem, values, k)
            J_1t, J_2t = np.swapaxes(J_1, -1, -2), np.swapaxes(J_2, -1, -2)
            chain.D[:-1, at, at] += J_1t @ J_1
            chain.D[1:, at, at] += J_2t @ J_2
            chain.A[:, at, at] += J_1t @ J_2
            chain.g[:-1, at] += np.einsum("nij,nj->ni", J_1t, e)
            chain.g[1:, at] += np.einsum("nij,nj->ni", J_2t, e)


def linearised_along(problem: Problem, values: Values, weights: Weights, dz, newton=False) -> list[Chain]:
    """Chains of ``linearise`` without a border, their gradient ``g + B dz``: a step of the states once dz is known.

    A corner's rows then have one column of all statics in place of some twenty; with all of them it took three times as
    long.
    """
    moved = replace(problem, statics=along(problem.statics, values.z, dz))
    chains, _, _ = linearise(moved, replace(values, z=np.zeros(1)), weights, newton)
    return [replace(c, g=c.g + c.B.sum(axis=-1), B=c.B[..., :0], columns=c.columns[:0]) for c in chains]


def _way(problem: Problem, values: Values, group: Corners):
    """Edges of a group's path as the kernels take them: ``T_parent_child`` (m, n or 1, 4, 4), and signs (m,)."""
    edges = [values.edge_pose(problem.statics, s.edge, group.epoch) for s in group.path]
    still = all(T.ndim == 2 for T in edges)
    way = np.empty((len(edges), 1 if still else len(group.epoch), 4, 4))
    for k, T in enumerate(edges):
        way[k] = T
    return way, np.array([s.sign for s in group.path], dtype=np.int64)


def _constant(problem: Problem, values: Values, group: Corners):
    """(4, 2) constant errors of a group's corners, px."""
    if group.offset is None:
        return np.zeros((4, 2))
    return problem.statics.value(group.offset, values.z).reshape(4, 2)


def _add_corners(
    problem: Problem, chains, C, g_z, group: Corners, values: Values, k: float, alive, newton
) -> None:
    """Add the corners of one group: what each error along the path moves, handed to the compiled kernel."""
    if len(group.epoch) == 0:
        return
    statics, z = problem.statics, values.z
    x_at: list[int] = []
    z_at: list[int] = []
    # Per step: state columns, static columns, the edge's error by each, and a joint's clock: its columns, and the turn
    # by the joint's rate and by them, (n, 1 + r).
    steps: list[tuple[list[int], list[int], np.ndarray, tuple[list[int], np.ndarray] | None]] = []
    time_s = values.time_s[group.epoch]
    for step in group.path:
        index, kind = step.edge.index, step.edge.kind
        if kind == "static":
            z_at += [c for c in statics.columns[index] if c not in z_at]
            steps.append(([], list(statics.columns[index]), statics.sensitivity(index, z), None))
        else:
            at = problem.place(index)[1].start
            places = [at + i for i in range(6 if kind == "moving" else 2)]
            x_at += [x for x in places if x not in x_at]
            turn = np.zeros((6, 2))
            clock: tuple[list[int], np.ndarray] | None = None
            if kind == "joint":
                turn[TURN_COLUMN, 0] = step.edge.ratio
                of = statics.clocks[index]
                if of is not None and len(statics.columns[of]):  # else it is not late
                    rate, late = values.rate[index][group.epoch], statics.lateness(of, z, time_s)
                    by_clock = rate[:, None] * statics.lateness_by(of, z, time_s)
                    clock = (
                        statics.columns[of].tolist(),
                        -step.edge.ratio * np.column_stack([late, by_clock]),
                    )
                    z_at += [c for c in clock[0] if c not in z_at]
            steps.append((places, [], np.eye(6) if kind == "moving" else turn, clock))
    intrinsics = statics.columns[group.intrinsics]
    z_at += [c for c in intrinsics if c not in z_at]
    offset = statics.columns[group.offset] if group.offset is not None else np.array([], dtype=np.int64)
    K_offset = statics.sensitivity(group.offset, z) if group.offset is not None else np.zeros((8, 0))
    z_at += list(offset)
    m, cx = len(steps), len(x_at)
    column, width = np.zeros(m, dtype=np.int64), np.zeros(m, dtype=np.int64)
    K = np.zeros((m, 6, max([s[2].shape[1] for s in steps] + [1])))
    clocks, clock_width = np.full(m, -1, dtype=np.int64), np.zeros(m, dtype=np.int64)
    widest = max((s[3][1].shape[1] for s in steps if s[3] is not None), default=0)
    K_clock = np.zeros((m, len(group.epoch) if widest else 1, max(widest, 1)))
    for n, (x, z_columns, J, turned) in enumerate(steps):
        width[n] = len(x) + len(z_columns)
        if width[n]:
            column[n] = x_at.index(x[0]) if x else cx + z_at.index(z_columns[0])
            K[n, :, : width[n]] = J
        if turned is not None:
            clocks[n], clock_width[n] = cx + z_at.index(turned[0][0]), len(turned[0])
            K_clock[n, :, : 1 + clock_width[n]] = turned[1]
    moving = [s.edge.index for s in group.path if s.edge.kind != "static"]
    if moving:
        chain = chains[problem.place(moving[0])[0]]
        blocks_of_chain = chain.D, chain.g, chain.B
        border_at = np.searchsorted(chain.columns, z_at)
    else:
        blocks_of_chain = np.zeros((0, 0, 0)), np.zeros((0, 0)), np.zeros((0, 0, 0))
        border_at = np.zeros(len(z_at), dtype=np.int64)
    C_group, g_group = np.zeros((len(z_at), len(z_at))), np.zeros(len(z_at))
    way, sign = _way(problem, values, group)
    corner_kernels.add_corners(
        group.epoch,
        group.p_marker,
        group.uv,
        group.whitener,
        group.share,
        alive,
        way,
        sign,
        column,
        width,
        K,
        clocks,
        clock_width,
        K_clock,
        statics.value(group.intrinsics, z),
        cx + z_at.index(intrinsics[0]) if len(intrinsics) else 0,
        np.ascontiguousarray(statics.sensitivity(group.intrinsics, z)),  # else it is compiled twice
        _constant(problem, values, group),
        cx + z_at.index(offset[0]) if len(offset) else 0,
        np.ascontiguousarray(K_offset).reshape(4, 2, -1),
        k,
        newton,
        np.array(x_at, dtype=np.int64),
        border_at.astype(np.int64),
        *blocks_of_chain,
        C_group,
        g_group,
    )
    both = np.array(z_at, dtype=np.int64)
    C[np.ix_(both, both)] += np.triu(C_group) + np.triu(C_group, 1).T
    g_z[both] += g_group


def _columns(problem: Problem, chain: int):
    """Statics that bear on a chain."""
    met: set[int] = set()
    for group in problem.corners:
        moving = [s.edge.index for s in group.path if s.edge.kind != "static"]
        if moving and moving[0] in problem.chains[chain]:
            met.update(s.edge.index for s in group.path if s.edge.kind == "static")
            met.add(group.intrinsics)
            if group.offset is not None:
                met.add(group.offset)
            met.update(c for k in moving if (c := problem.statics.clocks[k]) is not None)
    for readings in problem.sensors:
        if readings.variable in problem.chains[chain]:
            sensor = readings.sensor
            clock = problem.statics.clocks[readings.variable]
            assert clock is not None
            met.update({sensor.curve, sensor.offset, clock})
            if sensor.linkage is not None:
                met.add(sensor.linkage)
    parts = [problem.statics.columns[s] for s in sorted(met)]
    return np.unique(np.concatenate(parts)) if parts else np.array([], dtype=np.int64)


def _add_readings(problem: Problem, chains, C, g_z, epoch, r, J: Jacobians, k: float, alive, newton) -> None:
    """Add the readings of one sensor, (n, 1) whitened residuals at rising epochs."""
    if len(epoch) == 0:
        return
    weight, _ = huber(lengths(r, 1), k, alive)
    use = weight > 0
    parts = [*J.variables.values(), *J.statics.values()]
    A = np.where(use[..., None], np.concatenate(parts, axis=-1), 0.0)[:, 0]
    r = np.where(use, r, 0.0)[:, 0]
    z = np.concatenate([problem.statics.columns[s] for s in J.statics]) if J.statics else np.array([], int)
    count = A.shape[-1] - len(z)
    if len(np.unique(z)) < len(z):  # of ``values.Along``: one column of several statics
        z, column = np.unique(z, return_inverse=True)
        merged = np.zeros((len(A), count + len(z)))
        merged[:, :count] = A[:, :count]
        for j, to in enumerate(column.tolist()):
            merged[:, count + to] += A[:, count + j]
        A = merged
    bent = np.where(weight < 1, 0.0, weight) if newton else weight  # past the threshold the loss is a line
    wA, wr = bent * A, weight[:, 0] * r
    C[np.ix_(z, z)] += blocks.gram(A[:, count:], wA[:, count:])
    g_z[z] += A[:, count:].T @ wr
    places = {v: problem.place(v) for v in J.variables}
    chain = chains[next(iter(places.values()))[0]]
    x = np.concatenate([np.arange(at.start, at.stop) for _, at in places.values()])
    starts = np.flatnonzero(np.r_[True, np.diff(epoch) > 0])
    at = epoch[starts]
    both = np.add.reduceat(A[:, :count, None] * wA[:, None, :], starts, axis=0)
    chain.g[np.ix_(at, x)] += np.add.reduceat(A[:, :count] * wr[:, None], starts, axis=0)
    chain.D[np.ix_(at, x, x)] += both[..., :count]
    if len(z):
        chain.B[np.ix_(at, x, np.searchsorted(chain.columns, z))] += both[..., count:]
