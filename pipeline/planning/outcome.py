"""A whole plan: along the trench, as maps, what is seen, what changes bring, and whether the tolerance can be met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import PlanningError
from pipeline.planning.changes import Gain, Place, best_place, gains, largest_benchmark
from pipeline.planning.edge import EdgePlan
from pipeline.planning.postures import Arm, Postures, postures_from
from pipeline.planning.prediction import Prediction, Setup, predict, predict_elsewhere
from pipeline.planning.sight import REASONS, SEEN
from pipeline.planning.work import (
    PASSES,
    Habits,
    Trench,
    along_trench,
    around,
    in_the_arms_plane,
    stand_at,
)

ELLIPSES = 9
"""Along each side of a map."""
CANDIDATES = (9, 6)
"""Places for the next benchmark along the trench and across it."""


@dataclass(frozen=True, eq=False)
class Line:
    """Along the trench; (k,) unless said."""

    station: np.ndarray
    sigma_h: np.ndarray
    """m, median over one sweep; nan where the edge is not seen."""
    own: np.ndarray
    common: np.ndarray
    capable: np.ndarray
    """Whether U = k sigma fits half the tolerance."""


@dataclass(frozen=True, eq=False)
class Map:
    """Over a grid, second axis x."""

    x: np.ndarray
    y: np.ndarray
    sigma_h: np.ndarray
    """(len(y), len(x)) m; nan out of reach or not seen."""
    ellipses: list[tuple[float, float, np.ndarray]]
    """x, y, and the (2, 2) covariance in the map's axes, m²."""


@dataclass(frozen=True)
class Seen:
    """What one camera sees of one marker over the work."""

    camera: str
    marker: str
    share: float
    """Of postures in which at least one of its tags is seen."""
    tags: float
    """Seen at a time, mean where any is."""
    side_px: float
    """Median."""
    why_not: str
    """The most frequent reason, of ``REASONS``; empty where all is seen."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Everything that a plan says."""

    setup: Setup
    arm: Arm
    habits: Habits
    half_tolerance_m: float
    coverage_factor: float
    line: Line
    edge: EdgePlan
    """Over the work."""
    stand_station: float
    arm_map: Map
    plan_map: Map
    """x forward and y left of the stand."""
    seen: list[Seen]
    gains: list[Gain]
    place: Place | None
    place_station: tuple[float, float] | None
    """Station and offset of the place."""
    postures_tried: int
    """On which changes were tried."""
    shift: Prediction
    """Over the work."""

    @property
    def sigma_h(self) -> float:
        """Median over the stations that are seen, m."""
        sigma = self.line.sigma_h[np.isfinite(self.line.sigma_h)]
        return float(np.median(sigma)) if len(sigma) else float("nan")


