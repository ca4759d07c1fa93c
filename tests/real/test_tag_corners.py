"""Recordings of hand-held cameras among tags, with the answer of another solver of cameras and tags beside them.

One tag is held where that answer has it; all others, and the mounts of all cameras but the first, are left out of the
files, so that the log alone tells them. Most lenses are fisheyes (equidistant): corners are carried over into a pinhole
picture of the same focal length, each with the covariance that makes a pixel there what it was in the recording.
"""

import csv
import json
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipeline.config import Machine, Site
from pipeline.estimation import adjust
from pipeline.geometry import camera as camera_model
from pipeline.geometry import se3, so3
from pipeline.network import Observations, network_of

pytestmark = pytest.mark.real

OURS_IN_THEIRS = [3, 2, 1, 0]
SIGMA_PX = {"test_1": 0.4, "test_2": 0.3, "test_21": 0.2}
"""What the corners of each recording scatter by."""
LINE_MM, LINE_DEG = 5.0, 0.5
BEYOND = {"test_21": (8, (5, 6, 7, 9, 15, 19, 25))}
"""A tag of the upper flight of stairs, and the others there: 35 to 50 pictures of three tie them to the lower one."""
WIDEST_RAD = np.deg2rad(75.0)
"""Beyond, a pixel of the recording is fifteen of the pinhole picture along the radius."""
PAIRED_NS = 25_000_000
"""Their solver takes cameras to be synchronous: a frame is compared with its nearest pose of the rig within this."""


@dataclass
class Recording:
    """Detections of one recording and the other solver's answer."""

    cameras: list
    intrinsics: list
    """Per camera: fx fy cx cy, distortion."""
    fisheye: list
    sigma_px: float
    sizes: dict
    """Tag -> side, m."""
    fixed: int
    camera: np.ndarray
    tag: np.ndarray
    time_ns: np.ndarray
    uv: np.ndarray
    """(n, 4, 2) px in our order of corners."""
    T_world_tag: dict
    T_rig_camera: list
    rig_ns: np.ndarray
    T_world_rig: np.ndarray

    def with_cameras(self, count):
        """The same recording, of the first few cameras only."""
        rows = self.camera < count
        of_rows = {k: getattr(self, k)[rows] for k in ("camera", "tag", "time_ns", "uv")}
        lists = {k: getattr(self, k)[:count] for k in ("cameras", "intrinsics", "fisheye", "T_rig_camera")}
        return replace(self, **of_rows, **lists)


def recording(folder) -> Recording:
    lenses = _lenses((folder / "cameras.yaml").read_text())
    plan = (folder / "tagslam.yaml").read_text()
    listed = [(int(tag), float(size)) for tag, size in re.findall(r"- id: (\d+)\s+size: ([\d.]+)", plan)]
    edges = json.loads((folder / "reference_tf_last.json").read_text())
    last = {(e["parent"], e["child"]): _pose(e["xyz_qxqyqzqw"]) for e in edges}
    body = next(child for parent, child in last if parent == "map" and child != "rig")
    tags = {
        int(child[4:]): T
        for (parent, child), T in last.items()
        if parent == body and child.startswith("tag_")
    }
    names = sorted(lenses)
    topics = [lenses[n]["tagtopic"] for n in names]
    rows = [r for r in _rows(folder / "detections.csv") if int(r["tag_id"]) in tags]
    uv = np.array([[float(r[f"{a}{k}"]) for k in range(4) for a in "xy"] for r in rows]).reshape(-1, 4, 2)
    odom = sorted(_rows(folder / "reference_odom.csv"), key=lambda r: int(r["stamp_ns"]))
    T_map_rig = np.array(
        [_pose([float(r[k]) for k in ("x", "y", "z", "qx", "qy", "qz", "qw")]) for r in odom]
    )
    default = float(re.search(r"default_tag_size: ([\d.]+)", plan)[1])
    sizes = dict.fromkeys(tags, default) | {tag: size for tag, size in listed if tag in tags}
    return Recording(
        names,
        [np.array([*lenses[n]["intrinsics"], *lenses[n]["distortion_coeffs"]]) for n in names],
        [lenses[n]["distortion_model"] == "equidistant" for n in names],
        SIGMA_PX[folder.name],
        sizes,
        listed[0][0],
        np.array([topics.index(r["topic"]) for r in rows]),
        np.array([int(r["tag_id"]) for r in rows]),
        np.array([int(r["stamp_ns"]) for r in rows]),
        uv[:, OURS_IN_THEIRS],
        tags,
        [last["rig", n] for n in names],
        np.array([int(r["stamp_ns"]) for r in odom]),
        se3.inverse(last["map", body]) @ T_map_rig,
    )


def _rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _lenses(text):
    """Camera -> the entries of its lens in the other program's file."""
    found = {}
    for part in re.split(r"^(?=cam\d)", text, flags=re.M)[1:]:
        entries = dict(re.findall(r"^ +(\w+): *(.+)$", part, flags=re.M))
        numbers = {k: json.loads(entries[k]) for k in ("intrinsics", "distortion_coeffs")}
        found[part.split(":")[0]] = entries | numbers
    return found


