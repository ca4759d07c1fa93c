"""Corners and readings of a small machine whose truth is drawn: the oracle of the adjustment's tests.

The paper's prototype (Fig. 1): two cameras on the cab, one looking at three boards, one at a board on the stick, and a
linear potentiometer on the bucket's cylinder. The files hold nominal values; the truth differs from them by draws from
the files' own covariances, and moves as the motion prior says. Pictures are OpenCV's, not ours.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import cv2
import numpy as np

from pipeline.config import Machine, Site
from pipeline.geometry import linkage, se3, so3
from pipeline.network import Network, Observations, Readings, network_of
from pipeline.network.model import Static

T0_NS = 1_700_000_000_000_000_000
SIGMA_PX = 0.2

MACHINE = {
    "format": "gradetrace/machine/1",
    "machine": {"id": "sim"},
    "bodies": {
        "cab": {"kind": "moving"},
        "stick": {"kind": "moving"},
        "bucket": {
            "kind": "joint",
            "parent": "stick",
            # z, the axis, to the right; x forward, y up: the plane of the linkage
            "axis": {
                "xyz_m": [0.0, 0.0, 0.0],
                "rpy_deg": [90.0, 0.0, 90.0],
                "sigma_mm": 2.0,
                "sigma_deg": 0.1,
            },
        },
    },
    "cameras": {
        "bench": {
            "topic": "/bench",
            "body": "cab",
            "mount": {
                "xyz_m": [-0.8, 0.5, 1.0],
                "rpy_deg": [-92.0, 1.0, 5.0],
                "sigma_mm": 2.0,
                "sigma_deg": 0.05,
            },
            "intrinsics": {
                "width": 1280,
                "height": 960,
                "fx": 1000.0,
                "fy": 1002.0,
                "cx": 640.0,
                "cy": 482.0,
                "distortion": [-0.12, 0.05, 0.0004, -0.0003, 0.0],
                "sigma": [1.0, 1.0, 1.0, 1.0, 0.001, 0.001, 0.0001, 0.0001, 0.0],
            },
        },
        "dig": {
            "topic": "/dig",
            "body": "cab",
            "mount": {
                "xyz_m": [0.8, 0.5, 1.0],
                "rpy_deg": [-105.0, 0.0, 3.0],
                "sigma_mm": 2.0,
                "sigma_deg": 0.05,
            },
            "intrinsics": {
                "width": 1280,
                "height": 960,
                "fx": 1005.0,
                "fy": 1003.0,
                "cx": 635.0,
                "cy": 478.0,
                "distortion": [-0.1, 0.04, -0.0002, 0.0003, 0.0],
                "sigma": [1.0, 1.0, 1.0, 1.0, 0.001, 0.001, 0.0001, 0.0001, 0.0],
            },
        },
    },
    "markers": {
        "stick": {
            "family": "tag36h11",
            "tags": [{"id": 50, "size_m": 0.3, "x_m": -0.25}, {"id": 51, "size_m": 0.3, "x_m": 0.25}],
            "body": "stick",
            "mount": {
                "xyz_m": [0.0, -0.15, 1.0],
                "rpy_deg": [80.0, 0.0, -25.0],
                "sigma_mm": 1.5,
                "sigma_deg": 0.1,
            },
        },
    },
    "sensors": {
        "pot": {
            "topic": "/pot",
            "joint": "bucket",
            "curve": {"output": "cylinder_m", "coefficients": [1.1, 0.15], "sigma": [0.001, 0.0004]},
            "linkage": {
                "cylinder_anchor_m": [0.35, 1.7],
                "rocker_pivot_m": [0.05, 0.4],
                "rocker_m": 0.45,
                "coupler_m": 0.42,
                "horn_m": 0.36,
                "horn_angle_deg": 0.0,
                "branch": 1,
                "sigma_mm": 0.5,
                "sigma_horn_angle_deg": 0.1,
            },
            "noise": 0.004,
            "time_offset_s": 0.02,
            "sigma_time_offset_s": 0.003,
        },
    },
    "cutting_edge": {
        "body": "bucket",
        "mount": {
            "xyz_m": [0.9, -0.9, 0.0],
            "rpy_deg": [0.0, 90.0, -45.0],
            "sigma_mm": 3.0,
            "sigma_deg": 0.2,
        },
        "width_m": 1.2,
    },
    "motion": {
        "cab": {"translation": 2e-4, "rotation": 5e-5},
        "stick": {"translation": 1e-3, "rotation": 4e-4},
        "bucket": {"translation": 1.0, "rotation": 3e-3},
    },
}
DRIFTING = copy.deepcopy(MACHINE)
"""The same with a potentiometer whose clock drifts, far more than any does: its logs last seconds."""
DRIFTING["sensors"]["pot"] |= {"clock_drift_ppm": 1000.0, "sigma_clock_drift_ppm": 10_000.0}
DRIFTING["motion"]["bucket"]["rotation"] = 3e-4
BUCKET_MARKER = {
    "family": "tag36h11",
    "tags": [{"id": 60, "size_m": 0.25, "x_m": -0.2}, {"id": 61, "size_m": 0.25, "x_m": 0.2}],
    "body": "bucket",
    # On the outside of the bucket, facing the cab.
    "mount": {"xyz_m": [-0.3, -0.5, 0.0], "rpy_deg": [0.0, -70.0, -90.0], "sigma_mm": 1.5, "sigma_deg": 0.1},
}


def board(first_id, enh, yaw):
    tags = [
        {"id": first_id + k, "size_m": 0.35, "x_m": x, "y_m": y}
        for k, (x, y) in enumerate([(-0.25, 0.25), (0.25, 0.25), (0.0, -0.25)])
    ]
    pose = {"enh": enh, "rpy_deg": [85.0, 0.0, yaw], "sigma_mm": 2.0, "sigma_deg": 0.05}
    return {"family": "tag36h11", "tags": tags, "pose": pose}


SITE = {
    "format": "gradetrace/site/1",
    "site": {"id": "sim"},
    "grid": {"unit": "m", "origin": [512_000, 4_123_000, 100]},
    "benchmarks": {
        "B1": board(0, [511_997.5, 4_123_009.0, 101.2], 25.0),
        "B2": board(3, [512_001.5, 4_123_010.0, 101.5], -30.0),
        "B3": board(6, [511_999.5, 4_123_012.0, 103.4], 20.0),
    },
    "alignment": {"points": [[512_000.0, 4_123_000.0], [512_000.0, 4_123_010.0]]},
    "design": {"file": "design.csv", "kind": "profile_csv"},
    "tolerance": {"high_mm": 30.0, "low_mm": 30.0},
}


@dataclass
class Options:
    """What to simulate."""

    epochs: int = 30
    frame_s: float = 0.2
    reading_s: float = 0.2
    bucket_marker: bool = False
    """A marker on the bucket."""
    potentiometer: bool = True
    outliers: float = 0.0
    """Share of corners thrown off by 3 to 20 px."""
    blind: tuple[tuple[float, float], ...] = ()
    """Intervals, seconds, in which the benchmarks are out of view."""
    constant: float = 0.0
    """Share of a corner's variance that is the same in all pictures of its tag by a camera."""
    resting: float = 0.0
    """Share that is drawn anew only when the tag's picture has moved by a pixel."""
    machine: dict = field(default_factory=lambda: copy.deepcopy(MACHINE))
    site: dict = field(default_factory=lambda: copy.deepcopy(SITE))


