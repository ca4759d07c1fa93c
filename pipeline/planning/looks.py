"""The normal matrix of the adjustment without observations: what looks at postures tell of states and statics.

Frames, unknowns and Jacobians are the adjustment's own (``network.datum.tie``, ``estimation.residuals``); only the
pictures are those that the postures would give. So whatever the adjustment can be told, planning knows of.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pipeline.estimation.problem import FIRST_POSE
from pipeline.estimation.repeated import WHITE, Repeated, offset_name, with_offsets
from pipeline.estimation.residuals import (
    Corners,
    Jacobians,
    SensorReadings,
    corner_residuals,
    measured_sigma,
    sensor_residuals,
)
from pipeline.estimation.values import Statics, Values, statics_of
from pipeline.geometry import linkage, se3
from pipeline.network import frames as fr
from pipeline.network.datum import Tie, tie
from pipeline.network.model import Network, Observations, Readings, Sensor
from pipeline.network.start import Start
from pipeline.planning.postures import Postures, surveyed, world_poses
from pipeline.planning.sight import CornerNoise, Sight


@dataclass(frozen=True)
class Looking:
    """How often is looked, and how well."""

    frame_s: float = 0.2
    """Between the looks of one camera."""
    readings_per_look: float = 4.0
    """Of a joint's sensor, between two frames."""
    repeated: Repeated = WHITE
    noise: CornerNoise = field(default_factory=CornerNoise)


@dataclass(frozen=True, eq=False)
class Looks:
    """Information of one look at each of n postures, with b unknowns of the state and p of the statics."""

    network: Network
    """With the constant errors of corners among its statics."""
    tie: Tie
    statics: Statics
    values: Values
    at: tuple[slice, ...]
    """Per variable: where its pose or angle stands in the state."""
    chains: tuple[tuple[int, ...], ...]
    """Variables that share a picture."""
    H_xx: np.ndarray
    """(n, b, b), with a prior of 100 m and half a turn, which holds what is not seen."""
    H_xz: np.ndarray
    """(n, b, p)."""
    seen: np.ndarray
    """(n,) bool: everything that the tool hangs on is seen."""
    observations: Observations
    """The pictures of tags."""
    groups: tuple[tuple[np.ndarray, Jacobians], ...]
    """Rows, and the whitened Jacobians of what was measured there, times the root of how much it counts."""

    def statics_information(self, weight=1.0) -> np.ndarray:
        """``S = I + sum_k w_k (H_zz,k - H_zx,k H_xx,k^-1 H_xz,k)``, the statics' after these looks; (p, p).

        ``weight`` (n,) counts each posture that often; eq. (3) with the states eliminated.
        """
        p = self.statics.size
        n = len(self.H_xx)
        weight = np.broadcast_to(np.asarray(weight, float), n)
        S = np.eye(p)
        for rows, J in self.groups:
            w = weight[rows][:, None, None]
            for s, A in J.statics.items():
                for t, B in J.statics.items():
                    block = np.tensordot(A * w, B, axes=([0, 1], [0, 1]))
                    S[np.ix_(self.statics.columns[s], self.statics.columns[t])] += block
        root = np.sqrt(weight)[:, None, None]
        for k in range(0, n, 1000):
            part = slice(k, k + 1000)
            L = np.linalg.cholesky(self.H_xx[part])
            W = np.linalg.solve(L, self.H_xz[part] * root[part])
            S -= np.tensordot(W, W, axes=([0, 1], [0, 1]))
        return 0.5 * (S + S.T)


