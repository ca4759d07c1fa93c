"""The point at which everything is linearised: states, statics, and how both are moved by a step."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pipeline.estimation import motion_kernels
from pipeline.geometry import se3
from pipeline.network import frames as fr
from pipeline.network.datum import Tie
from pipeline.network.model import Network
from pipeline.network.start import Start

MOST_KNOWN = 4096


@dataclass(frozen=True, eq=False)
class Statics:
    """Where each static's whitened unknowns stand in ``z``, and how to get from ``z`` to values."""

    base: tuple[np.ndarray, ...]
    """Prior mean of each: the file's value (for an unsurveyed pose the start)."""
    is_pose: tuple[bool, ...]
    scale: tuple[np.ndarray, ...]
    """(n, r) each; r may be 0: exact."""
    columns: tuple[np.ndarray, ...]
    """(r,) each, their places in ``z``."""
    clocks: tuple[int | None, ...]
    """Per variable: the time offset of the sensor in whose time its states stand."""
    size: int
    """p, how many unknowns there are in all."""
    _known: dict[tuple, np.ndarray] = field(default_factory=dict, init=False, repr=False)
    """What was asked for at the last few z: every part of a log asks for the same."""

    def value(self, index: int, z):
        """The static's value, not to be written to."""
        return self._once(("value", index), z, self._value)

    def _once(self, name: tuple[str, int], z, function):
        key = (*name, z.tobytes())
        found = self._known.get(key)
        if found is None:
            if len(self._known) > MOST_KNOWN:
                self._known.clear()
            found = self._known[key] = function(name[1], z)
        return found

    def _value(self, index: int, z):
        correction = self.scale[index] @ z[self.columns[index]]
        if not self.is_pose[index]:
            return self.base[index] + correction
        return (
            self.base[index] if len(self.columns[index]) == 0 else se3.retract(self.base[index], correction)
        )

    def clock_error(self, variable: int, z, time_s):
        """How much later the states of a joint are, in truth, than their epochs say, seconds: (n,), or 0."""
        clock = self.clocks[variable]
        return 0.0 if clock is None else self.lateness(clock, z, time_s)

    def lateness(self, offset: int, z, time_s):
        """(n,) what the file's time offset of a sensor lacks at these times of the log, seconds."""
        return self._of_clock(offset, time_s) @ (self.scale[offset] @ z[self.columns[offset]])

    def lateness_by(self, offset: int, z, time_s):
        """(n, r) the same by the offset's unknowns."""
        return self._of_clock(offset, time_s) @ self.sensitivity(offset, z)

    def _of_clock(self, offset: int, time_s):
        """(n, 1 or 2) seconds late by the offset, s, and its drift, ppm."""
        basis = np.ones((len(time_s), len(self.base[offset])))
        basis[:, 1:] = 1e-6 * time_s[:, None]
        return basis

    def sensitivity(self, index: int, z):
        """(n, r): change of the value, or right perturbation of the pose, by its unknowns; not to be written to."""
        return self._once(("sensitivity", index), z, self._sensitivity)

    def _sensitivity(self, index: int, z):
        scale = self.scale[index]
        if not self.is_pose[index] or scale.shape[1] == 0:
            return scale
        return se3.Jr(scale @ z[self.columns[index]]) @ scale


@dataclass(frozen=True, eq=False, kw_only=True)
class Along(Statics):
    """Statics whose one unknown is how far they go along a step: for whoever knows the step, a border of one column."""

    of: Statics
    z: np.ndarray
    """(p,) where they are."""

    def value(self, index: int, z):
        return self.of.value(index, self.z)

    def lateness(self, offset: int, z, time_s):
        return self.of.lateness(offset, self.z, time_s)

    def _sensitivity(self, index: int, z):
        scale = self.scale[index]
        if not self.is_pose[index] or scale.shape[1] == 0:
            return scale
        return se3.Jr(self.of.scale[index] @ self.z[self.of.columns[index]]) @ scale


def along(statics: Statics, z, dz) -> Along:
    """Statics at z, that move along dz; both (p,)."""
    moves = [len(columns) > 0 for columns in statics.columns]
    return Along(
        statics.base,
        statics.is_pose,
        tuple(
            (scale @ dz[columns])[:, None] if m else scale
            for scale, columns, m in zip(statics.scale, statics.columns, moves, strict=True)
        ),
        tuple(np.zeros(int(m), dtype=np.int64) for m in moves),
        statics.clocks,
        1,
        of=statics,
        z=z,
    )


def statics_of(network: Network, tied: Tie, start: Start) -> Statics:
    """The unknowns of all statics, in the network's order."""
    scale = tuple(s.scale for s in network.statics)
    ends = np.cumsum([0] + [m.shape[1] for m in scale])
    columns = tuple(np.arange(a, b) for a, b in pairwise(ends))
    return Statics(
        start.statics,
        tuple(s.is_pose for s in network.statics),
        scale,
        columns,
        tuple(v.clock for v in tied.variables),
        int(ends[-1]),
    )


@dataclass(frozen=True, eq=False)
class Values:
    """One value for every unknown."""

    pose: tuple[np.ndarray, ...]
    """Per variable: (E, 4, 4) or (E,)."""
    rate: tuple[np.ndarray, ...]
    """Per variable: (E, 6) or (E,)."""
    z: np.ndarray
    """(p,) whitened corrections of the statics."""
    time_s: np.ndarray
    """(E,) seconds of each epoch since the log's first."""

    def retract(self, deltas, dz) -> Values:
        """Moved by a step: per variable (E, 12) or (E, 2), and (p,)."""
        pose, rate = [], []
        for T, w, d in zip(self.pose, self.rate, deltas, strict=True):
            if T.ndim == 3:
                pose.append(np.empty_like(T))
                motion_kernels.retract(T, d, pose[-1])
                rate.append(w + d[:, 6:])
            else:
                pose.append(T + d[:, 0])
                rate.append(w + d[:, 1])
        return replace(self, pose=tuple(pose), rate=tuple(rate), z=self.z + dz)

    def edge_pose(self, statics: Statics, edge: fr.Edge, epoch=slice(None)):
        """``T_parent_child`` of an edge: (4, 4), or (n, 4, 4) at the given epochs."""
        if edge.kind == "static":
            return statics.value(edge.index, self.z)
        value = self.pose[edge.index][epoch]
        if edge.kind == "moving":
            return value
        late = statics.clock_error(edge.index, self.z, self.time_s[epoch])
        angle = value - self.rate[edge.index][epoch] * late
        return fr.turn(edge.ratio * angle)