@dataclass
class Drawn:
    """One drawn network, with its truth."""

    machine: Machine
    site: Site
    network: Network
    observations: Observations
    readings: dict[str, Readings]
    time_ns: np.ndarray
    """(E,) every instant of the truth: frames and readings."""
    T_world: dict[str, np.ndarray]
    """Body or tool -> (E, 4, 4)."""
    statics: list[np.ndarray]
    """True value of every static of the network."""
    angle: np.ndarray

    frame_ns: np.ndarray
    """(F,) stamps of the frames; readings happen at times that only the truth knows to better than the offset."""

    def error(self, states):
        """Errors ``xi`` of a body (estimate to truth) at the frames, (F, 6), and the rows they belong to."""
        rows = np.flatnonzero(np.isin(states.time_ns, self.frame_ns))
        truth = self.T_world[states.body][np.searchsorted(self.time_ns, states.time_ns[rows])]
        return se3.local(states.T_world_body[rows], truth), rows

    @property
    def by_name(self) -> dict[str, np.ndarray]:
        """True value of every static by its name."""
        return {s.name: value for s, value in zip(self.network.statics, self.statics, strict=True)}


def exact(document):
    """The same file with every sigma of a static set to zero."""
    if isinstance(document, dict):
        return {
            key: ([0.0] * len(v) if isinstance(v, list) else 0.0) if key.startswith("sigma") else exact(v)
            for key, v in document.items()
        }
    if isinstance(document, list):
        return [exact(v) for v in document]
    return document


