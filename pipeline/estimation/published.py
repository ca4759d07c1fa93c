"""What is published of every epoch, gathered part by part of the log: states with their covariances, fits, budgets.

The marginals of a whole shift would need 3 GB, what is published of them a tenth. So each part's marginals are made,
asked for everything at once, and left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import EstimationError
from pipeline.estimation import diagnostics
from pipeline.estimation.budget import Lasting, epoch_classes, groups_of, median_budgets
from pipeline.estimation.diagnostics import Fit
from pipeline.estimation.marginals import (
    BodyTrack,
    Marginals,
    body_track,
    common_part,
    marginals_by_part,
    vertical_budget,
)
from pipeline.estimation.optimise import Optimum
from pipeline.estimation.parts import Part
from pipeline.estimation.problem import Problem
from pipeline.estimation.sensitivities import Gathered, Sensitivities
from pipeline.estimation.solution import BodyStates
from pipeline.network import frames as fr


@dataclass(frozen=True, eq=False)
class Published:
    """Of every epoch what is published, and of the edge what is said about all of them."""

    states: tuple[BodyStates, ...]
    edge_seen: np.ndarray
    """(E,) bool: epochs at which the cutting edge was observed."""
    budget: dict
    by_class: dict
    lasting: dict
    sensitivities: Sensitivities | None
    """Of the cutting edge; None without one."""
    corner_fits: list[Fit]
    """Per group of corners."""
    sensor_fits: list[Fit]
    """Per sensor."""
    first: Marginals
    """Those of the first part, with what is the same in all: ``P_zz``, ``columns`` and ``log_det``."""


def published(problem: Problem, optimum: Optimum, max_gap_s: float) -> Published:
    """One pass over the marginals, from the last part of the log to the first."""
    seen, span = _coverage(problem, max_gap_s)
    bodies = [
        _Body(problem, name, frame, seen, span)
        for name in [*problem.network.bodies, fr.TOOL]
        if name != fr.WORLD and (frame := _frame(name)) in problem.tie.frames
    ]
    edge = next((b for b in bodies if b.name == fr.TOOL), None)
    gathered = None if edge is None else _Edge(problem, edge)
    corner_fits: list[list[Fit]] = [[] for _ in problem.corners]
    sensor_fits: list[list[Fit]] = [[] for _ in problem.sensors]
    for part, found in marginals_by_part(problem, optimum.values, optimum.weights, optimum.eased):
        for body in bodies:
            track = body_track(part.problem, part.values, found, body.frame, body.name)
            body.add(part, found, track)
            if gathered is not None and body is edge:
                gathered.add(part, found, track)
        at = part.problem, part.values, part.weights, found
        for fits, fit in zip(corner_fits, diagnostics.fit_corners(*at), strict=True):
            fits.append(fit)
        for fits, fit in zip(sensor_fits, diagnostics.fit_sensors(*at), strict=True):
            fits.append(fit)
    budget, by_class, lasting = ({}, {}, {}) if gathered is None else gathered.told()
    sensitivities = None if gathered is None else gathered.sensitivities.told()
    edge_seen = np.zeros(len(problem.epochs.time_ns), dtype=bool)
    if edge is not None:
        edge_seen[edge.rows] = edge.seen[edge.rows]
    return Published(
        tuple(body.states() for body in bodies),
        edge_seen,
        budget,
        by_class,
        lasting,
        sensitivities,
        [_joined(fits) for fits in corner_fits],
        [_joined(fits) for fits in sensor_fits],
        found,
    )


def _frame(name: str) -> str:
    return fr.TOOL if name == fr.TOOL else fr.body_frame(name)


def _joined(fits: list[Fit]) -> Fit:
    """Fits of parts, gathered from the last to the first."""
    back = fits[::-1]
    return Fit(*(np.concatenate([getattr(f, name) for f in back]) for name in ("r", "weight", "redundancy")))


class _Body:
    """States of one body, filled from the last part to the first."""

    def __init__(self, problem: Problem, name: str, frame: str, seen, span):
        E = len(problem.epochs.time_ns)
        path = problem.tie.frames.path(fr.WORLD, frame)
        over = [s.edge.index for s in path if s.edge.kind != "static"]
        # Between the first and last observation of everything the body hangs on; seen where all of that is.
        first = max((span[k][0] for k in over), default=0)
        last = min((span[k][1] for k in over), default=E - 1)
        self.problem, self.name, self.frame = problem, name, frame
        self.rows = np.arange(first, last + 1)
        self.seen = np.logical_and.reduce([seen[k] for k in over]) if over else np.ones(E, dtype=bool)
        n = len(self.rows)
        self.T, self.velocity = np.empty((n, 4, 4)), np.empty((n, 6))
        self.own, self.common = np.empty((n, 6, 6)), np.empty((n, 6, 6))
        self.angle, self.sigma = np.full(n, np.nan), np.full(n, np.nan)
        self.joint = next(
            (k for k, v in enumerate(problem.tie.variables) if v.body == name and v.kind == "joint"), None
        )

    def inside(self, part: Part) -> tuple[slice, slice]:
        """Where the published of a part's own epochs stand among those of the part, and among all published."""
        a = min(max(part.start, int(self.rows[0])), part.stop) if len(self.rows) else part.start
        b = max(min(part.stop, int(self.rows[-1]) + 1), a) if len(self.rows) else part.start
        origin = int(self.rows[0]) if len(self.rows) else part.start
        return slice(a - part.start, b - part.start), slice(a - origin, b - origin)

    def add(self, part: Part, found: Marginals, track: BodyTrack) -> None:
        here, to = self.inside(part)
        self.T[to], self.velocity[to] = track.T_world_body[here], track.velocity[here]
        self.own[to], self.common[to] = track.own[here], common_part(track, found.P_zz)[here]
        if self.joint is not None:
            c, at = self.problem.place(self.joint)
            y = found.Y[c][here, at.start]
            P = found.P_zz[np.ix_(found.columns[c], found.columns[c])]
            variance = found.Z[c][here, at.start, at.start] + np.einsum("ni,ij,nj->n", y, P, y)
            self.angle[to], self.sigma[to] = part.values.pose[self.joint][here], np.sqrt(variance)

    def states(self) -> BodyStates:
        return BodyStates(
            self.name,
            self.problem.epochs.time_ns[self.rows],
            self.T,
            self.velocity,
            self.angle,
            self.sigma,
            self.seen[self.rows],
            self.own,
            self.common,
        )