def _pose(numbers):
    return se3.from_rotation_translation(so3.from_quaternion(np.array(numbers[3:])), np.array(numbers[:3]))


def _bent(theta, k):
    return theta * (1 + theta**2 * (k[0] + theta**2 * (k[1] + theta**2 * (k[2] + theta**2 * k[3]))))


def project(p, intrinsics, fisheye):
    """Pixels of the recording's own camera model, (..., 2)."""
    if not fisheye:
        return camera_model.project(p, intrinsics)
    r = np.hypot(p[..., 0], p[..., 1])
    theta = np.arctan2(r, p[..., 2])
    scale = _bent(theta, intrinsics[4:]) / np.maximum(r, 1e-12)
    return intrinsics[:2] * scale[..., None] * p[..., :2] + intrinsics[2:4]


def straightened(uv, intrinsics):
    """Pinhole pixels of a fisheye's, (n, 2), how they change with them, (n, 2, 2), and the angle off the axis, (n,)."""

    def rays(uv):
        xy = (uv - intrinsics[2:4]) / intrinsics[:2]
        bent = np.hypot(xy[:, 0], xy[:, 1])
        theta = bent.copy()
        for _ in range(20):
            slope = (_bent(theta + 1e-6, intrinsics[4:]) - _bent(theta - 1e-6, intrinsics[4:])) / 2e-6
            theta = theta - (_bent(theta, intrinsics[4:]) - bent) / slope
        return np.tan(theta)[:, None] * xy / np.maximum(bent, 1e-12)[:, None], theta

    J = np.stack([(rays(uv + d)[0] - rays(uv - d)[0]) / 2e-3 for d in 1e-3 * np.eye(2)], axis=-1)
    xy, theta = rays(uv)
    return xy * intrinsics[:2] + intrinsics[2:4], intrinsics[:2, None] * J, theta


def network_and_observations(rec: Recording):
    """Our description of a recording, everything but the fixed tag and the first camera's mount left out."""
    exact = {"sigma_mm": 0.0, "sigma_deg": 0.0}
    at_rest = {"xyz_m": [0.0] * 3, "rpy_deg": [0.0] * 3, **exact}
    cameras, uv, cov, keep = {}, rec.uv.copy(), np.empty(rec.uv.shape + (2,)), np.ones(len(rec.tag), bool)
    for c, name in enumerate(rec.cameras):
        rows, lens = np.flatnonzero(rec.camera == c), rec.intrinsics[c]
        J = np.broadcast_to(np.eye(2), (4 * len(rows), 2, 2))
        if rec.fisheye[c]:
            straight, J, theta = straightened(rec.uv[rows].reshape(-1, 2), lens)
            uv[rows] = straight.reshape(-1, 4, 2)
            keep[rows] = (theta < WIDEST_RAD).reshape(-1, 4).all(axis=1)
        cov[rows] = rec.sigma_px**2 * (J @ np.swapaxes(J, -1, -2)).reshape(-1, 4, 2, 2)
        values = dict(zip(("fx", "fy", "cx", "cy"), lens[:4].tolist(), strict=True))
        distortion = [0.0] * 5 if rec.fisheye[c] else lens[4:].tolist()
        cameras[name] = {
            "topic": f"/{name}",
            "body": "rig",
            "intrinsics": {
                "width": 1280,
                "height": 1024,
                **values,
                "distortion": distortion,
                "sigma": [0.0] * 9,
            },
        }
    cameras[rec.cameras[0]]["mount"] = at_rest
    machine = {
        "format": "gradetrace/machine/1",
        "machine": {"id": "hand"},
        "bodies": {"rig": {"kind": "moving"}},
        "cameras": cameras,
        "cutting_edge": {"body": "rig", "mount": at_rest, "width_m": 1.0},
        "motion": {"rig": {"translation": 30.0, "rotation": 100.0}},  # a hand: hardly any prior
    }
    held = rec.T_world_tag[rec.fixed]
    pose = {"enh": held[:3, 3].tolist(), "rpy_deg": so3.to_rpy_deg(held[:3, :3]).tolist(), **exact}
    site = {
        "format": "gradetrace/site/1",
        "site": {"id": "recorded"},
        "grid": {"unit": "m", "origin": [0, 0, 0]},
        "benchmarks": {
            f"T{tag}": {"family": "tag36h11", "tags": [{"id": tag, "size_m": size}]}
            | ({"pose": pose} if tag == rec.fixed else {})
            for tag, size in rec.sizes.items()
        },
        "alignment": {"points": [[0.0, 0.0], [1.0, 0.0]]},
        "design": {"file": "design.csv", "kind": "profile_csv"},
        "tolerance": {"high_mm": 30.0, "low_mm": 30.0},
    }
    network = network_of(Machine.model_validate(machine), Site.model_validate(site))
    tag = network.tag_index(["tag36h11"] * len(rec.tag), rec.tag)
    return network, Observations(rec.camera, tag, rec.time_ns, uv, cov).take(keep), keep