def plan(
    setup: Setup,
    arm: Arm,
    trench: Trench,
    habits: Habits,
    half_tolerance_m: float,
    coverage_factor: float,
    points: int = 100,
    search: bool = True,
) -> Plan:
    """The whole plan of a job.

    Parameters
    ----------
    setup : Setup
        The machine on its site.
    arm : Arm
        Of the postures.
    trench : Trench
        Stations in order.
    habits : Habits
        How it works.
    half_tolerance_m, coverage_factor : float
        Of the job; U = coverage_factor sigma is held against half the tolerance.
    points : int
        Along each side of a map.
    search : bool
        Whether to try changes and places.

    Raises
    ------
    PlanningError
        The trench is out of the arm's reach.
    NetworkError
        The edge is tied to nothing surveyed anywhere.
    """
    net = setup.network
    postures, within, station = along_trench(net, arm, trench, habits)
    if not within.any():
        raise PlanningError(
            f"the floor of the trench is out of reach everywhere, {habits.reach_m:.1f} m in front of the machine; give "
            "another --reach, or the lengths of the arm with --boom and --boom-foot"
        )
    work, station = postures.take(within), station[within]
    shift = predict(setup, work)
    line = _line(shift, station, trench, half_tolerance_m / coverage_factor)
    seen = np.flatnonzero(np.isfinite(line.sigma_h))
    stand_station = float(trench.station[seen[len(seen) // 2] if len(seen) else len(trench.station) // 2])
    T_stand, depth = stand_at(trench, stand_station, habits)
    few = work.take(np.unique(np.linspace(0, len(work) - 1, min(len(work), 40)).astype(int)))
    place, where = _place(setup, few, trench) if search else (None, None)
    return Plan(
        setup,
        arm,
        habits,
        half_tolerance_m,
        coverage_factor,
        line,
        shift.edge,
        stand_station,
        _arm_map(setup, arm, T_stand, depth, habits, shift, points),
        _plan_map(setup, arm, T_stand, depth, habits, shift, points),
        _seen(shift),
        gains(setup, few) if search else [],
        place,
        where,
        len(few),
        shift,
    )


def at_posture(
    plan: Plan,
    trench: Trench,
    directions_deg: tuple[float, float, float] | None,
    reach_depth_m: tuple[float, float],
) -> EdgePlan:
    """The edge in one posture at the plan's stand.

    Given are the directions of boom, stick and pin-to-edge above the horizontal; without them the reach of the edge and
    its depth below the tracks.

    Raises
    ------
    PlanningError
        Out of reach.
    """
    net, rate = plan.setup.network, np.deg2rad(plan.habits.bucket_deg_s)
    T_stand, _ = stand_at(trench, plan.stand_station, plan.habits)
    if directions_deg is not None:
        boom, stick, bucket = np.deg2rad(directions_deg)[:, None]
        posture = postures_from(net, plan.arm, T_stand[None], boom, stick, bucket, rate)
    else:
        reach, depth = reach_depth_m
        posture, within = in_the_arms_plane(net, plan.arm, T_stand, [reach], [-depth], plan.habits)
        if not within[0]:
            raise PlanningError(
                f"the arm does not reach {reach:g} m forward and {depth:g} m down; name a nearer place"
            )
    return predict_elsewhere(plan.setup, posture, plan.shift).edge


def _line(shift: Prediction, station, trench: Trench, most_m: float) -> Line:
    out = np.full((3, len(trench.station)), np.nan)
    for k in np.unique(station):
        here = (station == k) & np.isfinite(shift.edge.sigma_h())
        if here.sum() * 2 >= PASSES:  # a sweep that is mostly unseen tells nothing of the floor
            out[:, k] = [np.median(shift.edge.sigma_h(part)[here]) for part in ("total", "own", "common")]
    with np.errstate(invalid="ignore"):
        return Line(trench.station, out[0], out[1], out[2], out[0] <= most_m)


def _seen(shift: Prediction) -> list[Seen]:
    net, sight = shift.found.network, shift.sight
    out = []
    for c, camera in enumerate(net.cameras):
        for k, marker in enumerate(net.markers):
            tags = np.flatnonzero(net.tag_marker == k)
            seen = sight.seen[:, c, tags]
            if marker.body == camera.body or not len(tags):
                continue
            any_seen = seen.any(axis=1)
            missed = sight.reason[:, c, tags][~seen]
            why = REASONS[np.bincount(missed, minlength=len(REASONS)).argmax()] if len(missed) else ""
            sides = sight.side_px[:, c, tags][seen]
            out.append(
                Seen(
                    camera.name,
                    marker.name,
                    float(any_seen.mean()),
                    float(seen.sum(axis=1)[any_seen].mean()) if any_seen.any() else 0.0,
                    float(np.median(sides)) if len(sides) else float("nan"),
                    why if why != REASONS[SEEN] else "",
                )
            )
    return out


def _filled(within, values):
    out = np.full((len(within), *values.shape[1:]), np.nan)
    out[within] = values
    return out


def _map(setup: Setup, shift: Prediction, laid_out, x, y, axes) -> Map:
    """``axes`` (2, 3): the map's x and y in the world."""
    postures, within = laid_out
    shape = (len(y), len(x))
    if not within.any():
        return Map(x, y, np.full(shape, np.nan), [])
    edge = predict_elsewhere(setup, postures.take(within), shift).edge
    sigma = _filled(within, edge.sigma_h()).reshape(shape)
    cov = _filled(within, axes @ edge.total @ axes.T).reshape(*shape, 2, 2)
    rows, columns = (np.linspace(0, n - 1, ELLIPSES + 2).astype(int)[1:-1] for n in shape)
    ellipses = [
        (float(x[j]), float(y[i]), cov[i, j]) for i in rows for j in columns if np.isfinite(sigma[i, j])
    ]
    return Map(x, y, sigma, ellipses)


def _arm_map(setup, arm: Arm, T_stand, depth: float, habits: Habits, shift, points: int) -> Map:
    furthest = arm.foot_x + arm.boom + arm.stick + 1.0
    x, y = np.linspace(2.0, furthest, points), np.linspace(min(depth, 0.0) - 1.0, 3.0, points)
    laid_out = in_the_arms_plane(setup.network, arm, T_stand, x, y, habits)
    return _map(setup, shift, laid_out, x, y, T_stand[:3, [0, 2]].T)


def _plan_map(setup, arm: Arm, T_stand, depth: float, habits: Habits, shift, points: int) -> Map:
    furthest = arm.foot_x + arm.boom + arm.stick + 1.0
    x, y = np.linspace(0.0, furthest, points), np.linspace(-furthest, furthest, points)
    laid_out = around(setup.network, arm, T_stand, x, y, depth, habits)
    return _map(setup, shift, laid_out, x, y, T_stand[:3, [0, 1]].T)


def _place(setup: Setup, work: Postures, trench: Trench):
    like = largest_benchmark(setup.network)
    if like is None:
        return None, None
    marks = [setup.network.statics[m.mount].value[2, 3] for m in setup.network.markers if m.benchmark]
    height = float(np.median(marks))
    places, names = [], []
    spread = np.linspace(3.0, 10.0, CANDIDATES[1] // 2)
    first, last = trench.station[0] - 8.0, trench.station[-1] + 8.0
    for station in np.linspace(first, last, CANDIDATES[0]):
        k = int(np.argmin(np.abs(trench.station - station)))
        beyond = (station - trench.station[k]) * trench.forward[k]
        left = np.array([-trench.forward[k][1], trench.forward[k][0]])
        for offset in np.concatenate([-spread, spread]):
            xy = trench.floor[k, :2] + beyond + offset * left
            places.append([*xy, height])
            names.append((float(station), float(offset)))
    best, found = best_place(setup, work, np.array(places), like)
    return best, names[found.index(best)]