def looks(
    network: Network,
    postures: Postures,
    sight: Sight,
    looking: Looking,
    share=None,
    like: Looks | None = None,
) -> Looks:
    """What one look at each posture tells.

    Parameters
    ----------
    network : Network
        Without constant errors of corners; they are added as ``looking.repeated`` says.
    postures : Postures
        n of them, in reach.
    sight : Sight
        At the same.
    looking : Looking
        How well is looked.
    share : (n, C, M) array, optional
        How much of its information a sighting keeps, of ``estimation.repeated``.
    like : Looks, optional
        Those that these are to be put together with: frames hang as in them, constant errors have their priors.

    Raises
    ------
    NetworkError
        What carries the cutting edge is tied to nothing surveyed in any of the postures.
    """
    sigma = looking.noise.sigma(sight.side_px)
    rows, camera, tag = np.nonzero(sight.seen)
    cov = sigma[rows, camera, tag][:, None, None, None] ** 2 * np.broadcast_to(
        np.eye(2), (len(rows), 4, 2, 2)
    )
    seen = Observations(camera, tag, np.zeros(len(rows), np.int64), sight.uv[rows, camera, tag], cov)
    if like is not None:
        seen = _joined(like.observations, seen)
    network = with_offsets(network, seen, looking.repeated)
    known = {} if like is None else {s.name: s for s in like.network.statics}
    network = replace(network, statics=tuple(known.get(s.name, s) for s in network.statics))
    silent = {s.name: Readings(np.zeros(1, np.int64), np.zeros(1)) for s in network.sensors}
    tied = tie(network, seen, silent)
    nominal = Start((), (), tuple(s.value for s in network.statics))
    statics = statics_of(network, tied, nominal)
    values = _values(network, tied, postures, statics.size)
    ends = np.cumsum([0] + [v.half for v in tied.variables])
    at = tuple(slice(a, b) for a, b in pairwise(ends))

    groups = _corner_groups(network, tied, statics, values, sight, sigma, share)
    groups += _sensor_groups(network, tied, statics, values, looking.readings_per_look)
    n, b, p = len(postures), int(ends[-1]), statics.size
    H_xx, H_xz = np.zeros((n, b, b)), np.zeros((n, b, p))
    sizes = [v.half for v in tied.variables]
    told = np.zeros((n, len(sizes)), bool)
    links: list[set[int]] = []
    kept = []
    for rows, J in groups:
        # The rates bear on nothing here: what a clock's error does through them is in the statics' Jacobian.
        J = Jacobians({k: A[..., : sizes[k]] for k, A in J.variables.items()}, J.statics)
        links.append(set(J.variables))
        for k, A in J.variables.items():
            told[rows, k] = True
            A_t = np.swapaxes(A, -1, -2)
            for m, B in J.variables.items():
                H_xx[rows, at[k], at[m]] += A_t @ B
            for s, B in J.statics.items():
                H_xz[rows[:, None, None], np.arange(b)[at[k]][:, None], statics.columns[s]] += A_t @ B
        kept.append((rows, J))
    weak = np.concatenate([FIRST_POSE if v.kind == "moving" else FIRST_POSE[-1:] for v in tied.variables])
    H_xx[:, np.arange(b), np.arange(b)] += weak**-2.0
    needed = [s.edge.index for s in tied.frames.path(fr.WORLD, fr.TOOL) if s.edge.kind != "static"]
    return Looks(
        network,
        tied,
        statics,
        values,
        at,
        _chains(len(sizes), links),
        H_xx,
        H_xz,
        np.all(told[:, needed], axis=1),
        seen,
        tuple(kept),
    )


def _joined(a: Observations, b: Observations) -> Observations:
    names = ("camera", "tag", "time_ns", "uv", "cov")
    return Observations(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in names))


def _chains(count: int, links: list[set[int]]) -> tuple[tuple[int, ...], ...]:
    sets = [{k} for k in range(count)]
    for link in links:
        joined = [s for s in sets if s & link]
        sets = [s for s in sets if not s & link] + [set().union(*joined)]
    return tuple(sorted(tuple(sorted(s)) for s in sets))