def reprojection(rec: Recording, T_world_rig, T_rig_camera, T_world_tag):
    """Distance of every corner from where it was seen, px of the recording: (n, 4); ``T_world_rig`` is (n, 4, 4)."""
    off = np.empty(rec.uv.shape[:2])
    for c in range(len(rec.cameras)):
        for tag, size in rec.sizes.items():
            rows = np.flatnonzero((rec.camera == c) & (rec.tag == tag))
            corners = 0.5 * size * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
            T = se3.inverse(T_world_rig[rows] @ T_rig_camera[c]) @ T_world_tag[tag]
            p = se3.transform(T[:, None], corners)
            off[rows] = np.linalg.norm(rec.uv[rows] - project(p, rec.intrinsics[c], rec.fisheye[c]), axis=-1)
    return off


def nearest(time_ns, at):
    """Index of the nearest stamp, and whether it is within ``PAIRED_NS``."""
    right = np.clip(np.searchsorted(time_ns, at), 1, len(time_ns) - 1)
    row = np.where(at - time_ns[right - 1] < time_ns[right] - at, right - 1, right)
    return row, np.abs(time_ns[row] - at) <= PAIRED_NS


def rms(off):
    return float(np.sqrt(np.mean(np.square(off))))


@pytest.mark.parametrize(
    ("name", "cameras"),
    [("test_1", 1), ("test_2", 2), pytest.param("test_21", 4, marks=pytest.mark.slow), ("test_21", 2)],
    ids=str,
)
def test_tags_lie_where_another_solver_has_them_and_reproject_no_worse(real_data, name, cameras):
    """Within 5 mm and 0.5 deg, after fixing the same tag; on test_21's stairs one tag in each flight.

    From the lower flight, all of the upper one is turned by 0.6 to 1 deg, 6 to 22 mm, which our sigma of 0.5 deg
    foretells: the other solver had inertial odometry there, which the recording does not carry, and took cameras 9
    ms apart as one. Where it puts them the corners lie worse, by plain least squares too; the two fisheyes alone,
    which tick together, lead to the same answer as all four cameras.
    """
    rec = recording(real_data / "tag_corners" / name).with_cameras(cameras)
    network, observations, keep = network_and_observations(rec)
    solution = adjust(network, observations, {})
    assert solution.diagnostics["converged"]
    assert not [w for w in solution.warnings if "left out" in w]
    rig, statics = solution.body("rig"), {r.quantity: r for r in solution.statics}
    tags = {tag: statics[f"benchmark T{tag} pose"] for tag in rec.sizes}
    T_world_tag = {tag: _of_table(r) for tag, r in tags.items()}
    T_rig_camera = [_of_table(statics[f"camera {c} mount"]) for c in rec.cameras]
    row, there = nearest(rec.rig_ns, rec.time_ns)
    theirs = reprojection(rec, rec.T_world_rig[row], rec.T_rig_camera, rec.T_world_tag)
    at, published = nearest(rig.time_ns, rec.time_ns)
    ours = reprojection(rec, rig.T_world_body[at], T_rig_camera, T_world_tag)
    both = keep & there & published
    print(
        f"{name}: {np.sum(both)} tags in pictures, RMS {rms(ours[both]):.3f} px, theirs {rms(theirs[both]):.3f}"
    )
    assert np.mean(both) > 0.7
    assert rms(ours[both]) <= rms(theirs[both])
    pivot, others = BEYOND.get(name, (None, ()))
    for tag in sorted(set(rec.sizes) - {rec.fixed}):
        fixed = pivot if tag in others else rec.fixed
        off = se3.local(
            se3.inverse(rec.T_world_tag[fixed]) @ rec.T_world_tag[tag],
            se3.inverse(T_world_tag[fixed]) @ T_world_tag[tag],
        )
        mm, deg = 1000 * np.linalg.norm(off[:3]), np.rad2deg(np.linalg.norm(off[3:]))
        sigma_mm = 1000 * np.linalg.norm(tags[tag].sigma[:3])
        sigma_deg = np.rad2deg(np.linalg.norm(tags[tag].sigma[3:]))
        rows = both & (rec.tag == tag)
        print(
            f"  tag {tag:3d} by {fixed:3d}: {mm:5.2f} mm, {deg:5.3f} deg (sigma by {rec.fixed}: {sigma_mm:5.2f}, "
            f"{sigma_deg:5.3f}); RMS {rms(ours[rows]):.3f} px, theirs {rms(theirs[rows]):.3f}, {np.sum(rows)} pictures"
        )
        if tag == pivot:
            assert mm < 3 * sigma_mm and deg < 3 * sigma_deg, tag
        else:
            assert mm < LINE_MM and deg < LINE_DEG, tag


def _of_table(result):
    return se3.from_rotation_translation(so3.exp(result.value[3:]), result.value[:3])
