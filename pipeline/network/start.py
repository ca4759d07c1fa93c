"""Where the adjustment starts: poses from single pictures, the right one of two chosen jointly and over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import NetworkError
from pipeline.geometry import linkage, se3
from pipeline.network import frames as fr
from pipeline.network.branches import OTHER_SIGMA_PX, disagreement, most_agreed, score, viterbi
from pipeline.network.datum import Tie
from pipeline.network.epochs import Epochs
from pipeline.network.model import Network
from pipeline.network.pairs import two_angles
from pipeline.network.resection import refined
from pipeline.network.views import View, off_px, views_of

BRIDGE_S = 0.5
"""Between two of its pictures this close a body's place is good enough to tell other places from. Across longer gaps it
is not: a tag first seen while the reference was out of view would start wherever the geodesic happened to pass."""
ARM_M = 0.05
"""Two joints about nearly one line, with a shorter arm between them, are not told apart: the first starts at zero."""
LOST_PX = 5.0
"""A picture whose best pose leaves the median corner further off is no knot of the start."""


@dataclass(frozen=True, eq=False)
class Start:
    """Values of everything at every epoch, good enough for Gauss-Newton."""

    pose: tuple[np.ndarray, ...]
    """Per variable: (E, 4, 4) pose of a moving body in its anchor, or (E,) angle of a joint."""
    rate: tuple[np.ndarray, ...]
    """Per variable: (E, 6) velocity in the body, m/s and rad/s, or (E,) rate, rad/s."""
    statics: tuple[np.ndarray, ...]
    """Per static: its value; that of the file, unless nobody surveyed it."""


def start(network: Network, tie: Tie, epochs: Epochs) -> Start:
    """Starting values from the graph, the readings and the pictures.

    What moves, and poses that no file gives, are taken one after the other, each from the pictures in which it alone is
    still unknown. A pose so found may show where a body was in pictures that told nothing before, and these
    where further markers hang: so the start grows outwards from the datum. Between the pictures poses follow the
    geodesic. A joint is started from its sensor where it has one.

    Raises
    ------
    NetworkError
        No reading of a sensor lies in the stroke of its linkage.
    """
    search = _Search(network, tie, epochs)
    for sensor in sorted(epochs.sensors):
        search.take_sensor(sensor)
    while (keys := search.next_keys()) or search.relax():
        for key in keys:
            search.take_views(key)
    return Start(tuple(search.pose), tuple(search.rate), tuple(search.statics))


class _Search:
    """The state of the search: what is known so far."""

    def __init__(self, network: Network, tie: Tie, epochs: Epochs):
        self.network, self.tie, self.epochs = network, tie, epochs
        self.time_s = epochs.time_s
        n = len(self.time_s)
        self.pose = [se3.identity((n,)) if v.kind == "moving" else np.zeros(n) for v in tie.variables]
        self.rate = [np.zeros((n, 6)) if v.kind == "moving" else np.zeros(n) for v in tie.variables]
        self.statics = [s.value for s in network.statics]
        self.unknown: list[tuple[str, int]] = [(v.kind, k) for k, v in enumerate(tie.variables)]
        hanging = {e.index for e in tie.frames.edges.values() if e.kind == "static"}
        self.unknown += [
            ("static", k) for k, s in enumerate(network.statics) if not s.surveyed and k in hanging
        ]
        # Where places grow on each other, the error of single pictures would too; else the adjustment corrects it.
        self.grows = any(kind == "static" for kind, _ in self.unknown)
        self.known = np.zeros(
            (len(tie.variables), n), dtype=bool
        )  # at these epochs, from pictures or readings
        self.asked = np.zeros((len(tie.variables), n), dtype=bool)  # there pictures were looked at already
        self.views = list(views_of(network, tie, epochs))

    def edge_pose(self, edge: fr.Edge, epoch):
        if edge.kind == "static":
            return self.statics[edge.index]
        value = self.pose[edge.index][epoch]
        return value if edge.kind == "moving" else fr.turn(edge.ratio * value)

    def take_sensor(self, index: int) -> None:
        sensor, data = self.network.sensors[index], self.epochs.sensors[index]
        which = next(
            (k for k, v in enumerate(self.tie.variables) if v.kind == "joint" and v.body == sensor.joint),
            None,
        )
        if which is None or ("joint", which) not in self.unknown:
            return
        measured = np.polynomial.polynomial.polyval(data.raw, self.statics[sensor.curve])
        stroke = None
        if sensor.linkage is None:
            angle = np.deg2rad(measured)
        else:
            params = self.statics[sensor.linkage]
            angle = linkage.bucket_angle(measured, params, sensor.side)
            stroke = np.round(linkage.stroke(params, sensor.side), 4).tolist()
        good = np.isfinite(angle)
        if not np.any(good):
            raise NetworkError(
                f"no reading of sensor '{sensor.name}' gives an angle: its curve leads to {np.min(measured):.4g} to "
                f"{np.max(measured):.4g} m, outside the stroke {stroke} m of the linkage; check the curve's "
                f"coefficients, the linkage's sizes and its branch"
            )
        t = self.time_s[data.epoch[good]] + data.dt_s[good]
        angle = np.unwrap(angle[good])
        self.pose[which] = np.interp(self.time_s, t, angle)
        after, before = np.interp(self.time_s + 0.1, t, angle), np.interp(self.time_s - 0.1, t, angle)
        self.rate[which] = (after - before) / 0.2
        self.known[which] = self.asked[which] = True
        self.unknown.remove(("joint", which))

    def next_keys(self) -> list[tuple[str, int]]:
        """What to take next: what moves, if pictures show it at new epochs; else poses that no file gives.

        Of those poses all that at least half as many pictures show as show the best one: where a few pictures alone
        would place a tag, more come with the next round.
        """
        moving = dict.fromkeys(((v.kind, k) for k, v in enumerate(self.tie.variables)), 0)
        still: dict[tuple[str, int], int] = {}
        for view in self.views:
            for key in set(map(_key, view.path)):
                if key in moving:
                    usable = self._usable(view, key)
                    moving[key] += int(np.sum(usable & ~self.asked[key[1]][view.epoch]))
                elif key in self.unknown:
                    still[key] = still.get(key, 0) + int(np.sum(self._usable(view, key)))
        if moving and max(moving.values()) > 0:
            return [max(moving, key=lambda key: moving[key])]
        most = max(still.values(), default=0)
        return [key for key, count in still.items() if count and count >= 0.5 * most]

    def _usable(self, view: View, key):
        """In which frames of a view (F,) everything else on its path is known."""
        keys = [_key(step) for step in view.path]
        if keys.count(key) > 1 or any(k != key and k[0] == "static" and k in self.unknown for k in keys):
            return np.zeros(len(view.epoch), dtype=bool)
        usable = np.ones(len(view.epoch), dtype=bool)
        for kind, index in keys:
            if kind != "static" and (kind, index) != key:
                usable &= self.known[index][view.epoch]
        return usable

    def relax(self) -> bool:
        """Where no picture leads on: trust the geodesics across gaps; then, take a joint without pictures as zero."""
        open_ = [key for key in self.unknown if key[0] != "static"]
        taken = [k for k, v in enumerate(self.tie.variables) if (v.kind, k) not in open_]
        if self.unknown and not np.all(self.known[taken]):
            self.known[taken] = True
            return True
        if not open_:
            return False
        if self.take_pair():
            return True
        joints = [key for key in open_ if key[0] == "joint"]
        key = joints[0] if joints else open_[0]
        self.unknown.remove(key)
        self.known[key[1]] = self.asked[key[1]] = True
        return True

    def take_pair(self) -> bool:
        """Start the first of two joints that pictures show only together; the second then stands alone."""
        for view in sorted(self.views, key=lambda v: -len(v.epoch)):
            keys = [_key(step) for step in view.path]
            at = [k for k, key in enumerate(keys) if key in self.unknown]
            if len(at) != 2 or any(keys[k][0] != "joint" for k in at) or keys[at[0]] == keys[at[1]]:
                continue
            if self._start_first(view, at):
                return True
        return False

    def _start_first(self, view: View, at: list[int]) -> bool:
        """Start the first of the two joints at these steps of a view's path; False where only their sum shows."""
        key, second = (_key(view.path[k]) for k in at)
        before, _, step = self._around(view, key)
        after = self._around(view, second)[1]
        _, M = fr.along(view.path[at[0] + 1 : at[1]], lambda edge: self.edge_pose(edge, view.epoch))
        M = np.broadcast_to(M, before.shape)[:, None]
        a, b, arm_m = two_angles(se3.inverse(before)[:, None] @ view.poses @ se3.inverse(after)[:, None], M)
        if not np.nanmedian(arm_m) > ARM_M:
            return False
        T = before[:, None] @ fr.turn(a) @ M @ fr.turn(b) @ after[:, None]
        off = np.where(view.seen[:, None], off_px(T, view.p_marker, view.xy, view.focal_px), 0.0)
        cost = 0.5 * np.sum(off**2, axis=-1) / OTHER_SIGMA_PX**2
        E = fr.turn(a / (step.sign * step.edge.ratio))
        t = self.time_s[view.epoch]
        E = E[np.arange(len(t)), viterbi(E, np.where(np.isfinite(cost), cost, np.inf), t)]
        good = np.isfinite(E[:, 0, 0])
        self._interpolate(key, t[good], E[good])
        self.known[key[1]] = self.asked[key[1]] = True
        self.unknown.remove(key)
        return True

    def take_views(self, key: tuple[str, int]) -> None:
        views = [
            v.take(u) for v in self.views if key in map(_key, v.path) and np.any(u := self._usable(v, key))
        ]
        knots = np.unique(np.concatenate([v.epoch for v in views]))
        rows_of = [np.searchsorted(knots, v.epoch) for v in views]
        pictures = np.zeros(
            len(knots), dtype=np.int64
        )  # so far, at each knot: few of many markers are in one frame
        width = 2 * int(np.bincount(np.concatenate(rows_of)).max())
        candidates = np.full((len(knots), width, 4, 4), np.nan)
        misfit = np.full((len(knots), width), np.nan)
        around = []
        for view, rows in zip(views, rows_of, strict=True):
            before, after, step = self._around(view, key)
            edge = step.edge
            around.append((rows, before, after, step))
            E = se3.inverse(before)[:, None] @ view.poses @ se3.inverse(after)[:, None]
            E = se3.inverse(E) if step.sign < 0 else E
            if key[0] == "joint":
                turned = np.arctan2(E[..., 1, 0] - E[..., 0, 1], E[..., 0, 0] + E[..., 1, 1])
                E = fr.turn(turned / edge.ratio)
            columns = 2 * pictures[rows, None] + np.arange(2)
            candidates[rows[:, None], columns], misfit[rows[:, None], columns] = E, view.misfit
            pictures[rows] += 1
        cost, middle_px = score(candidates, views, around)
        cost += disagreement(candidates, misfit)
        if key[0] == "static":
            every = [(np.zeros_like(rows), *rest) for rows, *rest in around]
            found = most_agreed(candidates, misfit, cost)[None]
            self.statics[key[1]] = refined(found, views, every)[0]
        else:
            chosen = viterbi(candidates, cost, self.time_s[knots])
            rows = np.arange(len(knots))
            found = np.isfinite(cost[rows, chosen])
            E, middle_px = candidates[rows, chosen], middle_px[rows, chosen]
            if self.grows and key[0] == "moving":
                E = refined(np.where(found[:, None, None], E, np.eye(4)), views, around)
                middle_px = score(E[:, None], views, around)[1][:, 0]
            good = found & (middle_px < LOST_PX)
            if np.sum(good) < 0.5 * len(knots):
                good = found
            E = E[good]
            self.asked[key[1]][knots] = True
            if len(E):
                self._interpolate(key, self.time_s[knots[good]], E)
                self.known[key[1]] |= self._near(knots[good])
        if key in self.unknown:
            self.unknown.remove(key)

    def _near(self, knots):
        """(E,) bool: the knots, and what lies between two of them that are close to each other."""
        epoch, t = np.arange(len(self.time_s)), self.time_s
        before = knots[np.maximum(np.searchsorted(knots, epoch, side="right") - 1, 0)]
        after = knots[np.minimum(np.searchsorted(knots, epoch), len(knots) - 1)]
        return (before <= epoch) & (epoch <= after) & (t[after] - t[before] <= BRIDGE_S)

    def _around(self, view: View, key):
        """The known parts of a view's path before and after the unknown edge, (F, 4, 4) each, and that step."""
        at = [_key(step) for step in view.path].index(key)

        def edge_pose(edge):
            return self.edge_pose(edge, view.epoch)

        shape = (len(view.epoch), 4, 4)
        before = np.broadcast_to(fr.along(view.path[:at], edge_pose)[1], shape)
        after = np.broadcast_to(fr.along(view.path[at + 1 :], edge_pose)[1], shape)
        return before, after, view.path[at]

    def _interpolate(self, key, t, E) -> None:
        if key[0] == "joint":
            angle = np.unwrap(np.arctan2(E[:, 1, 0], E[:, 0, 0]))
            self.pose[key[1]] = np.interp(self.time_s, t, angle)
            if len(t) > 1:
                self.rate[key[1]] = np.interp(self.time_s, t, np.gradient(angle, t), left=0.0, right=0.0)
            return
        if len(t) == 1:
            self.pose[key[1]] = np.broadcast_to(E[0], (len(self.time_s), 4, 4)).copy()
            return
        self.pose[key[1]] = geodesic(t, E, self.time_s)
        low, high = np.maximum(np.arange(len(t)) - 1, 0), np.minimum(np.arange(len(t)) + 1, len(t) - 1)
        rate = se3.local(E[low], E[high]) / (t[high] - t[low])[:, None]
        # Before the first and after the last picture nobody knows of a motion: at rest.
        self.rate[key[1]] = np.stack(
            [np.interp(self.time_s, t, rate[:, i], left=0.0, right=0.0) for i in range(6)], axis=-1
        )


def geodesic(t, T, at):
    """Poses at times between given ones, along the geodesic; constant before the first and after the last.

    Parameters
    ----------
    t : (n,) array
        Seconds, rising.
    T : (n, 4, 4) array
        Poses at these times.
    at : (k,) array
        Seconds.

    Returns
    -------
    (k, 4, 4) array
    """
    low = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    share = np.clip((at - t[low]) / (t[low + 1] - t[low]), 0, 1)
    return se3.retract(T[low], share[:, None] * se3.local(T[:-1], T[1:])[low])


def _key(step: fr.Step) -> tuple[str, int]:
    return step.edge.kind, step.edge.index
