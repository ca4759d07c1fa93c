"""The paper's Fig. 12: a cluster of two cameras, a board before each, and how far off the depth between them comes out.

One camera looks at a surveyed board, the other, at a right angle, at the board whose depth is wanted. Pictures are
rendered and then go the whole way: searched, refined, judged, adjusted. Lenses, the mount between the cameras and
the survey are wrong by draws from the sigmas that their files state, which are those of the sample logs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from benchmarks import _light
from benchmarks._tag_picture import compress
from pipeline.config import Machine, Site
from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import ACCEPTED, judge
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.refine import Refiner
from pipeline.detection.seen import search
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.optimise import optimise
from pipeline.geometry import se3, so3
from pipeline.network import Network, Observations, network_of
from pipeline.network import frames as fr
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from pipeline.synthetic import scenery
from pipeline.synthetic.excavator import Board
from pipeline.synthetic.view import pixels, rays
from tests.estimation.simulator import T0_NS, true_static

FAMILY = "tag36h11"
WIDTH, HEIGHT, FOCAL = 1280, 960, 1731.0
SUPERSAMPLE = 3
BLUR_PX, NOISE, QUALITY = 0.7, 2.5, 90
HUBER = 3.0


@dataclass(frozen=True)
class Arrangement:
    """One of Fig. 12(b)."""

    pitch_deg: float = 20.0
    """Of the wanted board, leaning back."""
    height_m: float = 0.0
    """Of its centre above the cameras."""
    distance_m: float = 8.0
    """From its camera."""
    tags: int = 4
    """On it."""


TAG_M, GAP_M = 0.2, 0.06
BENCH_TAG_M, BENCH_M = 0.3, 7.0
PLACES = {1: [(0, 0)], 2: [(-1, 0), (1, 0)], 3: [(-1, 1), (1, 1), (-1, -1)],
          4: [(-1, 1), (1, 1), (-1, -1), (1, -1)]}  # fmt: skip


def described(first_id: int, size_m: float, count: int) -> list[dict]:
    """Tags of a board as the files have them."""
    half = 0.5 * (size_m + GAP_M)
    return [
        {"id": first_id + k, "size_m": size_m, "x_m": x * half, "y_m": y * half}
        for k, (x, y) in enumerate(PLACES[count])
    ]


def lens() -> dict:
    """Intrinsics as a calibration leaves them."""
    return {
        "width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": 639.5, "cy": 479.5,
        "distortion": [-0.08, 0.02, 0.0003, -0.0002, 0.0],
        "sigma": [0.5, 0.5, 0.25, 0.25, 0.002, 0.006, 0.0001, 0.0001, 0.0],
    }  # fmt: skip


def network(at: Arrangement) -> Network:
    """The cluster on a body that moves, the wanted board on another; its centre is the edge."""
    exact = {"xyz_m": [0.0, 0.0, 0.0], "rpy_deg": [0.0, 0.0, 0.0], "sigma_mm": 0.0, "sigma_deg": 0.0}
    level = {"xyz_m": [0.0, 0.0, 0.0], "rpy_deg": [-90.0, 0.0, 0.0], "sigma_mm": 0.0, "sigma_deg": 0.0}
    beside = {"xyz_m": [0.3, -0.1, 0.0], "rpy_deg": [-90.0, 0.0, -90.0], "sigma_mm": 1.0, "sigma_deg": 0.01}
    machine = {
        "format": "gradetrace/machine/1",
        "machine": {"id": "cluster"},
        "bodies": {"cab": {"kind": "moving"}, "plate": {"kind": "moving"}},
        "cameras": {
            "bench": {"topic": "/a", "body": "cab", "mount": level, "intrinsics": lens()},
            "arm": {"topic": "/b", "body": "cab", "mount": beside, "intrinsics": lens()},
        },
        "markers": {"plate": {"family": FAMILY, "body": "plate", "mount": exact, "tags": described(1, TAG_M, at.tags)}},
        "cutting_edge": {"body": "plate", "mount": exact, "width_m": 1.0},
    }  # fmt: skip
    pose = {"enh": [0.3, BENCH_M, 100.3], "rpy_deg": [80.0, 0.0, 25.0], "sigma_mm": 1.0, "sigma_deg": 0.02}
    site = {
        "format": "gradetrace/site/1",
        "site": {"id": "yard"},
        "grid": {"unit": "m", "origin": [0, 0, 100]},
        "benchmarks": {"B": {"family": FAMILY, "tags": described(10, BENCH_TAG_M, 4), "pose": pose}},
        "alignment": {"points": [[0.0, 0.0], [0.0, 10.0]]},
        "design": {"file": "design.csv", "kind": "profile_csv"},
        "tolerance": {"high_mm": 25.4, "low_mm": 25.4},
    }
    return network_of(Machine.model_validate(machine), Site.model_validate(site))


def plate(at: Arrangement, rng: np.random.Generator) -> np.ndarray:
    """``T_world_plate``: to the right of the cluster, facing it, leaning back."""
    place = np.array([at.distance_m, rng.uniform(-0.3, 0.3), at.height_m])
    # Print: x to the viewer's right (south, as it looks east), y up, z towards the viewer (west).
    R = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    lean = so3.exp(np.deg2rad(-at.pitch_deg) * np.array([1.0, 0, 0]))
    turn = so3.exp(np.deg2rad(rng.uniform(-15, 15)) * np.array([0, 1.0, 0]))
    roll = so3.exp(np.deg2rad(rng.uniform(-8, 8)) * np.array([0, 0, 1.0]))
    return se3.from_rotation_translation(R @ turn @ lean @ roll, place)


def board_of(net: Network, name: str) -> Board:
    """The print of a marker, to be drawn."""
    k = next(k for k, m in enumerate(net.markers) if m.name == name)
    tags = np.flatnonzero(net.tag_marker == k)
    corners = net.tag_corners[tags]
    side = float(np.linalg.norm(corners[0, 1] - corners[0, 0]))
    reach = np.abs(corners[..., :2]).max(axis=(0, 1)) + 0.05
    return Board(
        name, FAMILY, net.tag_id[tags], corners[..., :2].mean(axis=1), side, (2 * reach[0], 2 * reach[1])
    )


@cache
def background() -> np.ndarray:
    """(H, W) float32: the surroundings, to be shifted."""
    return _light.texture((HEIGHT, WIDTH), 1, np.random.default_rng(9)).astype(np.float32)


@cache
def _print(name: str, tag_m: float, ids: tuple[int, ...]) -> tuple[np.ndarray, float]:
    count = len(ids)
    at = Arrangement(tags=count) if name == "plate" else Arrangement()
    return scenery.board_texture(board_of(network(at), name), np.random.default_rng(8))


def _outline(board: Board, T_camera_marker, intrinsics) -> tuple[int, int, int, int]:
    """Columns and rows, from and to, of the rectangle that holds a board."""
    R, p = T_camera_marker[:3, :3], T_camera_marker[:3, 3]
    w, h = board.size
    rim = p + 0.5 * np.array([[-w, h], [w, h], [w, -h], [-w, -h]]) @ R[:, :2].T
    uv = pixels(rim, intrinsics)
    (u0, v0), (u1, v1) = np.floor(uv.min(0)).astype(int) - 4, np.ceil(uv.max(0)).astype(int) + 5
    return int(u0), int(v0), int(u1), int(v1)


def in_view(board: Board, T_camera_marker, intrinsics) -> bool:
    """Whether the whole board is in the picture."""
    u0, v0, u1, v1 = _outline(board, T_camera_marker, intrinsics)
    return u0 >= 0 and v0 >= 0 and u1 < WIDTH and v1 < HEIGHT


def rendered(board: Board, T_camera_marker, intrinsics, rng: np.random.Generator) -> np.ndarray:
    """(H, W) uint8: a board before some texture, through a lens, with noise and JPEG."""
    light = np.roll(background(), rng.integers(0, 400, 2), axis=(0, 1))
    texture, per_m = _print(board.name, board.tag_m, tuple(board.ids.tolist()))
    R, p = T_camera_marker[:3, :3], T_camera_marker[:3, 3]
    to_texel = np.array(
        [[per_m, 0, 0.5 * texture.shape[1] - 0.5], [0, -per_m, 0.5 * texture.shape[0] - 0.5], [0, 0, 1]]
    )
    H = to_texel @ np.linalg.inv(np.stack([R[:, 0], R[:, 1], p], axis=-1))
    # Only where the board is, with some rays in each pixel.
    u0, v0, u1, v1 = _outline(board, T_camera_marker, intrinsics)
    cut = np.array(intrinsics)
    cut[2:4] -= u0, v0
    cut[:2] *= SUPERSAMPLE
    cut[2:4] = (cut[2:4] + 0.5) * SUPERSAMPLE - 0.5
    fine = rays(cut, (u1 - u0) * SUPERSAMPLE, (v1 - v0) * SUPERSAMPLE).astype(float)
    h_fine = np.einsum("ij,...j->...i", H, np.concatenate([fine, np.ones((*fine.shape[:2], 1))], axis=-1))
    x, y = (h_fine[..., k] / h_fine[..., 2] for k in (0, 1))
    # Small tags have many texels in a ray; a blurred print is what the ray would have seen.
    print_ = cv2.GaussianBlur(texture, (0, 0), max(0.35 * per_m * p[2] / (FOCAL * SUPERSAMPLE), 0.3))
    shown = cv2.remap(
        print_, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    inside = ((x > -0.5) & (x < texture.shape[1] - 0.5) & (y > -0.5) & (y < texture.shape[0] - 0.5)).astype(
        np.float32
    )
    size = (u1 - u0, v1 - v0)
    cover = cv2.resize(inside, size, interpolation=cv2.INTER_AREA)
    light[v0:v1, u0:u1] *= 1 - cover
    light[v0:v1, u0:u1] += rng.uniform(0.75, 0.95) * cv2.resize(
        shown * inside, size, interpolation=cv2.INTER_AREA
    )
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), BLUR_PX), np.float32)
    grey = np.clip(np.rint(light + rng.normal(0, NOISE, light.shape)), 0, 255).astype(np.uint8)
    return compress(grey, QUALITY)


SET_UPS = 100
"""Of which one at least has both boards in view."""


@dataclass(frozen=True)
class Depth:
    """One trial; metres."""

    error_m: float
    """Found minus true difference of elevation of the two boards; nan where a board was not found."""
    tags: int
    """Accepted of the wanted board."""


def trial(at: Arrangement, finder: TagFinder, rng: np.random.Generator) -> Depth:
    """One arrangement drawn, rendered, detected and adjusted."""
    net = network(at)
    truth = {s.name: true_static(rng, s) for s in net.statics}
    # Whoever sets this up sees to it that both boards are in the pictures.
    for _ in range(SET_UPS):
        T_cab = se3.exp(np.r_[rng.uniform(-0.1, 0.1, 3), rng.normal(0, 0.02, 3)])
        T_plate = plate(at, rng)
        markers = {"B": truth["benchmark B pose"], "plate": T_plate}
        views = [
            (board_of(net, name), se3.inverse(T_cab @ truth[f"camera {camera} mount"]) @ markers[name],
             truth[f"camera {camera} intrinsics"])
            for camera, name in (("bench", "B"), ("arm", "plate"))
        ]  # fmt: skip
        if all(in_view(*view) for view in views):
            break
    rows, known = [], {FAMILY: set(net.tag_id.tolist())}
    for c, view in enumerate(views):
        grey = rendered(*view, rng)
        seen = search(grey, finder, Refiner(net.statics[net.cameras[c].intrinsics].value))
        accepted = judge(seen, known, DetectionSettings()) == ACCEPTED
        for k in np.flatnonzero(accepted):
            tag = int(net.tag_index([FAMILY], [int(seen.tag_id[k])])[0])
            blocks = np.array([seen.cov[k][2 * j : 2 * j + 2, 2 * j : 2 * j + 2] for j in range(4)])
            rows.append((c, tag, seen.uv[k], blocks))
    wanted = sum(1 for row in rows if row[0] == 1)
    if wanted == 0 or wanted == len(rows):
        return Depth(float("nan"), wanted)
    pictures = Observations(
        np.array([r[0] for r in rows]),
        np.array([r[1] for r in rows]),
        np.full(len(rows), T0_NS),
        np.array([r[2] for r in rows]),
        np.array([r[3] for r in rows]),
    )
    tied = tie(net, pictures, {})
    problem = problem_of_log(net, tied, epochs_of(net, pictures.take(tied.used), {}))
    values = optimise(problem, HUBER, 40).values
    _, T = fr.along(tied.frames.path(fr.WORLD, fr.TOOL), lambda e: values.edge_pose(problem.statics, e))
    z_bench = net.statics[next(m.mount for m in net.markers if m.benchmark)].value[2, 3]
    found = np.reshape(T, (4, 4))[2, 3] - z_bench
    true = T_plate[2, 3] - truth["benchmark B pose"][2, 3]
    return Depth(float(found - true), wanted)
