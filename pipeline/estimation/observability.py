"""What the data of a log cannot tell, found before solving and said in words.

The statics' information ``H = C - sum W' W`` (the reduced normal matrix without the priors, which are the identity)
is the data's alone. A direction of one static in its null space is told by nothing; a direction that two statics have
in its null space together, though each is told where the other is known, is the two in series: only their product is
seen. Both keep what their priors say. A state's null space is looked for in the pictures of some seconds, without the
motion prior: where a body and a joint can move against each other unseen, no picture parts them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.estimation import arrow
from pipeline.estimation.approach import at_epochs
from pipeline.estimation.normal import linearise
from pipeline.estimation.problem import Problem, keep_all
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.network import frames as fr
from pipeline.network.model import SOURCES

TELLS = 0.1
"""Information, in units of the prior's, below which a direction is not told: its sigma falls by less than 5 %."""
STATE_SIGMA = 1.0
"""A pose whose pictures leave it to more than this (m, rad) is not told by them."""
EPOCHS, STRETCHES = 3000, 20
"""Of a longer log so many stretches, together so many epochs, are looked at: what a network cannot tell it cannot tell
in any of them, and the answer must not cost a second adjustment."""
WINDOW = 64
"""Epochs whose pictures are taken together: cameras need not be triggered at one instant."""
IN_SERIES = 3
"""Two poses are called in series if so many unknowns show in their product only: a whole turn or shift. Fewer are what
boards far away share in any network, and would drown the rest."""
TIMES = 3
"""So many spans of time are spelled out."""
ON_A_LINE = 0.1
"""Benchmarks count as on one line when none is further off it than this share of its length."""
HUBER = 2.5


@dataclass(frozen=True)
class Finding:
    """Something that the data cannot tell or cannot part."""

    kind: str
    """untold, in series, gauge, line."""
    quantities: tuple[str, ...]
    start_ns: int
    end_ns: int
    sentence: str


def findings(problem: Problem) -> tuple[Finding, ...]:
    """What the log cannot tell, at the values of the start."""
    cut = _cut(problem, _sample(len(problem.epochs.time_ns)))
    return (*_gauges(cut), *_benchmarks_on_a_line(cut), *_statics(cut))


def information(problem: Problem) -> np.ndarray:
    """(p, p) information of the data about the statics' unknowns, whose prior has I; inf if it cannot be had."""
    chains, C, g_z = linearise(problem, problem.first, keep_all(problem, HUBER))
    for damping in (0.0, 1e-9, 1e-6):  # where the start is poor, rounding may leave the matrix indefinite
        try:
            S = arrow.solve(chains, C, g_z, np.full(len(problem.epochs.time_ns), damping)).S
            return S - np.eye(problem.statics.size)
        except np.linalg.LinAlgError:
            continue
    return np.full((problem.statics.size,) * 2, np.inf)


def null_space(H, limit: float):
    """(n, k) orthonormal directions in which a symmetric information matrix is below the limit."""
    values, vectors = np.linalg.eigh(H)
    return vectors[:, values < limit]


def _statics(problem: Problem) -> list[Finding]:
    if problem.statics.size == 0 or not problem.chains:
        return []
    H = information(problem)
    if not np.all(np.isfinite(H)):
        return []
    columns = problem.statics.columns
    named = [k for k, s in enumerate(problem.network.statics) if s.source in SOURCES and len(columns[k])]
    alone = {k: null_space(H[np.ix_(columns[k], columns[k])], TELLS).shape[1] for k in named}
    used = _on_paths(problem)
    whole = [k for k in named if k in used and alone[k] == len(columns[k])]
    offsets = {s.offset: s for s in problem.network.sensors}
    found = [_untold_offset(problem, offsets[k]) for k in whole if k in offsets]
    if rest := [k for k in whole if k not in offsets]:
        found.append(_untold(problem, rest))
    poses = [k for k in named if problem.network.statics[k].is_pose]
    for i, a in enumerate(poses):
        for b in poses[:i]:
            both = np.concatenate([columns[b], columns[a]])
            count = null_space(H[np.ix_(both, both)], TELLS).shape[1] - alone[a] - alone[b]
            if count >= IN_SERIES:
                found.append(_in_series(problem, b, a, count))
    return found


