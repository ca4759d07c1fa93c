"""The work: digging, lifting, swinging, dumping, returning, tramming, idling, standing on a control point.

Everything is a function of time with continuous accelerations, so that the truth exists at any instant. The
operator steers the middle of the cutting edge; while it cuts, it follows a floor that is a function of the
station. The machine shakes on its tracks meanwhile, faster than five frames a second can follow: that is what
limits a real recording between its frames, and what the motion prior of machine.toml has to admit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BPoly

from pipeline.geometry import se3, so3
from pipeline.synthetic.excavator import Place, arm_frame, joint_directions
from pipeline.synthetic.specification import Specification

CYCLE_S = 14.2
TRAM_S = 2.4
IDLE_S = 3.0
CONTROL_S = 11.5
SHAKE_HZ = (0.7, 4.0)
SOIL_HOLDS = 0.5
IDLE_LEVEL = 0.1  # of the shaking while cutting: the engine alone
PEG_M = 0.06  # height of the control point above the ground, before the plan of the floor is added
PHASES = ("dig", "swing", "dump", "return", "tram", "idle", "control")

# One cycle, seconds from its beginning: reach from the far end of the sweep, height of the edge above the floor
# and direction of the bucket; value and slope. The sweep itself is put in by `Work`.
_HEIGHT = (
    (0.0, 1.25, -0.7), (1.05, 0.0, 0.0), (4.75, 0.0, 0.0), (5.6, 0.75, 1.3), (7.0, 2.9, 0.9), (8.4, 3.4, 0.0),
    (10.0, 3.3, 0.0), (11.4, 2.9, -0.6), (12.6, 2.0, -0.8), (CYCLE_S, 1.25, 0.0),
)  # fmt: skip
_BUCKET = (
    (0.0, -66.0, -6.0), (1.0, -76.0, -10.0), (4.6, -124.0, -17.0), (5.9, -170.0, -14.0), (6.6, -174.0, 0.0),
    (8.5, -174.0, 0.0), (9.7, -66.0, 0.0), (10.1, -62.0, 0.0), (11.6, -66.0, 0.0), (CYCLE_S, -66.0, 0.0),
)  # fmt: skip
_SWING = ((0.0, 0.0), (5.9, 0.0), (8.5, 1.0), (10.0, 1.0), (12.6, 0.0), (CYCLE_S, 0.0))


@dataclass(frozen=True)
class Sweep:
    """One pass of the edge along the floor."""

    start_s: float
    """Seconds; the cycle's beginning."""
    station: float
    """Of the edge where it reaches the floor, metres."""