def draw(seed: int, options: Options | None = None) -> Drawn:
    """One network with drawn statics, motion, corners and readings."""
    o = options or Options()
    rng = np.random.default_rng(seed)
    document = copy.deepcopy(o.machine)
    if o.bucket_marker:
        document["markers"]["bucket"] = copy.deepcopy(BUCKET_MARKER)
    if not o.potentiometer:
        document.pop("sensors", None)
    machine, site = Machine.model_validate(document), Site.model_validate(o.site)
    network = network_of(machine, site)
    truth = [true_static(rng, static) for static in network.statics]
    by_name = {s.name: value for s, value in zip(network.statics, truth, strict=True)}

    frame_ns = T0_NS + np.round(np.arange(o.epochs) * o.frame_s * 1e9).astype(np.int64)
    reading_ns = np.array([], dtype=np.int64)
    if network.sensors:
        count = int(o.epochs * o.frame_s / o.reading_s)
        # Not in step with the frames: a jitter of up to a third of the interval.
        jitter = rng.uniform(0.2, 0.5, count) * o.reading_s
        reading_ns = T0_NS + np.round((np.arange(count) * o.reading_s + jitter) * 1e9).astype(np.int64)
    time_ns = np.union1d(frame_ns, reading_ns)
    t = (time_ns - T0_NS) * 1e-9
    motion = {name: machine.motion[name] for name in ("cab", "stick", "bucket")}
    T_cab = _wander(rng, level([0.0, 0.0, 1.5]), t, motion["cab"])
    T_dig_stick0 = se3.inverse(level([0.0, 0.0, 1.5]) @ machine.cameras["dig"].mount.transform()) @ level(
        [1.0, 6.0, 0.3]
    )
    T_camera_stick = _wander(rng, T_dig_stick0, t, motion["stick"])
    T_stick = T_cab @ by_name["camera dig mount"] @ T_camera_stick
    angle, _rate = _turn(rng, np.deg2rad(-15.0), t, motion["bucket"].rotation)
    T_bucket = T_stick @ by_name["joint bucket axis"] @ rotz(angle)
    T_world = {
        "cab": T_cab,
        "stick": T_stick,
        "bucket": T_bucket,
        "tool": T_bucket @ by_name["cutting edge mount"],
    }

    for name, body in network.bodies.items():
        if body.kind == "static":
            T_world[name] = np.broadcast_to(by_name[f"body {name} pose"], (len(t), 4, 4))

    readings = {}
    if network.sensors:
        turned = angle[np.searchsorted(time_ns, reading_ns)]
        readings["pot"] = potentiometer(rng, network, by_name, reading_ns, turned)
    observations = _look(rng, network, by_name, T_world, time_ns, frame_ns, o)
    return Drawn(machine, site, network, observations, readings, time_ns, T_world, truth, angle, frame_ns)


def true_static(rng, static: Static):
    """A draw from what the file says of a static."""
    values, vectors = np.linalg.eigh(static.covariance)
    error = vectors @ (np.sqrt(np.maximum(values, 0)) * rng.standard_normal(len(values)))
    return static.value @ se3.exp(error) if static.is_pose else static.value + error


def potentiometer(rng, network: Network, by_name, reading_ns, angle) -> Readings:
    """Raw readings of the cylinder at true instants and angles (n,), stamped as the sensor would."""
    params, (c0, c1) = by_name["sensor pot linkage"], by_name["sensor pot curve"]
    raw = (linkage.cylinder_length(angle, params, 1) - c0) / c1
    assert np.all(np.isfinite(raw))
    raw = raw + network.sensors[0].noise * rng.standard_normal(len(raw))
    # The stamp is earlier than the truth by the offset; the nominal one is in the file.
    late_s, drift = np.append(by_name["sensor pot time offset"], 0.0)[:2]
    since_ns = reading_ns - T0_NS
    return Readings(reading_ns - np.rint(late_s * 1e9 + 1e-6 * drift * since_ns).astype(np.int64), raw)


def marker_poses(network: Network, by_name, T_world, c: int, k: int, rows):
    """True ``T_camera_marker`` of a tag's marker at rows of the truth, (n, 4, 4)."""
    camera, marker = network.cameras[c], network.markers[network.tag_marker[k]]
    name = f"benchmark {marker.name} pose" if marker.benchmark else f"marker {marker.name} mount"
    T_world_camera = _of(T_world, camera.body, rows) @ by_name[f"camera {camera.name} mount"]
    return se3.inverse(T_world_camera) @ _of(T_world, marker.body, rows) @ by_name[name]


