"""The whole least-squares problem of one log: its measurements, sorted, and what each of them costs.

Variables that share an observation form one chain; chains are independent of each other given the statics, and so
separate, smaller block-tridiagonal systems: two of 12 cost a quarter of one of 24.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.estimation import motion
from pipeline.estimation.repeated import WHITE, Repeated, information_share, offset_name, rests
from pipeline.estimation.residuals import Corners, SensorReadings, measured_sigma
from pipeline.estimation.values import Statics, Values
from pipeline.geometry import so3
from pipeline.network import frames as fr
from pipeline.network.datum import Tie
from pipeline.network.epochs import Epochs
from pipeline.network.model import Network

FIRST_POSE = np.array([100.0] * 3 + [np.pi] * 3)
FIRST_RATE = np.array([3.0] * 3 + [1.5] * 3)
"""Prior sigmas of the first epoch's state about its start (m, rad) and about rest (m/s, rad/s), as every machine
obeys. It holds what a log of one frame leaves free, and is worth nothing against a second frame."""
LOST = 1e3
"""Whitened length that a corner behind its camera, or a reading out of the linkage's reach, counts with."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything that does not change between iterations."""

    network: Network
    tie: Tie
    epochs: Epochs
    statics: Statics
    corners: tuple[Corners, ...]
    sensors: tuple[SensorReadings, ...]
    chains: tuple[tuple[int, ...], ...]
    """Variables of each chain, in the order of its state block."""
    first: Values
    """The start, about which the first epoch's weak prior stands."""
    dt_s: np.ndarray
    """(E - 1,)."""
    densities: tuple[np.ndarray, ...]
    """Per variable: (E - 1, h, 2) spectral densities between its epochs, of ``motion.density_of``."""

    opens: bool = True
    """Whether it begins where the log begins: there the first epoch's weak prior and those of the statics count."""

    def place(self, variable: int) -> tuple[int, slice]:
        """The chain of a variable, and where its state stands in the chain's block."""
        for c, members in enumerate(self.chains):
            at = 0
            for v in members:
                size = self.tie.variables[v].size
                if v == variable:
                    return c, slice(at, at + size)
                at += size
        raise KeyError(variable)

    def chain_size(self, chain: int) -> int:
        return sum(self.tie.variables[v].size for v in self.chains[chain])


@dataclass(frozen=True, eq=False)
class Weights:
    """How much each measurement counts."""

    huber: float
    """Whitened length beyond which the loss grows linearly."""
    corners: tuple[np.ndarray, ...]
    """Per group: (n, 4) bool, False where the corner is a gross outlier."""
    sensors: tuple[np.ndarray, ...]
    """Per sensor: (n, 1) bool."""


def problem_of(
    network: Network, tie: Tie, epochs: Epochs, statics: Statics, first: Values, repeated: Repeated = WHITE
) -> Problem:
    """Sort the observations into groups of one path each, and the variables into chains.

    Where corners have constant errors of their own, a group is one tag in one camera; else one marker in one camera.
    """
    seen = epochs.observations
    marker_of = network.tag_marker[seen.tag]
    named = {s.name: k for k, s in enumerate(network.statics)}
    share = information_share(rests(seen), repeated)
    corners = []
    for c, camera in enumerate(network.cameras):
        of_camera = np.flatnonzero(seen.camera == c)
        offsets = [named.get(offset_name(network, c, t)) for t in range(len(network.tag_marker))]
        kind = np.array([len(offsets) + m if o is None else t
                         for t, (o, m) in enumerate(zip(offsets, network.tag_marker, strict=True))])  # fmt: skip
        for key in np.unique(kind[seen.tag[of_camera]]):
            rows = of_camera[kind[seen.tag[of_camera]] == key]
            m = int(marker_of[rows[0]])
            marker = network.markers[m]
            rows = rows[np.argsort(epochs.epoch[rows], kind="stable")]
            path = tie.frames.path(fr.camera_frame(camera.name), fr.marker_frame(marker.name))
            corners.append(
                Corners(
                    c,
                    m,
                    path,
                    camera.intrinsics,
                    rows,
                    epochs.epoch[rows],
                    network.tag_corners[seen.tag[rows]],
                    seen.uv[rows],
                    np.linalg.inv(np.linalg.cholesky(seen.cov[rows])),
                    share[rows],
                    None if key >= len(offsets) else offsets[key],
                )
            )
    sensors = []
    for s, data in sorted(epochs.sensors.items()):
        sensor = network.sensors[s]
        at = [k for k, v in enumerate(tie.variables) if v.kind == "joint" and v.body == sensor.joint]
        if not at:
            continue
        order = np.argsort(data.epoch, kind="stable")
        sigma = measured_sigma(sensor, statics.base[sensor.curve], data.raw)
        sensors.append(
            SensorReadings(sensor, at[0], data.epoch[order], data.dt_s[order], data.raw[order], sigma[order])
        )
    return Problem(
        network,
        tie,
        epochs,
        statics,
        tuple(corners),
        tuple(sensors),
        _chains(len(tie.variables), corners),
        first,
        np.diff(epochs.time_s),
        tuple(
            np.tile(motion.density_of(v.kind, v.motion), (len(epochs.time_ns) - 1, 1, 1))
            for v in tie.variables
        ),
    )


