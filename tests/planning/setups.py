"""A posture of the tests' small machine, and what planning makes of it."""

import cv2
import numpy as np

from pipeline.config import Machine, Site
from pipeline.geometry import linkage, se3
from pipeline.network import network_of
from pipeline.planning.looks import Looking
from pipeline.planning.postures import Postures, world_poses
from pipeline.planning.sight import CornerNoise, SightRules, sight
from tests.estimation.simulator import MACHINE, SIGMA_PX, SITE, level, rotz

CONSTANT = CornerNoise(SIGMA_PX, 0.0)
"""The same sigma for every corner, as the simulator draws it."""
LOOKING = Looking(readings_per_look=1.0, noise=CONSTANT)


def network(machine=MACHINE):
    return network_of(Machine.model_validate(machine), Site.model_validate(SITE))


def posture(net, moved=0.0, angle=-0.26, rate=0.0):
    """The machine where the simulator starts, its stick moved sideways; one posture."""
    cab = level([0.0, 0.0, 1.5])
    stick = level([1.0 + moved, 6.0, 0.3])
    turn, turning = {"bucket": np.array([angle])}, {"bucket": np.array([rate])}
    return Postures({"cab": cab[None], "stick": stick[None]}, turn, turning)


def seen_from(net, postures, **rules):
    return sight(net, world_poses(net, postures), SightRules(margin_px=5.0, **rules))


def opencv_pixels(T_camera_marker, corners, intrinsics):
    """(4, 2) px by OpenCV."""
    fx, fy, cx, cy = intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    rvec, _ = cv2.Rodrigues(T_camera_marker[:3, :3])
    return cv2.projectPoints(corners, rvec, T_camera_marker[:3, 3], K, intrinsics[4:])[0][:, 0]


class Forward:
    """What one look measures, and where the edge is, as plain functions of every unknown; no Jacobian of ours."""

    def __init__(self, net, at: Postures, seen):
        self.net, self.at = net, at
        self.pairs = np.argwhere(seen[0])
        self.scales = [s.scale for s in net.statics]
        self.size = 13 + sum(s.shape[1] for s in self.scales)

    def statics(self, z):
        out, k = {}, 0
        for static, scale in zip(self.net.statics, self.scales, strict=True):
            step = scale @ z[k : k + scale.shape[1]]
            k += scale.shape[1]
            out[static.name] = static.value @ se3.exp(step) if static.is_pose else static.value + step
        return out

    def __call__(self, unknown):
        """Whitened measurements, and the edge's middle in the world."""
        x, c = unknown[:13], self.statics(unknown[13:])
        net = self.net
        T_cab = self.at.T_world["cab"][0] @ se3.exp(x[:6])
        # The stick where the camera that looks at it has it, as the adjustment keeps it.
        T_dig = T_cab @ c["camera dig mount"]
        nominal_dig = self.at.T_world["cab"][0] @ {s.name: s.value for s in net.statics}["camera dig mount"]
        T_dig_stick = np.linalg.inv(nominal_dig) @ self.at.T_world["stick"][0]
        T_stick = T_dig @ T_dig_stick @ se3.exp(x[6:12])
        turn = self.at.angle["bucket"][0] + x[12]
        late = c["sensor pot time offset"][0] - 0.02 if "sensor pot time offset" in c else 0.0
        # The joint's angle stands at its sensor's time; the edge is asked for at the cameras'.
        turn_now = turn - late * self.at.rate["bucket"][0]
        bodies = {"world": np.eye(4), "cab": T_cab, "stick": T_stick}
        bodies["bucket"] = T_stick @ c["joint bucket axis"] @ rotz(np.array([turn_now]))[0]
        out = []
        for camera, tag in self.pairs:
            cam, marker = net.cameras[camera], net.markers[net.tag_marker[tag]]
            name = f"benchmark {marker.name} pose" if marker.benchmark else f"marker {marker.name} mount"
            T = (
                np.linalg.inv(bodies[cam.body] @ c[f"camera {cam.name} mount"])
                @ bodies[marker.body]
                @ c[name]
            )
            out.append(
                opencv_pixels(T, net.tag_corners[tag], c[f"camera {cam.name} intrinsics"]).ravel() / SIGMA_PX
            )
        curve = c["sensor pot curve"]
        length = linkage.cylinder_length(np.array([turn]), c["sensor pot linkage"], 1)[0]
        nominal = linkage.cylinder_length(
            self.at.angle["bucket"], self.net.statics[net.sensors[0].linkage].value, 1
        )[0]
        old = self.net.statics[net.sensors[0].curve].value
        raw = (nominal - old[0]) / old[1]
        out.append([(curve[0] + curve[1] * raw - length) / (old[1] * net.sensors[0].noise)])
        return np.concatenate(out), (bodies["bucket"] @ c["cutting edge mount"])[:3, 3]

    def edge_covariance(self):
        """By central differences, a dense normal matrix with all priors, and its inverse; (3, 3)."""
        h = 1e-5
        J, L = [], []
        for e in np.eye(self.size):
            (a, p), (b, q) = self(h * e), self(-h * e)
            J.append((a - b) / (2 * h))
            L.append((p - q) / (2 * h))
        J, L = np.array(J).T, np.array(L).T
        prior = np.diag(np.r_[np.zeros(13), np.ones(self.size - 13)])
        return L @ np.linalg.solve(J.T @ J + prior, L.T)