def pictures(network: Network, by_name, T_world, rows):
    """Every tag that a camera sees from its printed side, without noise: camera, tag, place in ``rows``, (4, 2) px."""
    for c, camera in enumerate(network.cameras):
        intrinsics = by_name[f"camera {camera.name} intrinsics"]
        for k in range(len(network.tag_marker)):
            for i, T in enumerate(marker_poses(network, by_name, T_world, c, k, rows)):
                p = se3.transform(T, network.tag_corners[k])
                if p[:, 2].min() < 0.5 or T[:3, 2] @ T[:3, 3] > -0.1 * np.linalg.norm(T[:3, 3]):
                    continue
                uv = picture(T, network.tag_corners[k], intrinsics)
                if (uv > 5).all() and (uv < np.array([camera.width, camera.height]) - 5).all():
                    yield c, k, i, uv


def observed(rows, variance_px2: float) -> Observations:
    """Observations from rows of camera, tag, stamp and (4, 2) corners."""
    n = len(rows)
    return Observations(
        *(np.array([row[j] for row in rows], dtype=np.int64) for j in range(3)),
        np.array([row[3] for row in rows]).reshape(n, 4, 2),
        np.broadcast_to(variance_px2 * np.eye(2), (n, 4, 2, 2)).copy(),
    )


def _look(rng, network, by_name, T_world, time_ns, frame_ns, o) -> Observations:
    blind = np.zeros(len(frame_ns), dtype=bool)
    for low, high in o.blind:
        t = o.frame_s * np.arange(len(frame_ns))
        blind |= (t >= low) & (t < high)
    out = []
    kept: dict[tuple[int, int], dict[str, np.ndarray]] = {}
    for c, k, i, uv in pictures(network, by_name, T_world, np.searchsorted(time_ns, frame_ns)):
        if network.markers[network.tag_marker[k]].benchmark and blind[i]:
            continue
        uv = uv + SIGMA_PX * _noise(rng, uv, kept.setdefault((c, k), {}), o)
        out.append((c, k, frame_ns[i], uv + gross(rng, (4,), o.outliers)))
    return observed(out, SIGMA_PX**2)


def gross(rng, shape, share: float):
    """By how much corners are off, (*shape, 2): that share of them by 3 to 20 px."""
    bad, away = rng.random(shape) < share, rng.uniform(0, 2 * np.pi, shape)
    size = bad * rng.uniform(3, 20, shape)
    return size[..., None] * np.stack([np.cos(away), np.sin(away)], axis=-1)


def _noise(rng, uv, kept, o):
    """Standard normal errors of four corners; ``kept`` holds what comes back, and where its stay began."""
    white = rng.standard_normal((4, 2))
    if o.constant + o.resting == 0:
        return white
    if "constant" not in kept:
        kept["constant"] = rng.standard_normal((4, 2))
    if "uv" not in kept or np.linalg.norm(uv - kept["uv"], axis=1).max() > 1.0:
        kept["uv"], kept["resting"] = uv, rng.standard_normal((4, 2))
    parts = (o.constant, kept["constant"]), (o.resting, kept["resting"])
    return np.sqrt(1 - o.constant - o.resting) * white + sum(np.sqrt(share) * e for share, e in parts)


def picture(T_camera_marker, p_marker, intrinsics):
    """Pixels of points on a marker, by OpenCV: (n, 2)."""
    fx, fy, cx, cy = intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    rvec, _ = cv2.Rodrigues(T_camera_marker[:3, :3])
    return cv2.projectPoints(p_marker, rvec, T_camera_marker[:3, 3], K, intrinsics[4:])[0][:, 0]


def _of(T_world, body, rows):
    return se3.identity((len(rows),)) if body == "world" else T_world[body][rows]


def level(xyz):
    return se3.from_rotation_translation(np.eye(3), np.array(xyz))


def rotz(angle):
    return se3.from_rotation_translation(so3.exp(angle[:, None] * np.array([0, 0, 1.0])), np.zeros(3))


def _step(rng, dt, density):
    """Integrated white noise over dt: errors of position and velocity, per axis of the densities."""
    Q = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.linalg.cholesky(Q) @ (rng.standard_normal((2, len(density))) * np.sqrt(density))


def _wander(rng, T, t, motion):
    density = np.repeat([motion.translation, motion.rotation], 3)
    w, out = np.zeros(6), [T]
    for dt in np.diff(t):
        e_pose, e_rate = _step(rng, dt, density)
        xi = dt * w + e_pose
        w = se3.Jr(xi) @ (w + e_rate)
        out.append(out[-1] @ se3.exp(xi))
    return np.array(out)


def _turn(rng, angle, t, density):
    a, w, out, rates = angle, 0.0, [angle], [0.0]
    for dt in np.diff(t):
        e_angle, e_rate = _step(rng, dt, np.array([density]))
        a, w = a + dt * w + e_angle[0], w + e_rate[0]
        out.append(a)
        rates.append(w)
    return np.array(out), np.array(rates)