class Motion:
    """Poses of the machine's parts as functions of time (seconds from the start of the log)."""

    def __init__(self, spec: Specification, rng: np.random.Generator):
        self.spec = spec
        self.place = Place(spec)
        self.sweeps: list[Sweep] = []
        self._plan: dict[str, list[tuple[float, float, float]]] = {
            key: [] for key in ("stand", "reach", "height", "bucket", "swing")
        }
        self._phases: list[tuple[float, str]] = [(0.0, "idle")]
        self._build(rng)
        self._curves = {key: _smooth(knots) for key, knots in self._plan.items()}
        self._floor = _floor_deviation(spec)
        # Shaking of the machine on its tracks while it cuts: many oscillations in phase with nothing.
        low, high = np.log(SHAKE_HZ)
        self._shake_hz = np.exp(rng.uniform(low, high, (6, 12)))
        self._shake_phase = rng.uniform(0.0, 2 * np.pi, (6, 12))
        self._pass_extra = rng.uniform(15.0, 35.0, len(self.sweeps)) / 1000.0
        self._ground = rng.uniform(0.0, 2 * np.pi, (1, 2))
        self.control_point = self._steered(np.array([np.mean(self.control_stop_s)]))[0]

    def _build(self, rng: np.random.Generator) -> None:
        spec = self.spec
        t, stand = IDLE_S, spec.first_station + spec.axis_reach
        far, near = spec.axis_reach + 0.1, spec.axis_reach - spec.sweep_m
        ready = far - 0.35
        self._put(
            0.0, stand=(stand, 0), reach=(ready, 0), height=(1.25, 0), bucket=(-66.0, 0), swing=(0.0, 0)
        )
        self._put(
            t - 0.6, stand=(stand, 0), reach=(ready, 0), height=(1.25, 0), bucket=(-66.0, 0), swing=(0.0, 0)
        )
        for cycle in range(spec.cycles):
            slow = rng.uniform(0.97, 1.06)
            self.sweeps.append(Sweep(t, stand - spec.axis_reach))
            speed = (far - near) / 4.0
            reach = ((0.0, ready, 0.15), (0.95, far, 0.0), (1.45, far - 0.2, -speed), (4.6, near + 0.25, -0.9 * speed),
                     (5.4, near, 0.0), (6.8, near + 0.7, 0.7), (8.4, 5.7, 0.3), (9.6, 6.1, 0.0), (11.0, 5.9, 0.1),
                     (CYCLE_S, ready, 0.0))  # fmt: skip
            for key, table in (("reach", reach), ("height", _HEIGHT), ("bucket", _BUCKET)):
                self._plan[key] += [(t + slow * a, v, d / slow) for a, v, d in table if a > 0]
            swing = np.deg2rad(spec.swing_deg + rng.uniform(-4, 4))
            self._plan["swing"] += [(t + slow * a, v * swing, 0.0) for a, v in _SWING]
            for a, phase in ((0.0, "return"), (0.9, "dig"), (5.2, "swing"), (8.5, "dump"), (10.1, "return")):
                self._phases.append((t + slow * a, phase))
            t += slow * CYCLE_S
            self._plan["stand"] += [(t, stand, 0.0)]
            if cycle + 1 < spec.cycles:
                self._phases.append((t, "tram"))
                stand += spec.step_m
                t += TRAM_S
                self._plan["stand"] += [(t, stand, 0.0)]
                self._put(t, reach=(ready, 0), height=(1.25, 0), bucket=(-66.0, 0))
        self._control(t)
        self.sweeps = list(self.sweeps)

    def _control(self, t: float) -> None:
        """Set the edge down on the control point beside the trench, hold still, take it away again."""
        spec = self.spec
        stand = self._plan["stand"][-1][1]
        angle, reach = np.deg2rad(spec.control_swing_deg), 5.9
        self.control_stop_s = (t + 3.4, t + 8.4)
        heading = self.place.bearing_rad + np.pi + angle
        peg = self.place.point(stand, 0.0, 0.0)[:2] + reach * np.array([np.cos(heading), np.sin(heading)])
        station, _ = self.place.station_offset(peg)
        height = spec.ground + PEG_M - float(np.interp(station, *np.array(spec.trench.rows).T))
        knots = {"reach": (reach, 0), "height": (height, 0), "bucket": (-98.0, 0), "swing": (angle, 0)}
        self._put(t + 0.2, bucket=(-66.0, 0), swing=(0, 0))
        self._put(t + 1.6, height=(height + 0.9, 0.0))
        self._put(t + 2.2, swing=(angle, 0), reach=(reach, 0))
        for a in (3.3, 8.5):
            self._put(t + a, **knots)
        self._put(t + 10.2, reach=(6.2, 0), height=(height + 0.8, 0), bucket=(-80.0, 0), swing=(angle, 0))
        self._phases += [(t, "control"), (t + 10.2, "idle")]
        self.duration_s = t + CONTROL_S
        self._put(self.duration_s + 1, stand=(stand, 0), reach=(6.2, 0), height=(height + 0.8, 0), bucket=(-80.0, 0),
                  swing=(angle, 0))  # fmt: skip

    def _put(self, t: float, **values: tuple[float, float]) -> None:
        for key, (value, slope) in values.items():
            self._plan[key].append((t, value, slope))

    def phase(self, t: np.ndarray) -> np.ndarray:
        """(n,) names of what the machine is doing."""
        starts = np.array([start for start, _ in self._phases])
        names = np.array([name for _, name in self._phases], dtype=object)
        return names[np.clip(np.searchsorted(starts, t, side="right") - 1, 0, None)]

    def floor(self, station: np.ndarray) -> np.ndarray:
        """World z that the operator aims at with the last pass, metres."""
        rows = np.array(self.spec.trench.rows)
        return np.interp(station, rows[:, 0], rows[:, 1]) + self._floor(station)

    def poses(self, t: np.ndarray) -> Poses:
        """Poses of all bodies at times (n,), seconds."""
        t = np.asarray(t, float)
        spec = self.spec
        T_world_steady, shake = self._cab(t)
        tip = self._steered(t)
        # The soil holds the teeth, so the arm gives way to part of the shaking; the rest reaches the edge.
        T_world_felt = se3.retract(T_world_steady, SOIL_HOLDS * shake)
        tip_cab = se3.transform(se3.inverse(T_world_felt), tip)
        bucket = np.deg2rad(self._curves["bucket"](t))
        boom, stick = joint_directions(spec.arm, tip_cab[:, [0, 2]], bucket)
        return Poses(t, se3.retract(T_world_steady, shake), boom, stick, bucket)

    def _steered(self, t: np.ndarray) -> np.ndarray:
        """Where the operator wants the middle of the edge, (n, 3) in the world."""
        heading = self.place.bearing_rad + np.pi + self._curves["swing"](t)
        reach, height = self._curves["reach"](t), self._curves["height"](t)
        tip = self.place.point(self._curves["stand"](t), 0.0, self.spec.ground)
        tip[:, 0] += reach * np.cos(heading)
        tip[:, 1] += reach * np.sin(heading)
        station, _ = self.place.station_offset(tip)
        tip[:, 2] = self.floor(station) + self._extra(t, station) + height
        return tip

    def _extra(self, t: np.ndarray, station: np.ndarray) -> np.ndarray:
        """What a pass leaves for the next one to take: higher where the next pass will come again, and ripples."""
        extra = 0.0015 * np.sin(2 * np.pi * station / 0.83) + 0.001 * np.sin(2 * np.pi * station / 0.31 + 1.0)
        for k, sweep in enumerate(self.sweeps[:-1]):
            window = _blend((t - sweep.start_s) / 0.5) * (1 - _blend((t - sweep.start_s - 6.5) / 1.5))
            again = _blend((station - self.sweeps[k + 1].station - 0.15) / 0.6)
            extra = extra + window * again * self._pass_extra[k]
        return extra

    def _cab(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``T_world_cab`` without shaking, (n, 4, 4), and the shaking as ``xi`` of the cab, (n, 6)."""
        spec = self.spec
        swing = self._curves["swing"](t)
        stand = self._curves["stand"](t)
        # The ground under the tracks is not even.
        lean = 0.004 * np.sin(2 * np.pi * stand / np.array([[4.1], [6.7]]) + self._ground[0][:, None])
        track = self.place.bearing_rad + np.pi
        position = self.place.point(stand, 0.003 * np.sin(stand), spec.ground - 0.02 + 0.004 * np.sin(stand))
        R_track = so3.from_rpy_deg(np.array([0.0, 0.0, np.rad2deg(track)])) @ so3.exp(
            np.stack([lean[0], lean[1], 0 * t], axis=-1)
        )
        turn = so3.exp(np.stack([0 * t, 0 * t, swing], axis=-1))
        T_world_steady = se3.from_rotation_translation(R_track @ turn, position)
        level = np.full_like(t, IDLE_LEVEL)
        for sweep in self.sweeps:
            s = t - sweep.start_s
            level = level + (1 - IDLE_LEVEL) * _blend((s - 0.6) / 0.8) * (1 - _blend((s - 5.2) / 1.6))
        waves = np.sin(2 * np.pi * self._shake_hz[..., None] * t + self._shake_phase[..., None]).sum(axis=1)
        waves *= np.sqrt(2 / self._shake_hz.shape[1])
        rms = np.array([*spec.shake_m, *spec.shake_rad])[:, None]
        return T_world_steady, (rms * waves * level).T


@dataclass(frozen=True)
class Poses:
    """The machine at n instants."""

    t: np.ndarray
    """(n,) seconds."""
    T_world_cab: np.ndarray
    """(n, 4, 4)."""
    boom_rad: np.ndarray
    """(n,) directions above the cab's horizontal, of boom, stick and pin-to-edge."""
    stick_rad: np.ndarray
    bucket_rad: np.ndarray

    def stick(self, spec: Specification) -> np.ndarray:
        """``T_world_stick``, (n, 4, 4)."""
        from pipeline.synthetic.excavator import along

        knee = np.array(spec.arm.foot) + spec.arm.boom_m * along(self.boom_rad)
        return self.T_world_cab @ arm_frame(self.stick_rad, knee)

    def joint_rad(self) -> np.ndarray:
        """(n,) angle of the bucket joint."""
        return self.bucket_rad - self.stick_rad


def bucket_pose(T_world_stick: np.ndarray, axis: np.ndarray, joint_rad: np.ndarray) -> np.ndarray:
    """``T_world_bucket``: the stick's axis frame turned about its z by the joint's angle, (n, 4, 4)."""
    zero = np.zeros_like(joint_rad)
    turn = se3.from_rotation_translation(so3.exp(np.stack([zero, zero, joint_rad], axis=-1)), np.zeros(3))
    return T_world_stick @ axis @ turn


def _smooth(knots: list[tuple[float, float, float]]) -> BPoly:
    """Quintic through values and slopes, without acceleration at the knots."""
    knots = sorted(knots)
    kept = [knots[0]]
    for knot in knots[1:]:
        if knot[0] > kept[-1][0] + 1e-9:
            kept.append(knot)
    return BPoly.from_derivatives([k[0] for k in kept], [[k[1], k[2], 0.0] for k in kept])


def _blend(x: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, with continuous second derivative."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x)


def _floor_deviation(spec: Specification):
    def deviation(station: np.ndarray) -> np.ndarray:
        total = np.zeros_like(np.asarray(station, float))
        for low, high, mm in spec.trench.dug:
            s = station - spec.first_station
            total = total + mm / 1000 * _blend((s - low + 0.1) / 0.3) * (
                1 - _blend((s - high - 0.2 + 0.1) / 0.3)
            )
        return total

    return deviation