def _chains(count: int, corners) -> tuple[tuple[int, ...], ...]:
    leader = list(range(count))

    def find(k):
        while leader[k] != k:
            k = leader[k]
        return k

    for group in corners:
        met = [step.edge.index for step in group.path if step.edge.kind != "static"]
        for k in met[1:]:
            leader[find(k)] = find(met[0])
    return tuple(
        tuple(k for k in range(count) if find(k) == root) for root in range(count) if find(root) == root
    )


def unchecked_statics(problem: Problem) -> np.ndarray:
    """Unknowns of sensors that nothing else in the log checks: their joint is read by one sensor and seen by no camera.

    Nothing measured speaks of them, yet the motion prior does: less motion costs it less, so it shrinks the gain of the
    curve, by 1.9 sigma on a log of 3,600 readings (the more readings, the further). They stay at the file's
    values; in the covariance pass they are unknowns with their prior like all others, so it goes into the common part.

    Returns
    -------
    (r,) int array
        Their places in ``z``.
    """
    seen = {s.edge.index for g in problem.corners for s in g.path if s.edge.kind == "joint"}
    read = [readings.variable for readings in problem.sensors]
    held: set[int] = set()
    for readings in problem.sensors:
        if readings.variable in seen or read.count(readings.variable) > 1:
            continue
        sensor = readings.sensor
        held.update(
            {sensor.curve, sensor.offset} | ({sensor.linkage} if sensor.linkage is not None else set())
        )
    parts = [problem.statics.columns[k] for k in sorted(held)]
    return np.concatenate(parts) if parts else np.array([], dtype=np.int64)


def keep_all(problem: Problem, huber: float) -> Weights:
    return Weights(
        huber,
        tuple(np.ones((len(g.epoch), 4), dtype=bool) for g in problem.corners),
        tuple(np.ones((len(s.epoch), 1), dtype=bool) for s in problem.sensors),
    )


def huber(length, k: float, alive):
    """Weight and cost of whitened residuals of the given length.

    Huber's loss, by re-weighting: weight ``min(1, k / length)``, cost ``length²/2`` below k and linear beyond.

    Parameters
    ----------
    length : (...,) array
        nan counts as lost: no weight, a large cost.
    k : float
        The length beyond which the loss grows linearly.
    alive : (...,) bool array
        Where False: neither weight nor cost.

    Returns
    -------
    weight, cost : (...,) arrays
    """
    lost = np.isnan(length)
    length = np.where(lost, LOST, length)
    weight = np.where(alive & ~lost, k / np.maximum(length, k), 0.0)
    cost = np.where(length <= k, 0.5 * length**2, k * (length - 0.5 * k))
    return weight, np.where(alive, cost, 0.0)


def lengths(r, group: int):
    """Lengths of the whitened residuals of each corner (group = 2) or reading (group = 1): (n, m / group)."""
    return np.linalg.norm(r.reshape(len(r), r.shape[1] // group, group), axis=-1)  # -1 fails on no rows


def motion_residual(problem: Problem, values: Values, k: int, jacobians=True):
    """Whitened motion residuals of one variable (E - 1, 2h), and their Jacobians by both states."""
    variable = problem.tie.variables[k]
    T, w, dt = values.pose[k], values.rate[k], problem.dt_s
    residual = motion.pose_residual if variable.kind == "moving" else motion.angle_residual
    e, J_1, J_2 = residual(T[:-1], w[:-1], T[1:], w[1:], dt, jacobians)
    W = motion.whitening(dt, problem.densities[k])
    if not jacobians:
        return motion.whiten(e, W), None, None
    return motion.whiten(e, W), motion.whiten(J_1, W), motion.whiten(J_2, W)


def first_residual(problem: Problem, values: Values, k: int):
    """Weak prior of the first epoch's state: residual and Jacobian."""
    T, T_start, w = values.pose[k][0], problem.first.pose[k][0], values.rate[k][0]
    if problem.tie.variables[k].kind == "joint":
        sigma = np.array([FIRST_POSE[-1], FIRST_RATE[-1]])
        return np.array([T - T_start, w]) / sigma, np.diag(1 / sigma)
    # In translation and rotation apart: the logarithm of a pose has a seam at pi, a chord has none.
    sigma = np.concatenate([FIRST_POSE, FIRST_RATE])
    R_t = T_start[:3, :3].T
    turned = so3.log(R_t @ T[:3, :3])
    e = np.concatenate([R_t @ (T[:3, 3] - T_start[:3, 3]), turned, w])
    J = np.eye(12)
    J[:3, :3] = R_t @ T[:3, :3]
    J[3:6, 3:6] = so3.Jr_inv(turned)
    return e / sigma, J / sigma[:, None]