def _untold(problem: Problem, indices) -> Finding:
    statics = [problem.network.statics[k] for k in indices]
    they = "it stays as the file states it" if len(statics) == 1 else "they stay as the files state them"
    sentence = f"nothing in the log tells {', '.join(map(_spoken, statics))}: {they}"
    return _finding(problem, "untold", tuple(s.name for s in statics), sentence)


def _untold_offset(problem: Problem, sensor) -> Finding:
    static = problem.network.statics[sensor.offset]
    value, sigma = 1000 * static.value[0], 1000 * float(np.sqrt(static.covariance[0, 0]))
    sentence = (
        f"the time offset of sensor '{sensor.name}' cannot be told: nothing else in the log shows joint "
        f"'{sensor.joint}' moving; it stays at the file's {value:.0f} ms within {sigma:.1f} ms (a marker beyond the "
        f"joint, or a second sensor, would tell)"
    )
    return _finding(problem, "untold", (static.name,), sentence)


def _in_series(problem: Problem, a: int, b: int, count: int) -> Finding:
    first, second = problem.network.statics[a], problem.network.statics[b]
    sentence = (
        f"{_spoken(first)} and {_spoken(second)} are seen one after the other only: the log tells their product, not "
        f"the two ({count} unknown{'s' if count > 1 else ''}); what it tells is shared out by their sigmas in the files"
    )
    return _finding(problem, "in series", (first.name, second.name), sentence)


