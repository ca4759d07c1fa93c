"""The differences of all check shots as one vector with its covariance, and how each cause would show in it.

A shot of the floor gives one component, its elevation; a shot of the parked edge gives three, or two where only the
nearest place on the edge was compared (nothing is said along it). The covariance has three parts:

* the total station's, independent from shot to shot;
* our own part, correlated between shots like ``exp(-|t_i - t_j| / tau)``: two shots of one sweep share most of it;
* our common part, ``F F'`` with the factors that the adjustment publishes (`estimation.sensitivities`), what these
  leave out being added to the own part. Without them it is taken as one fully shared error along each axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.estimation.sensitivities import BENCHMARK, CLOCK, COMMON, SENSOR, WEAR, Sensitivities
from pipeline.surface.alignment import Alignment
from pipeline.surface.checks import COMPARED, Comparison
from pipeline.surface.shots import Shots
from pipeline.tracks.poses import CuttingEdge

DATUM = "datum"
MOST = {WEAR: 0.2, DATUM: 1.0, SENSOR + " m": 0.1, SENSOR + " deg": 10.0, CLOCK: 0.5, BENCHMARK: 0.5}
"""Values larger than this explain nothing: metres, degrees, seconds. A benchmark that hardly tells on the edge could
otherwise explain everything by having moved ten metres."""
TAU_S = 0.5
"""Correlation time of the own part where the adjustment gives none: that of a sweep."""


@dataclass(frozen=True)
class Cause:
    """One value that could be wrong."""

    kind: str
    """wear, sensor, time offset, benchmark or datum."""
    name: str
    """Of the sensor or the benchmark."""
    component: str
    """e, n or h of a benchmark or of the datum."""
    unit: str
    """m, deg or s."""

    @property
    def most(self) -> float:
        """Values larger than this are no explanation."""
        return MOST.get(f"{self.kind} {self.unit}", MOST.get(self.kind, np.inf))

    @property
    def what(self) -> tuple[str, str]:
        """Components of one benchmark are one cause."""
        return self.kind, self.name


@dataclass(frozen=True)
class Differences:
    """What was compared, component by component."""

    shot: np.ndarray
    """(m,) index of the shot."""
    axis: np.ndarray
    """(m, 3) the component is this combination of errors along easting, northing, elevation."""
    value: np.ndarray
    """(m,) ours minus total station, metres."""
    covariance: np.ndarray
    """(m, m), m²."""
    common: np.ndarray
    """(m, r) factors of our common part, metres."""
    causes: tuple[Cause, ...]
    signature: np.ndarray
    """(m, c) difference per unit by which the true value exceeds that of the files. Datum: how much too high (east,
    north) the job's grid stands against that of the shots."""


def differences_of(
    shots: Shots,
    comparison: Comparison,
    alignment: Alignment,
    edge: CuttingEdge,
    answer: Sensitivities | None,
    tau_s: float | None,
) -> Differences:
    """Every compared component, its covariance with all others, and the signatures of the causes.

    Parameters
    ----------
    shots, comparison : Shots, Comparison
        Those with the result `compared` count.
    alignment : Alignment
        Of the gradients of the floor.
    edge : CuttingEdge
        The whole log.
    answer : Sensitivities, optional
        Of the adjustment; without them the datum is the only cause.
    tau_s : float, optional
        Correlation time of the own part.
    """
    shot: list[int] = []
    axis: list[np.ndarray] = []
    for i in np.flatnonzero(comparison.result == COMPARED):
        for u in _axes(shots, comparison, alignment, int(i)):
            shot.append(int(i))
            axis.append(u)
    at, u = np.array(shot, np.int64), np.array(axis).reshape(-1, 3)
    floor = shots.kind[at] == "floor"
    away = np.column_stack([comparison.difference_e, comparison.difference_n, comparison.difference])[at]
    value = np.where(floor, away[:, 2], np.einsum("mj,mj->m", u, np.nan_to_num(away)))
    when = comparison.time_ns[at]
    place = shots.p_grid[at] + np.nan_to_num(away)
    moved = None if answer is None else response_at(answer, edge, when, place)
    # Of a floor the sigma is that of its elevation already: a gradient's part of it is in there.
    e_h = np.array([0.0, 0.0, 1.0])
    heading = np.where(floor[:, None], e_h, u)
    root_own = _root(comparison.own[at])
    w = np.einsum("mij,mj->mi", root_own, heading)
    lag_s = np.abs(when[:, None] - when[None, :]) * 1e-9
    covariance = (w @ w.T) * np.exp(-lag_s / (tau_s or TAU_S))
    whole = np.einsum("mi,mij,mj->m", heading, comparison.common[at], heading)
    if answer is None or moved is None:
        common = np.einsum("mij,mj->mi", _root(comparison.common[at]), heading)
    else:
        factors = [k for k, s in enumerate(answer.sources) if s.kind == COMMON]
        common = np.einsum("mj,mrj->mr", u, moved[:, factors])
    covariance += common @ common.T
    left_out = np.maximum(whole - np.einsum("mr,mr->m", common, common), 0.0)
    covariance += _of_known_points(shots, at, u, comparison.sigma_ts[at])
    covariance[np.diag_indices(len(at))] += left_out + comparison.sigma_ts[at] ** 2
    causes = causes_of(answer, in_plan=not np.all(floor))
    return Differences(
        at, u, value, covariance, common, causes, signature_of(causes, answer, moved, u, heading)
    )