def _values(network: Network, tied: Tie, postures: Postures, p: int) -> Values:
    T_world = world_poses(network, postures)
    camera = {fr.camera_frame(c.name): (c.body, c.mount) for c in network.cameras}
    marker = {fr.marker_frame(m.name): (m.body, m.mount) for m in network.markers}

    def world_of(frame: str) -> np.ndarray:
        if frame in camera or frame in marker:
            body, mount = (camera | marker)[frame]
            return T_world[body] @ surveyed(network, mount)
        return T_world[next(n for n in network.bodies if fr.body_frame(n) == frame)]

    pose, rate = [], []
    n = len(postures)
    for variable in tied.variables:
        if variable.kind == "joint":
            pose.append(postures.angle[variable.body])
            rate.append(postures.rate[variable.body])
            continue
        anchor = tied.frames.edges[fr.body_frame(variable.body)].parent
        pose.append(se3.inverse(world_of(anchor)) @ T_world[variable.body])
        rate.append(np.zeros((n, 6)))
    return Values(tuple(pose), tuple(rate), np.zeros(p), np.zeros(n))


def _corner_groups(network, tied, statics, values, sight, sigma, share):
    named = {s.name: k for k, s in enumerate(network.statics)}
    out = []
    for c, camera in enumerate(network.cameras):
        if fr.camera_frame(camera.name) not in tied.frames:
            continue
        for t, m in enumerate(network.tag_marker):
            marker = network.markers[m]
            rows = np.flatnonzero(sight.seen[:, c, t])
            if len(rows) == 0 or fr.marker_frame(marker.name) not in tied.frames:
                continue
            n = len(rows)
            group = Corners(
                c,
                int(m),
                tied.frames.path(fr.camera_frame(camera.name), fr.marker_frame(marker.name)),
                camera.intrinsics,
                rows,
                rows,
                np.broadcast_to(network.tag_corners[t], (n, 4, 3)),
                sight.uv[rows, c, t],
                np.eye(2) / sigma[rows, c, t][:, None, None, None] * np.ones((1, 4, 1, 1)),
                np.ones(n),
                named.get(offset_name(network, c, t)),
            )
            _, J = corner_residuals(group, values, statics)
            out.append((rows, J if share is None else _scaled(J, np.sqrt(share[rows, c, t]))))
    return out


def _sensor_groups(network, tied, statics, values, per_look):
    out = []
    for sensor in network.sensors:
        at = [k for k, v in enumerate(tied.variables) if v.kind == "joint" and v.body == sensor.joint]
        if not at:
            continue
        raw = raw_reading(network, sensor, values.pose[at[0]])
        rows = np.flatnonzero(np.isfinite(raw))
        if len(rows) == 0:
            continue
        sigma = measured_sigma(sensor, network.statics[sensor.curve].value, raw[rows])
        readings = SensorReadings(sensor, at[0], rows, np.zeros(len(rows)), raw[rows], sigma)
        _, J = sensor_residuals(readings, values, statics)
        out.append((rows, _scaled(J, np.sqrt(np.full(len(rows), per_look)))))
    return out


def _scaled(J: Jacobians, root) -> Jacobians:
    root = root[:, None, None]
    return replace(
        J,
        variables={k: A * root for k, A in J.variables.items()},
        statics={k: A * root for k, A in J.statics.items()},
    )


def raw_reading(network: Network, sensor: Sensor, angle):
    """What a sensor reads at angles of its joint, (n,) raw units; nan beyond its range or the linkage's stroke."""
    curve = network.statics[sensor.curve].value
    if sensor.linkage is None:
        # Its own turn: the curve's angle nearest to the joint's.
        wanted = np.rad2deg(angle)
        low, high = _range(sensor, curve, np.nanmin(wanted), np.nanmax(wanted))
    else:
        wanted = linkage.cylinder_length(angle, network.statics[sensor.linkage].value, sensor.side)
        low, high = _range(sensor, curve, np.nanmin(wanted), np.nanmax(wanted))
    grid = np.linspace(low, high, 4001)
    made = np.polynomial.polynomial.polyval(grid, curve)
    order = np.argsort(made)
    return np.interp(wanted, made[order], grid[order], left=np.nan, right=np.nan)


def _range(sensor: Sensor, curve, least: float, most: float) -> tuple[float, float]:
    if sensor.raw_range is not None:
        return sensor.raw_range
    ends = sorted(((least - curve[0]) / curve[1], (most - curve[0]) / curve[1]))
    spare = 0.1 * (ends[1] - ends[0]) + 1.0
    return ends[0] - spare, ends[1] + spare