def _gauges(problem: Problem) -> list[Finding]:
    """Variables that no picture and no reading parts, with the time for which that is so."""
    halves = [v.half for v in problem.tie.variables]
    ends = np.cumsum([0, *halves])
    E = len(problem.epochs.time_ns)
    windows = np.minimum(np.arange(E) // WINDOW, max(E // WINDOW - 1, 0))  # no short one at the end
    N = np.zeros((windows[-1] + 1, ends[-1], ends[-1]))
    measured = [(g.epoch, *corner_residuals(g, problem.first, problem.statics)) for g in problem.corners]
    measured += [(s.epoch, *sensor_residuals(s, problem.first, problem.statics)) for s in problem.sensors]
    for epoch, r, J in measured:
        assert J is not None
        if not J.variables:
            continue
        at = np.concatenate([np.arange(ends[k], ends[k + 1]) for k in J.variables])
        A = np.concatenate([J.variables[k][..., : halves[k]] for k in J.variables], axis=-1)
        A = np.where(np.isfinite(r)[..., None], A, 0.0)
        for w in np.unique(windows[epoch]):
            A_w = A[windows[epoch] == w].reshape(-1, len(at))
            N[w][np.ix_(at, at)] += A_w.T @ A_w
    spans: dict[tuple[str, ...], list[int]] = {}
    for w, N_w in enumerate(N):
        seen = np.flatnonzero(np.diagonal(N_w) > 0)  # what is not seen at all is a gap, not a gauge
        for direction in null_space(N_w[np.ix_(seen, seen)], STATE_SIGMA**-2).T:
            share = np.zeros(ends[-1])
            share[seen] = direction**2
            members = [k for k in range(len(halves)) if share[ends[k] : ends[k + 1]].sum() > 0.01]
            names = tuple(problem.tie.variables[k].body for k in members)
            if w not in spans.setdefault(names, []):
                spans[names].append(w)
    return [_gauge(problem, names, at, windows) for names, at in spans.items()]


def _gauge(problem: Problem, names, at: list[int], windows) -> Finding:
    runs = np.split(np.array(at), np.flatnonzero(np.diff(at) > 1) + 1)
    edges = [(np.flatnonzero(windows == r[0])[0], np.flatnonzero(windows == r[-1])[-1]) for r in runs]
    t = problem.epochs.time_s
    when = [f"from {t[a]:.1f} to {t[b]:.1f} s" for a, b in edges[:TIMES]]
    more = f" and {len(edges) - TIMES} more times" if len(edges) > TIMES else ""
    kinds = {v.body: v.kind for v in problem.tie.variables}
    said = " and ".join(f"{'joint' if kinds[n] == 'joint' else 'body'} '{n}'" for n in names)
    if len(names) > 1:
        what = f"pictures and readings show only what {said} make together; the motion prior shares it out"
    else:
        what = f"pictures and readings leave {said} free in some direction; the motion prior alone holds it"
    sentence = f"{', '.join(when)}{more} of the log {what} (a marker on one of them would tell)"
    first, last = problem.epochs.time_ns[[edges[0][0], edges[-1][1]]]
    return Finding("gauge", names, int(first), int(last), sentence)


def _benchmarks_on_a_line(problem: Problem) -> list[Finding]:
    """Where the surveyed marks that are seen leave the turn about their line to their own surveyed rotation."""
    if any(c.body == fr.WORLD for c in problem.network.cameras):
        return []
    groups = [g for g in problem.corners if problem.network.markers[g.marker].benchmark]
    marks = sorted({g.marker for g in groups if _is_surveyed(problem, g.marker)})
    if not marks:
        return []
    statics = [problem.network.statics[problem.network.markers[m].mount] for m in marks]
    p = np.array([s.value[:3, 3] for s in statics])
    length, off = 0.0, 0.0
    if len(p) > 1:
        spread = np.linalg.svd(p - p.mean(0))
        length = float(np.ptp((p - p.mean(0)) @ spread[2][0]))
        off = float(np.abs((p - p.mean(0)) @ spread[2][1:].T).max())
    if len(p) > 2 and off > ON_A_LINE * length:
        return []
    names = tuple(problem.network.markers[m].name for m in marks)
    sigma = np.sqrt(np.mean([np.trace(s.covariance[3:, 3:]) / 3 for s in statics]) / len(p))
    listed = ", ".join(f"'{n}'" for n in names)
    if len(p) == 1:
        what = f"only one benchmark was seen ({listed}): every turn"
    else:
        what = f"the benchmarks that were seen ({listed}) lie on one line: the turn about it"
    sentence = (
        f"{what} rests on how their prints were surveyed to be turned, {np.rad2deg(sigma):.3f} deg or "
        f"{1e4 * sigma:.0f} mm in 10 m; survey a benchmark off the line"
    )
    return [_finding(problem, "line", names, sentence)]


def _is_surveyed(problem: Problem, marker: int) -> bool:
    return problem.network.statics[problem.network.markers[marker].mount].surveyed


def _on_paths(problem: Problem) -> set[int]:
    """Statics that some prediction of the log goes through; the others are simply not used."""
    used = {s.edge.index for g in problem.corners for s in g.path if s.edge.kind == "static"}
    used |= {g.intrinsics for g in problem.corners}
    for readings in problem.sensors:
        sensor = readings.sensor
        used |= {sensor.curve, sensor.offset} | ({sensor.linkage} if sensor.linkage is not None else set())
    return used


def _spoken(static) -> str:
    """``camera dig mount`` as a person says it: the mount of camera 'dig'."""
    kind, _, rest = static.name.partition(" ")
    name, _, what = rest.partition(" ")
    return f"the {what} of {kind} '{name}'" if what else f"'{static.name}'"


def _finding(problem: Problem, kind: str, quantities, sentence: str) -> Finding:
    t = problem.epochs.time_ns
    return Finding(kind, quantities, int(t[0]), int(t[-1]), sentence)


def _sample(count: int):
    """Epochs that are looked at: all of a short log, stretches spread evenly over a long one."""
    if count <= EPOCHS:
        return np.arange(count)
    length = EPOCHS // STRETCHES
    starts = np.linspace(0, count - length, STRETCHES).astype(np.int64)
    return (starts[:, None] + np.arange(length)).ravel()


def _cut(problem: Problem, keep) -> Problem:
    """The same problem at some of its epochs."""
    E = len(problem.epochs.time_ns)
    if len(keep) == E:
        return problem
    new = np.full(E, -1)
    new[keep] = np.arange(len(keep))

    def rows_of(group):
        rows, n = new[group.epoch] >= 0, len(group.epoch)
        parts = {f.name: getattr(group, f.name) for f in fields(group)}
        kept = {k: v[rows] for k, v in parts.items() if isinstance(v, np.ndarray) and len(v) == n}
        return replace(group, **(kept | {"epoch": new[group.epoch[rows]]}))

    epochs = replace(problem.epochs, time_ns=problem.epochs.time_ns[keep])
    between = keep[:-1]
    return replace(
        problem,
        epochs=epochs,
        corners=tuple(c for c in map(rows_of, problem.corners) if len(c.epoch)),
        sensors=tuple(s for s in map(rows_of, problem.sensors) if len(s.epoch)),
        first=at_epochs(problem.first, keep),
        dt_s=np.diff(epochs.time_s),
        densities=tuple(q[between] for q in problem.densities),
    )
