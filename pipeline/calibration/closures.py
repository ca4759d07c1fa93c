"""Loops of a cluster, instant by instant: what two pictures alone say of two cameras, against what all of them say.

A loop runs from the site through a picture of the first camera to the body and through a picture of the second back
to the site. Each picture is resected by itself, with the lens and the survey as adjusted, so a loop that does not close
is a picture, a marker or a camera that moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.calibration.adjusted import Adjusted
from pipeline.geometry import camera as camera_model
from pipeline.geometry import se3, so3
from pipeline.network import frames as fr

STEPS = 4
"""Gauss-Newton steps of a resection that starts at the adjusted pose."""
LEAST_CORNERS = 4


@dataclass(frozen=True, eq=False)
class Closures:
    """Loops through two cameras."""

    time_ns: np.ndarray
    """(n,) of the first camera's picture."""
    xi: np.ndarray
    """(n, 6) ``T_first_second`` of two pictures alone against the adjusted one, felt in the second, m and rad."""

    @property
    def rms_m(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.xi[:, :3] ** 2, axis=1))))

    @property
    def rms_rad(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.xi[:, 3:] ** 2, axis=1))))


def closures(whole: Adjusted, body: str, first: str, second: str, within_s: float) -> Closures | None:
    """Loops through two cameras of a body; None where no two pictures are that close in time.

    Parameters
    ----------
    whole : Adjusted
        Of the cluster.
    body : str
        That carries both.
    first, second : str
        Cameras.
    within_s : float
        Between two pictures of a loop; what the body moved in between is taken from the adjustment.
    """
    epochs_1, T_1 = resected(whole, first)
    epochs_2, T_2 = resected(whole, second)
    if not len(epochs_1) or not len(epochs_2):
        return None
    T_world_body, time_ns = whole.pose_of_body(body), whole.problem.epochs.time_ns
    t_1, t_2 = time_ns[epochs_1], time_ns[epochs_2]
    nearest = np.argmin(np.abs(t_1[:, None] - t_2[None]), axis=1)
    near = np.abs(t_2[nearest] - t_1) <= within_s * 1e9
    if not np.any(near):
        return None
    a, b = np.flatnonzero(near), nearest[near]
    mounts = [se3.inverse(T_world_body[e]) @ T for e, T in ((epochs_1[a], T_1[a]), (epochs_2[b], T_2[b]))]
    alone = se3.inverse(mounts[0]) @ mounts[1]
    T = se3.inverse(whole.value(f"camera {first} mount")) @ whole.value(f"camera {second} mount")
    return Closures(t_1[a], se3.local(T, alone))


def resected(whole: Adjusted, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a camera from single pictures of the site's markers.

    Returns
    -------
    epoch : (n,) int array
        Of the pictures with four corners or more.
    T_world_camera : (n, 4, 4) array
    """
    network, problem = whole.network, whole.problem
    c = network.camera_index(camera)
    lens = whole.value(f"camera {camera} intrinsics")
    seen = problem.epochs.observations
    on_site = np.array([marker.body == fr.WORLD for marker in network.markers], dtype=bool)
    rows = np.flatnonzero((seen.camera == c) & on_site[network.tag_marker[seen.tag]])
    corners = [_corners_world(whole, tag) for tag in range(len(network.tag_marker))]
    T_start = whole.pose_of_body(network.cameras[c].body) @ whole.value(f"camera {camera} mount")
    found, epochs = [], []
    for epoch in np.unique(problem.epochs.epoch[rows]):
        own = rows[problem.epochs.epoch[rows] == epoch]
        p = np.concatenate([corners[tag] for tag in seen.tag[own]])
        uv = seen.uv[own].reshape(-1, 2)
        root = np.linalg.inv(np.linalg.cholesky(seen.cov[own].reshape(-1, 2, 2)))
        if len(p) < LEAST_CORNERS:
            continue
        T = T_start[epoch].copy()
        for _ in range(STEPS):
            q = se3.transform(se3.inverse(T), p)
            predicted, J_uv_p, _ = camera_model.project_with_jacobians(q, lens)
            J = (
                root
                @ J_uv_p
                @ np.concatenate([-np.broadcast_to(np.eye(3), (len(q), 3, 3)), so3.hat(q)], axis=-1)
            )
            r = np.einsum("nij,nj->ni", root, predicted - uv)
            step = np.linalg.lstsq(J.reshape(-1, 6), -r.reshape(-1), rcond=None)[0]
            T = se3.retract(T, step)
        found.append(T)
        epochs.append(epoch)
    return np.array(epochs, dtype=np.int64), np.array(found).reshape(-1, 4, 4)


def _corners_world(whole: Adjusted, tag: int) -> np.ndarray:
    network = whole.network
    marker = network.markers[network.tag_marker[tag]]
    T = whole.problem.statics.value(marker.mount, whole.optimum.values.z)
    return se3.transform(T, network.tag_corners[tag])
