"""How the published cutting edge moves if one value of the files were another, and its common error as few factors.

The statics' unknowns have the prior ``z ~ N(0, I)``. Were the file's value another one, so that the prior's mean moved
by ``dz0``, the adjustment would answer with ``dz = S^-1 dz0``, and the edge with ``M S^-1 dz0`` (`marginals`): what the
log itself says of the value is in ``S``, and a benchmark that two others hold against pulls the less. An exact value
(sigma 0) has no unknown and no such response. Worn teeth shorten the edge along its own z whatever the log says.

The common error of two instants k and l has the covariance ``M_k S^-1 M_l'``. ``M S^-1/2`` has a column per unknown, a
hundred and more; nearly all of it is in the plane of a dozen of their combinations. These are found while the log goes
by: what a part of the log does not share with the plane so far, if it is more than a thousandth, widens the plane.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.estimation.marginals import BodyTrack, Marginals
from pipeline.estimation.problem import Problem

STEP_S = 0.2
"""One epoch in so many seconds is kept. The edge turns by a few degrees in that time, and what lies between follows
by a straight line to a few in a thousand."""
LEFT_OUT = 1e-3
"""Share of the common variance of a part of the log that may stay outside the plane; the reader counts it as own."""
MOST_FACTORS = 40
WEAR, SENSOR, CLOCK, BENCHMARK, COMMON = "wear", "sensor", "time offset", "benchmark", "common"
BUDGET = "budget"
"""Not a value that may be wrong, but how much of the common error in elevation comes from one group of them."""


@dataclass(frozen=True)
class Source:
    """One value of the files, or one factor of the common error."""

    kind: str
    """wear, sensor, time offset, benchmark, common, or budget."""
    name: str
    """Of the sensor or the benchmark; the number of the factor; the group of the error budget."""
    component: str
    """Easting, northing or elevation of a benchmark: e, n, h."""
    unit: str
    """Of the value: m, deg or s; of a factor or a part of the budget: sigma."""


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """The cutting edge's response at some epochs, dense enough for straight lines between them."""

    time_ns: np.ndarray
    """(n,) int64, ascending."""
    sources: tuple[Source, ...]
    response: np.ndarray
    """(n, len(sources), 6) float32: shift of the edge's middle along e n h, and turn about these axes; metres and
    radians per unit of the source. Of a factor: per standard deviation; they are independent. Of a part of the budget:
    its standard deviation of the elevation, and nothing else."""

    @property
    def causes(self) -> list[int]:
        """Sources that are values of the files."""
        return [k for k, s in enumerate(self.sources) if s.kind not in (COMMON, BUDGET)]

    def portions(self, epochs: int) -> Iterator[Sensitivities]:
        """So many epochs at a time."""
        for start in range(0, len(self.time_ns), epochs):
            rows = slice(start, start + epochs)
            yield Sensitivities(self.time_ns[rows], self.sources, self.response[rows])


