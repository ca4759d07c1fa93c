"""Observations of any network of machine.toml and site.toml, drawn from a truth by code of its own.

Nothing here is the house's: the TOML is read as a plain dict, poses are 4x4 products of scipy rotations, pictures are
OpenCV's, the linkage is two circles that meet. The files hold nominal values; the truth differs from them by draws from
the files' own sigmas, and moves by sums of sines.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.config import load_machine, load_site
from pipeline.network import Network, Observations, Readings, network_of

FOLDER = Path(__file__).parents[2] / "docs" / "networks"
T0_NS = 1_700_000_000_000_000_000
SIGMA_PX = 0.2


@dataclass(frozen=True)
class Course:
    """How a body goes about: a pose in the world and how far it sways, or a joint's angle and how far it turns."""

    centre: object
    """Moving or static: x, y, z in the world, and optionally roll, pitch, yaw. Joint: degrees, or radians as a function
    of seconds (n,)."""
    sway: tuple[float, float] = (0.0, 0.0)
    """Metres and degrees; of a joint the second."""


@dataclass
class Scene:
    """One network on one day."""

    name: str
    courses: dict[str, Course]
    epochs: int = 150
    frame_s: float = 0.2
    late_s: dict[str, float] = field(default_factory=dict)
    """Cameras that are not triggered with the others."""
    reading_s: float = 0.05
    replaced: tuple[tuple[str, str], ...] = ()
    """Text of machine.toml that is replaced."""
    hidden: dict[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    """By marker or ``camera>marker``: intervals, seconds, in which something stands before it."""

    def files(self) -> tuple[str, str]:
        """Text of machine.toml and site.toml."""
        own = FOLDER / self.name / "site.toml"
        site = own if own.exists() else FOLDER / "site.toml"
        machine = (FOLDER / self.name / "machine.toml").read_text()
        for old, new in self.replaced:
            assert old in machine, old
            machine = machine.replace(old, new)
        return machine, site.read_text()


@dataclass
class Drawn:
    """What was seen, and what was so."""

    network: Network
    observations: Observations
    readings: dict[str, Readings]
    truth: dict
    """Body or ``tool`` -> function of seconds (n,) to T_world_body (n, 4, 4)."""

    def errors(self, states):
        """Errors ``[rho, phi]`` on the right of the estimate, (n, 6), from poses alone."""
        T, E = self.truth[states.body]((states.time_ns - T0_NS) * 1e-9), states.T_world_body
        rho = np.einsum("nji,nj->ni", E[:, :3, :3], T[:, :3, 3] - E[:, :3, 3])
        turned = np.swapaxes(E[:, :3, :3], -1, -2) @ T[:, :3, :3]
        return np.concatenate([rho, Rotation.from_matrix(turned).as_rotvec()], axis=1)


def draw(scene: Scene, seed: int, flips: float = 0.0) -> Drawn:
    """One truth of a scene, and what its cameras and sensors make of it.

    ``flips`` is the share of a marker's frames in which the picture is that of the marker in its other planar pose.
    """
    rng = np.random.default_rng(seed)
    texts = scene.files()
    network = network_of(load_machine(texts[0], "machine.toml"), load_site(texts[1], "site.toml"))
    machine, site = (tomllib.loads(text) for text in texts)
    origin = np.array(site["grid"]["origin"], dtype=float)

    def drawn_pose(entry, shift=0.0):
        T = _pose(np.array(entry.get("xyz_m", entry.get("enh"))) - shift, entry["rpy_deg"])
        mm, deg = (np.broadcast_to(entry[key], 3) for key in ("sigma_mm", "sigma_deg"))
        d = np.eye(4)
        d[:3, 3] = mm / 1000 * rng.standard_normal(3)
        d[:3, :3] = Rotation.from_rotvec(np.deg2rad(deg) * rng.standard_normal(3)).as_matrix()
        return T @ d

    axes = {n: drawn_pose(b["axis"]) for n, b in machine["bodies"].items() if b["kind"] == "joint"}
    waves = {name: _waves(rng, course) for name, course in scene.courses.items()}

    def body(name, t):
        if name == "world":
            return np.broadcast_to(np.eye(4), (len(t), 4, 4))
        entry = machine["bodies"][name]
        if entry["kind"] != "joint":
            return waves[name](t)
        belt = entry.get("follows", {"joint": name, "ratio": 1.0})
        turn = np.broadcast_to(np.eye(4), (len(t), 4, 4)).copy()
        angle = belt["ratio"] * waves[belt["joint"]](t)
        turn[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
        return body(entry["parent"], t) @ axes[name] @ turn

    marks = [(n, m["body"], drawn_pose(m["mount"]), m) for n, m in machine.get("markers", {}).items()]
    marks += [(n, "world", drawn_pose(b["pose"], origin), b) for n, b in site.get("benchmarks", {}).items()]
    tags = {int(i): k for k, i in enumerate(network.tag_id)}
    rows = []
    for c, (name, camera) in enumerate(machine["cameras"].items()):
        mount, lens = drawn_pose(camera["mount"]), camera["intrinsics"]
        nominal = np.array([*(lens[k] for k in ("fx", "fy", "cx", "cy")), *lens["distortion"]])
        lens = nominal + np.array(lens["sigma"]) * rng.standard_normal(9)
        stamps = T0_NS + np.round(
            (np.arange(scene.epochs) * scene.frame_s + scene.late_s.get(name, 0.0)) * 1e9
        ).astype(np.int64)
        t = (stamps - T0_NS) * 1e-9
        T_camera_world = np.linalg.inv(body(camera["body"], t) @ mount)
        for mark, host, place, document in marks:
            T = T_camera_world @ body(host, t) @ place
            gone = np.zeros(len(t), dtype=bool)
            for key in (mark, f"{name}>{mark}"):
                for low, high in scene.hidden.get(key, ()):
                    gone |= (t >= low) & (t < high)
            flipped = rng.random(len(t)) < flips if flips else np.zeros(len(t), dtype=bool)
            board = np.concatenate([_corners(tag) for tag in document["tags"]])
            for tag in document["tags"]:
                p = _corners(tag)
                for i in np.flatnonzero(~gone & _in_front(T, p)):
                    uv = _picture(_other_pose(T[i], board) if flipped[i] else T[i], p, lens)
                    if (uv > 5).all() and (uv < np.array([1275, 955])).all():
                        noisy = uv + SIGMA_PX * rng.standard_normal((4, 2))
                        rows.append((c, tags[tag["id"]], stamps[i], noisy))
    n = len(rows)
    observations = Observations(
        np.array([r[0] for r in rows]),
        np.array([r[1] for r in rows]),
        np.array([r[2] for r in rows]),
        np.array([r[3] for r in rows]).reshape(n, 4, 2),
        np.broadcast_to(SIGMA_PX**2 * np.eye(2), (n, 4, 2, 2)).copy(),
    )
    readings = {
        name: _readings(rng, sensor, waves[sensor["joint"]], scene)
        for name, sensor in machine.get("sensors", {}).items()
    }
    tool = drawn_pose(machine["cutting_edge"]["mount"])
    truth = {name: (lambda t, name=name: body(name, t)) for name in machine["bodies"]}
    truth["tool"] = lambda t: body(machine["cutting_edge"]["body"], t) @ tool
    return Drawn(network, observations, readings, truth)


def _pose(xyz, rpy_deg):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", np.array(rpy_deg, dtype=float)[::-1], degrees=True).as_matrix()
    T[:3, 3] = xyz
    return T


def _waves(rng, course: Course):
    """Poses or angles of a body as a function of time: three sines with periods of 9 to 25 s on each coordinate."""
    joint = np.isscalar(course.centre) or callable(course.centre)
    count = 1 if joint else 6
    speed = 2 * np.pi / rng.uniform(9.0, 25.0, (3, count))
    phase = rng.uniform(0, 2 * np.pi, (3, count))

    def swayed(t):
        return np.sum(np.sin(np.multiply.outer(t, speed) + phase), axis=1) / np.sqrt(3.0)

    if callable(course.centre):
        return course.centre
    if joint:
        return lambda t: np.deg2rad(course.centre + course.sway[1] * swayed(t)[:, 0])
    at = list(course.centre) + [0.0] * (6 - len(course.centre))
    centre = _pose(at[:3], at[3:])

    def poses(t):
        s = swayed(t) * np.repeat([course.sway[0], np.deg2rad(course.sway[1])], 3)
        T = np.broadcast_to(np.eye(4), (len(t), 4, 4)).copy()
        T[:, :3, 3], T[:, :3, :3] = s[:, :3], Rotation.from_rotvec(s[:, 3:]).as_matrix()
        return centre @ T

    return poses


def _corners(tag):
    h, x, y = tag["size_m"] / 2, tag.get("x_m", 0.0), tag.get("y_m", 0.0)
    return np.array([[x - h, y + h, 0], [x + h, y + h, 0], [x + h, y - h, 0], [x - h, y - h, 0.0]])


def _in_front(T, p):
    """Whether a print lies before the camera and is seen from its printed side, at less than 80 degrees."""
    centre = T[:, :3, :3] @ p.mean(0) + T[:, :3, 3]
    cosine = -np.sum(T[:, :3, 2] * centre, axis=1) / np.linalg.norm(centre, axis=1)
    return (centre[:, 2] > 0.5) & (cosine > 0.17)


def _picture(T, p, lens):
    fx, fy, cx, cy = lens[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    rvec = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return cv2.projectPoints(p, rvec, T[:3, 3], K, lens[4:])[0][:, 0]


def _other_pose(T, p):
    """The flip: the print mirrored about the line of sight to its centre, which a weak perspective cannot tell."""
    centre = T[:3, :3] @ p.mean(0) + T[:3, 3]
    sight = centre / np.linalg.norm(centre)
    out = T.copy()
    mirror = np.eye(3) - 2 * np.outer(sight, sight)
    out[:3, :3] = mirror @ T[:3, :3] @ np.diag([1.0, 1.0, -1.0])
    out[:3, 3] = centre - out[:3, :3] @ p.mean(0)
    return out


def _readings(rng, sensor, angle, scene: Scene) -> Readings:
    """Raw readings of a linear sensor, stamped early by the offset that was drawn."""
    c = sensor["curve"]
    coefficients = np.array(c["coefficients"]) + np.array(c["sigma"]) * rng.standard_normal(2)
    late_s = sensor.get("time_offset_s", 0) + sensor.get("sigma_time_offset_s", 0) * rng.standard_normal()
    t = np.arange(int(scene.epochs * scene.frame_s / scene.reading_s)) * scene.reading_s + 0.0071
    measured = np.rad2deg(angle(t))
    if "linkage" in sensor:
        bars, sigma = sensor["linkage"], sensor["linkage"]["sigma_mm"] / 1000
        anchor, pivot = (
            np.array(bars[k]) + sigma * rng.standard_normal(2)
            for k in ("cylinder_anchor_m", "rocker_pivot_m")
        )
        rocker, coupler, horn = (
            bars[k] + sigma * rng.standard_normal() for k in ("rocker_m", "coupler_m", "horn_m")
        )
        at = np.deg2rad(bars["horn_angle_deg"] + bars["sigma_horn_angle_deg"] * rng.standard_normal())
        tip = horn * np.stack([np.cos(angle(t) + at), np.sin(angle(t) + at)], axis=-1)
        # Two circles meet twice; pivot, meeting point and tip run clockwise about the branch +1.
        d = tip - pivot
        length = np.linalg.norm(d, axis=1, keepdims=True)
        along = (length**2 + rocker**2 - coupler**2) / (2 * length)
        height = bars["branch"] * np.sqrt(rocker**2 - along**2)
        meet = pivot + along * d / length + height * np.stack([-d[:, 1], d[:, 0]], axis=-1) / length
        measured = np.linalg.norm(meet - anchor, axis=1)
    raw = (measured - coefficients[0]) / coefficients[1] + sensor["noise"] * rng.standard_normal(len(t))
    return Readings(T0_NS + np.round((t - late_s) * 1e9).astype(np.int64), raw)
