"""Where the adjustment starts: poses from single pictures, the right one of two chosen jointly and over time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.errors import NetworkError
from pipeline.geometry import camera as camera_model
from pipeline.geometry import linkage, se3, so3
from pipeline.network import frames as fr
from pipeline.network import planar
from pipeline.network.datum import Tie
from pipeline.network.epochs import Epochs
from pipeline.network.model import Network

CORNER_CAP_PX = 20.0
"""A corner further off than this tells nothing about the branch, only that one of the two is wrong."""
OWN_SIGMA_PX = 0.3
"""A picture against its own pose: corner noise, and what uncertain intrinsics do."""
OTHER_SIGMA_PX = 3.0
"""A picture against the pose from another: a milliradian of an uncertain mount is a pixel and more. With one sigma for
both, two cameras whose mounts were off by 0.05 deg agreed on a flipped marker."""
AGREE_RAD, DISAGREE_CAP = 0.1, 50.0
"""Two pictures of one body agree on its rotation to about this; a picture that cannot be brought to agree counts no
more than the cap."""
TURN_RAD, TURN_RAD_S = 0.05, 0.5
SHIFT_M, SHIFT_M_S = 0.1, 2.0
"""Between two pictures dt apart a body turns and moves by about the first plus the second times dt. The two branches
of a marker differ by twice its tilt, as a rule tens of degrees."""
STEP_CAP = 50.0
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


@dataclass(frozen=True, eq=False)
class _View:
    """One marker in the frames of one camera."""

    path: tuple[fr.Step, ...]
    epoch: np.ndarray  # (F,)
    p_marker: np.ndarray  # (m, 3)
    xy: np.ndarray  # (F, m, 2) rays, 0 where not seen
    seen: np.ndarray  # (F, m)
    focal_px: float
    poses: np.ndarray  # (F, 2, 4, 4) T_camera_marker
    misfit: np.ndarray  # (F, 2) sum of its squared residuals, px²


def start(network: Network, tie: Tie, epochs: Epochs) -> Start:
    """Starting values from the graph, the readings and the pictures.

    Variables are taken one after the other, each from the views in which it alone is still unknown; between the
    pictures poses follow the geodesic. A joint is started from its sensor where it has one.

    Raises
    ------
    NetworkError
        No reading of a sensor lies in the stroke of its linkage.
    """
    search = _Search(network, tie, epochs)
    for sensor in sorted(epochs.sensors):
        search.take_sensor(sensor)
    while search.unknown:
        edge = search.next_edge()
        if edge is None:
            search.assume_zero()
        else:
            search.take_views(edge)
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
        self.views = list(_views(network, tie, epochs))

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
        self.unknown.remove(("joint", which))

    def next_edge(self) -> tuple[str, int] | None:
        """The unknown that most pictures show with everything else on their path known."""
        count = dict.fromkeys(self.unknown, 0)
        for view in self.views:
            open_ = [key for key in map(_key, view.path) if key in count]
            if len(open_) == 1:
                count[open_[0]] += len(view.epoch)
        best = max(count, key=lambda key: count[key])
        return best if count[best] else None

    def assume_zero(self) -> None:
        """Nothing can be had alone any more: the first open joint starts at angle zero."""
        joints = [key for key in self.unknown if key[0] == "joint"]
        self.unknown.remove(joints[0] if joints else self.unknown[0])

    def take_views(self, key: tuple[str, int]) -> None:
        views = [v for v in self.views if [k for k in map(_key, v.path) if k in self.unknown] == [key]]
        knots = np.unique(np.concatenate([v.epoch for v in views]))
        candidates = np.full((len(knots), 2 * len(views), 4, 4), np.nan)
        misfit = np.full((len(knots), 2 * len(views)), np.nan)
        around = []
        for j, view in enumerate(views):
            rows = np.searchsorted(knots, view.epoch)
            before, after, step = self._around(view, key)
            edge = step.edge
            around.append((rows, before, after, step))
            E = se3.inverse(before)[:, None] @ view.poses @ se3.inverse(after)[:, None]
            E = se3.inverse(E) if step.sign < 0 else E
            if key[0] == "joint":
                turned = np.arctan2(E[..., 1, 0] - E[..., 0, 1], E[..., 0, 0] + E[..., 1, 1])
                E = fr.turn(turned / edge.ratio)
            candidates[rows, 2 * j : 2 * j + 2] = E
            misfit[rows, 2 * j : 2 * j + 2] = view.misfit
        cost, middle_px = _score(candidates, views, around)
        cost += _disagreement(candidates, misfit)
        if key[0] == "static":
            self.statics[key[1]] = _medoid(candidates, cost)
        else:
            chosen = _viterbi(candidates, cost, self.time_s[knots])
            rows = np.arange(len(knots))
            good = np.isfinite(cost[rows, chosen]) & (middle_px[rows, chosen] < LOST_PX)
            if np.sum(good) < 0.5 * len(knots):
                good = np.isfinite(cost[rows, chosen])
            E = candidates[rows, chosen][good]
            if len(E):
                self._interpolate(key, self.time_s[knots[good]], E)
        self.unknown.remove(key)

    def _around(self, view: _View, key):
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


def _views(network: Network, tie: Tie, epochs: Epochs) -> Iterator[_View]:
    seen = epochs.observations
    marker_of = network.tag_marker[seen.tag]
    for c, camera in enumerate(network.cameras):
        intrinsics = network.statics[camera.intrinsics].value
        for m, marker in enumerate(network.markers):
            rows = np.flatnonzero((seen.camera == c) & (marker_of == m))
            if len(rows) == 0:
                continue
            tags = np.flatnonzero(network.tag_marker == m)
            frames, frame = np.unique(epochs.epoch[rows], return_inverse=True)
            rays = np.full((len(frames), len(tags), 4, 2), np.nan)
            rays[frame, np.searchsorted(tags, seen.tag[rows])] = camera_model.undistort(
                seen.uv[rows], intrinsics
            )
            xy = rays.reshape(len(frames), -1, 2)
            visible = np.isfinite(xy).all(axis=-1)
            enough = visible.sum(-1) >= 4
            xy, visible, frames = (
                np.where(visible[..., None], xy, 0.0)[enough],
                visible[enough],
                frames[enough],
            )
            if len(frames) == 0:
                continue
            p = network.tag_corners[tags].reshape(-1, 3)
            flat = np.broadcast_to(p[:, :2], (len(frames), len(p), 2))
            poses = planar.both_poses(flat, xy, visible.astype(float))
            poses[~(poses[..., 2, 3] > 0)] = np.nan  # behind the camera
            path = tie.frames.path(fr.camera_frame(camera.name), fr.marker_frame(marker.name))
            focal_px = float(np.mean(intrinsics[:2]))
            off = np.where(visible[:, None], _off(poses, p, xy, focal_px), 0.0)
            yield _View(path, frames, p, xy, visible, focal_px, poses, np.sum(off**2, axis=-1))


def _off(T_camera_marker, p_marker, xy, focal_px):
    """Capped distances of corners, px, for candidate poses (F, K, 4, 4) of points (m, 3): (F, K, m)."""
    T = T_camera_marker
    p = np.einsum("fkij,mj->fkmi", T[..., :3, :3], p_marker) + T[..., None, :3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        off = focal_px * np.hypot(*np.moveaxis(p[..., :2] / p[..., 2:] - xy[:, None], -1, 0))
    off = np.where(p[..., 2] > 0, np.minimum(off, CORNER_CAP_PX), CORNER_CAP_PX)
    return np.where(np.isnan(T[..., :1, 0]), np.nan, off)


def _disagreement(candidates, misfit):
    """How badly each candidate goes with the pictures of its epoch: its own by reprojection, the others by rotation.

    Another picture chooses the branch that suits the candidate, at the price of that branch's own reprojection. So
    uncertain mounts, which shift whole pictures by pixels, do not decide between branches; corners do.
    """
    n, k = misfit.shape
    R = np.where(np.isfinite(candidates), candidates, np.eye(4))[..., :3, :3]
    cosine = 0.5 * (np.einsum("naij,nbij->nab", R, R) - 1)
    angle = np.arccos(np.clip(cosine, -1, 1))
    own = 0.5 * misfit / OWN_SIGMA_PX**2
    price = np.where(np.isnan(own)[:, None], np.inf, own[:, None] + 0.5 * (angle / AGREE_RAD) ** 2)
    price = np.where(np.isnan(price), np.inf, price).reshape(n, k, k // 2, 2)
    best = np.min(np.where(np.isnan(own), np.inf, own).reshape(n, k // 2, 2), axis=-1)[:, None]
    total = np.minimum(price.min(axis=-1), best + DISAGREE_CAP)
    for j in range(k):  # of its own picture a candidate is one branch and cannot choose
        total[:, j, j // 2] = np.minimum(own[:, j], best[:, 0, j // 2] + DISAGREE_CAP)
    return np.sum(np.where(np.isfinite(total), total, 0.0), axis=-1)  # inf: that picture is of another epoch


def _score(candidates, views, around):
    """Reprojection of every candidate in all pictures of its epoch: whitened cost, and the mean corner in px."""
    total = np.zeros(candidates.shape[:2])
    worst = np.zeros(candidates.shape[:2])
    for view, (rows, before, after, step) in zip(views, around, strict=True):
        E = candidates[rows]
        if step.edge.ratio != 1.0:
            E = fr.turn(step.edge.ratio * np.arctan2(E[..., 1, 0], E[..., 0, 0]))
        T = before[:, None] @ (se3.inverse(E) if step.sign < 0 else E) @ after[:, None]
        off = _off(T, view.p_marker, view.xy, view.focal_px)
        total[rows] += np.sum(np.where(view.seen[:, None], off, 0.0) ** 2, axis=-1)
        middle = np.sum(np.where(view.seen[:, None], off, 0.0), axis=-1) / view.seen.sum(-1)[:, None]
        worst[rows] = np.maximum(worst[rows], middle)
    bad = np.isnan(candidates[..., 0, 0])
    return np.where(bad, np.inf, 0.5 * total / OTHER_SIGMA_PX**2), np.where(bad, np.inf, worst)


def _viterbi(candidates, cost, time_s):
    """The cheapest way through the candidates: reprojection, plus how far a body turns and moves in the time."""
    best = np.min(cost, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        unary = np.where(np.isfinite(cost), np.minimum(cost - best, 10 * STEP_CAP), 1e6)
    # What is no candidate is priced out above; as the identity it cannot overflow here.
    rows = np.where(np.isfinite(candidates), candidates, np.eye(4))
    n, k = candidates.shape[:2]
    value, back = unary[0], np.zeros((n, k), dtype=np.int64)
    if n > 1:
        R, t = rows[..., :3, :3], rows[..., :3, 3]
        cosine = 0.5 * (np.einsum("naij,nbij->nab", R[:-1], R[1:]) - 1)
        angle = np.arccos(np.clip(cosine, -1, 1))
        shift = np.linalg.norm(t[1:, None] - t[:-1, :, None], axis=-1)
        dt = np.diff(time_s)[:, None, None]
        step = 0.5 * (angle / (TURN_RAD + TURN_RAD_S * dt)) ** 2
        step += 0.5 * (shift / (SHIFT_M + SHIFT_M_S * dt)) ** 2
        step = np.minimum(step, STEP_CAP)
        for i in range(1, n):
            total = value[:, None] + step[i - 1]
            back[i] = total.argmin(axis=0)
            value = total[back[i], np.arange(k)] + unary[i]
    chosen = np.empty(n, dtype=np.int64)
    chosen[-1] = value.argmin()
    for i in range(n - 1, 0, -1):
        chosen[i - 1] = back[i, chosen[i]]
    return chosen


def _medoid(candidates, cost):
    """That candidate of one unchanging pose which lies closest to the others, by capped distance."""
    flat, price = candidates.reshape(-1, 4, 4), cost.ravel()
    order = np.argsort(price)[: min(400, int(np.sum(np.isfinite(price))))]
    if len(order) == 0:
        return np.eye(4)
    T = flat[np.sort(order)]
    shift = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    turned = np.linalg.norm(so3.log(np.swapaxes(T[:, None, :3, :3], -1, -2) @ T[None, :, :3, :3]), axis=-1)
    return T[np.argmin(np.sum(np.minimum(shift / 0.1 + turned / 0.05, 20.0), axis=1))]