class _Edge:
    """What is said about the cutting edge over all epochs."""

    def __init__(self, problem: Problem, body: _Body):
        self.body, self.groups = body, groups_of(problem)
        self.classes = np.zeros(len(problem.epochs.time_ns), dtype=np.int64)
        self.variances: list[dict[str, np.ndarray]] = []
        self.lasting = Lasting(problem.epochs.time_s, body.rows)
        self.sensitivities = Gathered(problem, problem.network.edge_m)

    def add(self, part: Part, found: Marginals, track: BodyTrack) -> None:
        seen = self.body.seen[part.with_far_end]
        here, _ = self.body.inside(part)
        self.classes[part.start : part.stop] = epoch_classes(part.problem, part.values, track, seen)[
            : part.epochs
        ]
        rows = np.arange(here.start, here.stop)
        variances = vertical_budget(track, found.P_zz, self.groups, rows)
        self.variances.append(variances)
        self.lasting.add(track, found, part.start, part.epochs)
        self.sensitivities.add(track, found, part.start, rows, variances)

    def told(self) -> tuple[dict, dict, dict]:
        back = self.variances[::-1]
        variances = {name: np.concatenate([v[name] for v in back]) for name in back[0]}
        budget, by_class = median_budgets(variances, self.classes[self.body.rows])
        return budget, by_class, self.lasting.described(self.classes)


def _coverage(problem: Problem, max_gap_s: float):
    """Per variable: which epochs have an observation near, and its first and last one."""
    E, t = len(problem.epochs.time_ns), problem.epochs.time_s
    when = [np.zeros(E, dtype=bool) for _ in problem.tie.variables]
    for group in problem.corners:
        for step in group.path:
            if step.edge.kind != "static":
                when[step.edge.index][group.epoch] = True
    for readings in problem.sensors:
        when[readings.variable][readings.epoch] = True
    near, span = [], []
    for variable, mask in zip(problem.tie.variables, when, strict=True):
        at = np.flatnonzero(mask)
        if len(at) == 0:
            raise EstimationError(f"body '{variable.body}' has no observation that can be used")
        after = t[at[np.minimum(np.searchsorted(at, np.arange(E)), len(at) - 1)]]
        before = t[at[np.maximum(np.searchsorted(at, np.arange(E), side="right") - 1, 0)]]
        near.append(np.minimum(np.abs(after - t), np.abs(t - before)) <= max_gap_s)
        span.append((at[0], at[-1]))
    return near, span