class Gathered:
    """Sensitivities, gathered from the last part of the log to the first."""

    def __init__(self, problem: Problem, width_m: float):
        self.problem = problem
        self.sources, self.moves = _sources(problem)
        self.lever = 0.5 * width_m
        self.budgets: list[np.ndarray] = []
        self.groups: tuple[str, ...] = ()
        self.plane: np.ndarray | None = None
        self.time_ns: list[np.ndarray] = []
        self.causes: list[np.ndarray] = []
        self.factors: list[np.ndarray] = []

    def add(
        self,
        track: BodyTrack,
        found: Marginals,
        start: int,
        rows: np.ndarray,
        variances: dict[str, np.ndarray],
    ) -> None:
        """A part's track of the tool and its marginals; ``rows`` of it are published, ``start`` is its first epoch.

        ``variances`` are those of ``marginals.vertical_budget`` at these rows.
        """
        time_s = self.problem.epochs.time_s
        bins = np.floor(time_s / STEP_S).astype(np.int64)
        kept = (start + rows == 0) | (bins[start + rows] != bins[np.maximum(start + rows - 1, 0)])
        rows = rows[kept]
        if len(rows) == 0:
            return
        self.groups = tuple(name for name in variances if name != "own")
        budget = np.zeros((len(rows), len(self.groups), 6), np.float32)
        budget[:, :, 2] = np.sqrt(np.stack([variances[name][kept] for name in self.groups], axis=1))
        self.budgets.append(budget)
        R = track.T_world_body[rows, :3, :3]
        M = track.M[rows]
        M = np.concatenate([R @ M[:, :3], R @ M[:, 3:]], axis=1)
        wear = np.zeros((len(rows), 1, 6))
        wear[:, 0, :3] = -R[:, :, 2]
        causes = np.swapaxes(M @ (found.P_zz @ self.moves), 1, 2)
        self.time_ns.append(self.problem.epochs.time_ns[start + rows])
        self.causes.append(np.concatenate([wear, causes], axis=1).astype(np.float32))
        root = np.linalg.cholesky(found.P_zz + 1e-15 * np.eye(len(found.P_zz)))
        L = M @ root
        self._widen(L, R)
        assert self.plane is not None
        self.factors.append(np.swapaxes(L @ self.plane, 1, 2).astype(np.float32))

    def _widen(self, L: np.ndarray, R: np.ndarray) -> None:
        """Directions that this part needs and the plane has not: L (n, 6, p) is the response to independent errors."""
        along = R[:, :, 0] * self.lever
        ends = [L[:, :3]]
        for side in (-1.0, 1.0):
            ends.append(L[:, :3] + np.cross(L[:, 3:], side * along[:, :, None], axis=1))
        flat = np.concatenate(ends, axis=1).reshape(9 * len(L), L.shape[2])
        gram = flat.T @ flat
        whole = float(np.trace(gram))
        plane = np.zeros((L.shape[2], 0)) if self.plane is None else self.plane
        across = np.eye(len(gram)) - plane @ plane.T
        values, vectors = np.linalg.eigh(across @ gram @ across)
        left = np.cumsum(np.maximum(values, 0.0))
        wanted = vectors[:, left > LEFT_OUT * whole][:, ::-1][:, : MOST_FACTORS - plane.shape[1]]
        # Orthogonal to what is there but for rounding; what is there stays as it is.
        wanted = np.linalg.qr(across @ wanted)[0] if wanted.shape[1] else wanted
        self.plane = np.concatenate([plane, wanted], axis=1)

    def told(self) -> Sensitivities | None:
        """All of them in the order of time; None where nothing was published."""
        if not self.time_ns:
            return None
        assert self.plane is not None
        count = self.plane.shape[1]
        factors = [np.pad(f, ((0, 0), (0, count - f.shape[1]), (0, 0))) for f in self.factors[::-1]]
        budgets = self.budgets[::-1]
        # Where the files are exact there is nothing to share out.
        some = any(bool(part.any()) for part in budgets)
        groups = self.groups if some else ()
        names = tuple(Source(COMMON, str(i + 1), "", "sigma") for i in range(count))
        return Sensitivities(
            np.concatenate(self.time_ns[::-1]),
            (
                Source(WEAR, "", "", "m"),
                *self.sources,
                *names,
                *(Source(BUDGET, name, "h", "sigma") for name in groups),
            ),
            np.concatenate(
                [
                    np.concatenate(self.causes[::-1]),
                    np.concatenate(factors),
                    np.concatenate(budgets)[:, : len(groups)],
                ],
                axis=1,
            ),
        )


def _sources(problem: Problem) -> tuple[tuple[Source, ...], np.ndarray]:
    """Values of the files that may be wrong, and (p, c) by how much each moves the prior's mean, per unit."""
    statics, network = problem.statics, problem.network
    sources, moves = [], []

    def add(source: Source, static: int, change: np.ndarray) -> None:
        scale = statics.scale[static]
        if scale.shape[1] == 0:
            return
        dz = np.linalg.lstsq(scale, change, rcond=None)[0]
        if np.linalg.norm(scale @ dz - change) > 1e-6 * np.linalg.norm(change):
            return  # this component is exact
        move = np.zeros(statics.size)
        move[statics.columns[static]] = dz
        sources.append(source)
        moves.append(move)

    for sensor in network.sensors:
        unit = "m" if sensor.output == "cylinder_m" else "deg"
        first = np.eye(len(network.statics[sensor.curve].value))[0]
        add(Source(SENSOR, sensor.name, "", unit), sensor.curve, first)
        clock = np.eye(len(network.statics[sensor.offset].value))[0]
        add(Source(CLOCK, sensor.name, "", "s"), sensor.offset, clock)
    for marker in network.markers:
        static = network.statics[marker.mount]
        if not marker.benchmark or not static.surveyed:
            continue
        for axis, name in enumerate("enh"):
            change = np.concatenate(
                [static.value[axis, :3], np.zeros(3)]
            )  # a shift in the world, felt in the marker
            add(Source(BENCHMARK, marker.name, name, "m"), marker.mount, change)
    return tuple(sources), np.stack(moves, axis=1) if moves else np.zeros((statics.size, 0))