def _of_known_points(shots: Shots, at: np.ndarray, u: np.ndarray, sigma_ts: np.ndarray) -> np.ndarray:
    """(m, m) what visits of one known point share: its own survey, wrong in every visit alike; 0 on the diagonal."""
    known = shots.kind[at] == "control"
    same = known[:, None] & known[None, :] & (shots.point[at][:, None] == shots.point[at][None, :])
    shared = np.where(same, np.outer(sigma_ts, sigma_ts) * (u @ u.T), 0.0)
    np.fill_diagonal(shared, 0.0)
    return shared


def causes_of(answer: Sensitivities | None, in_plan: bool) -> tuple[Cause, ...]:
    """Every cause that can show: those of the files, and the datum in elevation and, with shots in plan, in plan."""
    sources = () if answer is None else tuple(answer.sources[k] for k in answer.causes)
    causes = [Cause(s.kind, s.name, s.component, s.unit) for s in sources]
    return (*causes, *(Cause(DATUM, "", axis, "m") for axis in ("enh" if in_plan else "h")))


def signature_of(
    causes: tuple[Cause, ...],
    answer: Sensitivities | None,
    moved: np.ndarray | None,
    axis: np.ndarray,
    heading: np.ndarray,
) -> np.ndarray:
    """(m, c) difference per unit of each cause.

    Parameters
    ----------
    causes : tuple of Cause
        Of `causes_of` with this answer.
    answer, moved : Sensitivities, (m, sources, 3) array
        Of `response_at`; None without.
    axis, heading : (m, 3) arrays
        What is compared of errors that differ from place to place, and of one that is the same everywhere.
    """
    columns = []
    if answer is not None and moved is not None:
        # Were the file's value larger by as much as the true one is, ours would move, and the difference go.
        columns = list(-np.einsum("mj,mkj->mk", axis, moved[:, answer.causes]).T)
    columns += [heading[:, "enh".index(c.component)] for c in causes if c.kind == DATUM]
    return np.column_stack(columns)


def response_at(
    answer: Sensitivities, edge: CuttingEdge, time_ns: np.ndarray, p_grid: np.ndarray
) -> np.ndarray:
    """(m, sources, 3) shift along easting, northing, elevation of points of the edge, per unit of each source.

    Parameters
    ----------
    answer : Sensitivities
        Straight lines between its epochs.
    edge : CuttingEdge
        For its middle, about which the turns are.
    time_ns : (m,) int64 array
        When.
    p_grid : (m, 3) array
        Where, grid metres.
    """
    before, share = between(answer.time_ns, time_ns)
    after = np.minimum(before + 1, len(answer.time_ns) - 1)
    s = share[:, None, None]
    moved = (1.0 - s) * answer.response[before] + s * answer.response[after]
    before, share = between(edge.time_ns, time_ns)
    after = np.minimum(before + 1, len(edge) - 1)
    middle = (1.0 - share[:, None]) * edge.p_grid[before, 1] + share[:, None] * edge.p_grid[after, 1]
    lever = (p_grid - middle)[:, None, :]
    return moved[..., :3] + np.cross(moved[..., 3:], np.broadcast_to(lever, moved[..., 3:].shape))


def _axes(shots: Shots, comparison: Comparison, alignment: Alignment, i: int) -> list[np.ndarray]:
    """Components of one shot's difference."""
    if shots.kind[i] == "floor":
        step = 0.01
        stations = np.clip(
            comparison.station[i] + np.array([-step, step]), alignment.start_station, alignment.end_station
        )
        ends = alignment.points(stations, np.zeros(2))
        along = (ends[1] - ends[0]) / max(float(np.linalg.norm(ends[1] - ends[0])), 1e-12)
        right = np.array([along[1], -along[0]])
        rise = comparison.gradient[i, 0] * along + comparison.gradient[i, 1] * right
        # A floor with a gradient that is shifted sideways stands higher or lower under the shot.
        return [np.array([-rise[0], -rise[1], 1.0])]
    up = np.array([0.0, 0.0, 1.0])
    along_en = comparison.along_en[i]
    if np.all(np.isfinite(along_en)):
        return [np.array([along_en[1], -along_en[0], 0.0]), up]
    return [np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), up]


def between(times: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The entry before each time (of ascending ones) and the share of the way to the next one, held at both ends."""
    k = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, max(len(times) - 2, 0))
    if len(times) < 2:
        return k, np.zeros(len(wanted))
    return k, np.clip((wanted - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)


def _root(covariance: np.ndarray) -> np.ndarray:
    """(n, 3, 3) symmetric square roots."""
    values, vectors = np.linalg.eigh(covariance)
    return np.einsum("nij,nj,nkj->nik", vectors, np.sqrt(np.maximum(values, 0.0)), vectors)
