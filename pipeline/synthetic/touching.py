"""The bucket set on one stake at several angles: the motion, and the check file of the surveyor who stood by."""

from __future__ import annotations

import datetime

import numpy as np
from scipy.interpolate import BPoly

from pipeline.synthetic import files, truth
from pipeline.synthetic.cycle import Motion, Sweep
from pipeline.synthetic.excavator import Mounts
from pipeline.synthetic.specification import Specification

BEFORE_S = 1.5
NEVER_S = 1e9
ROUNDS = 3
"""Of putting the true edge where it should be: pins and axes that are off by millimetres turn with the bucket."""


class Touching(Motion):
    """The machine stands; its edge goes from touch to touch. The soil is the stake's: what is set down stays."""

    def __init__(self, spec: Specification, rng: np.random.Generator, mounts: Mounts):
        self._aim: np.ndarray
        self._turned: np.ndarray
        self._tip: BPoly
        super().__init__(spec, rng)
        plan = spec.touches
        assert plan is not None
        self.touch_s = self._begin_s + 0.5 * plan.hold_s
        self.contact = self.stake + rng.normal(0.0, plan.contact_mm / 1000, (len(self.touch_s), 3))
        self.surveyed = self.stake + rng.normal(0.0, plan.point_mm / 1000, 3)
        for _ in range(ROUNDS):
            middle = truth.edge_points(spec, mounts, self, self.touch_s)[:, 1]
            # The arm moves in its plane; across it only the swing does.
            across = (self.contact - middle)[:, :2] @ self.place.left
            self._turned = self._turned - across / plan.reach
            self._aim = self._aim + self.contact - middle
            self._tip = self._path()
            self._curves["swing"] = self._swing()

    def _build(self, rng: np.random.Generator) -> None:
        plan, spec = self.spec.touches, self.spec
        assert plan is not None
        n = len(plan.directions_deg)
        stand = spec.first_station + spec.axis_reach
        self._begin_s = BEFORE_S + plan.move_s + np.arange(n) * (plan.hold_s + plan.move_s)
        self.duration_s = float(self._begin_s[-1]) + plan.hold_s + 1.0
        self.stake = self.place.point(stand - plan.reach, 0.0, spec.ground + plan.height)
        self._aim, self._turned = np.tile(self.stake, (n, 1)), np.zeros(n)
        self.control_stop_s = (float(self._begin_s[0]), float(self._begin_s[0]) + plan.hold_s)
        self._phases = [(0.0, "idle")]
        # The trench is drawn where a sweep would begin; this one never does.
        self.sweeps = [Sweep(NEVER_S, spec.first_station)]
        for t in (0.0, self.duration_s + 1):
            self._put(t, stand=(stand, 0), swing=(0.0, 0), reach=(plan.reach, 0), height=(0.0, 0))
        self._put(0.0, bucket=(plan.directions_deg[0], 0))
        for t, direction in zip(self._begin_s, plan.directions_deg):
            # Turned before it comes down and after it went up.
            self._put(t - 0.3 * plan.move_s, bucket=(direction, 0))
            self._put(t + plan.hold_s + 0.3 * plan.move_s, bucket=(direction, 0))
            self._phases += [(t, "control"), (t + plan.hold_s, "idle")]
        self._tip = self._path()

    def _path(self) -> BPoly:
        plan = self.spec.touches
        assert plan is not None
        up = np.array([0.0, 0.0, plan.lift_m])
        times, places = [0.0], [self._aim[0] + up]
        for t, aim in zip(self._begin_s, self._aim):
            times += [t - 0.5 * plan.move_s, t, t + plan.hold_s]
            places += [aim + up, aim, aim]
        times.append(self.duration_s + 1)
        places.append(self._aim[-1] + up)
        still = np.zeros(3)
        return BPoly.from_derivatives(times, [[place, still, still] for place in places])

    def _swing(self) -> BPoly:
        plan = self.spec.touches
        assert plan is not None
        times, angles = [0.0], [self._turned[0]]
        for t, angle in zip(self._begin_s, self._turned):
            times += [t - 0.1 * plan.move_s, t + plan.hold_s + 0.1 * plan.move_s]
            angles += [angle, angle]
        times.append(self.duration_s + 1)
        angles.append(self._turned[-1])
        return BPoly.from_derivatives(times, [[angle, 0.0, 0.0] for angle in angles])

    def _steered(self, t: np.ndarray) -> np.ndarray:
        return np.asarray(self._tip(t))


def check_file(spec: Specification, motion: Touching) -> str:
    """The touches as a file with headings: the stake's coordinates, and when the edge stood on it."""
    plan = spec.touches
    assert plan is not None
    enh = np.array(spec.origin) + motion.surveyed / files.METRES_PER_UNIT[spec.unit]
    lines = ["point,northing,easting,elevation,code,time,kind,edge_point,sigma_mm"]
    for t in motion.touch_s:
        moment = datetime.datetime.fromtimestamp(spec.start_utc_ns / 1e9 + t, datetime.UTC)
        stamp = moment.strftime("%Y-%m-%dT%H:%M:%SZ")  # a surveyor's clock has whole seconds
        lines.append(
            f"{plan.name},{enh[1]:.4f},{enh[0]:.4f},{enh[2]:.4f},touch,{stamp},control,middle,{plan.point_mm}"
        )
    return "\n".join(lines) + "\n"
