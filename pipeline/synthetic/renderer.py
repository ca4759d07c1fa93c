"""Frames of the synthetic site.

Pixels are made from rays: each pixel's (or sub-pixel's) ray is undistorted once, and boards, ground and
horizon are looked up where it hits. Nothing here is shared with detection, nor with `pipeline.geometry.camera`:
that a corner of the truth lands where this renderer draws it is a test, not an assumption. The centre of the
top-left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.geometry import se3
from pipeline.synthetic import scenery
from pipeline.synthetic.cycle import Motion, bucket_pose
from pipeline.synthetic.excavator import Board, Mounts, along, arm_frame, board
from pipeline.synthetic.specification import Specification
from pipeline.synthetic.view import NEAREST_M, View, pixels, rays

COARSE = 8  # pixels between the rays at which ground and horizon are computed
SUN = np.array([0.35, -0.62, 0.70]) / np.linalg.norm([0.35, -0.62, 0.70])

# Side views in the links' own planes (x along the link, y up), half widths, grey in full sun.
BOOM = (((-0.15, -0.12), (-0.02, 0.22), (1.5, 0.74), (2.3, 0.76), (4.55, 0.17), (4.72, 0.0), (4.55, -0.15),
         (2.2, 0.26), (1.5, 0.24)), 0.21, 168.0)  # fmt: skip
STICK = (((-0.62, 0.14), (-0.45, 0.34), (0.25, 0.36), (2.42, 0.13), (2.56, 0.0), (2.42, -0.12), (0.1, -0.2),
          (-0.1, -0.12)), 0.15, 168.0)  # fmt: skip
BUCKET = (((-0.12, 0.0), (-0.26, 0.26), (-0.02, 0.46), (0.42, 0.56), (0.85, 0.42), (1.12, 0.14), (1.25, -0.01),
           (0.92, 0.02), (0.45, -0.1), (0.08, -0.12)), 0.5, 74.0)  # fmt: skip


@dataclass(frozen=True)
class Shade:
    """A shadow's edge that moves over a board."""

    board: str
    start_s: float
    end_s: float
    angle_deg: float
    depth: float = 0.5


class Renderer:
    """Renders any frame of one site; made once per process."""

    def __init__(self, spec: Specification, mounts: Mounts, motion: Motion, seed: int):
        cv2.setNumThreads(1)
        self.spec, self.mounts, self.motion = spec, mounts, motion
        self.seed = seed
        rng = np.random.default_rng([seed, 77])
        self.ground = scenery.ground(rng)
        self.panorama = scenery.panorama(rng)
        plans = [b.board for b in spec.benchmarks] + [spec.stick_board]
        self.boards: dict[str, Board] = {p.name: board(p, spec.family) for p in plans}
        self.textures = {name: scenery.board_texture(b, rng) for name, b in self.boards.items()}
        side = 512 + max(spec.width, spec.height) + 8
        mud = scenery.cloudy((side, side), 190, rng, 6)
        self.dirt = np.clip(1 + 0.07 * mud, 0.7, 1.25).astype(np.float32)
        self.noise = [
            rng.normal(size=(spec.height + 64, spec.width + 64)).astype(np.float32) for _ in range(3)
        ]
        self.rays = {c.name: rays(mounts.intrinsics[c.name], spec.width, spec.height) for c in spec.cameras}
        self.coarse = {
            c.name: rays(mounts.intrinsics[c.name], spec.width // COARSE, spec.height // COARSE, COARSE)
            for c in spec.cameras
        }
        y, x = np.mgrid[0 : spec.height, 0 : spec.width].astype(np.float32)
        r2 = ((x / spec.width - 0.5) ** 2 + (y / spec.height - 0.5) ** 2) * 2
        self.vignette = (1 - 0.13 * r2).astype(np.float32)
        self.supersample = 4 if spec.focal < 1200 else 3
        digs = [sweep.start_s for sweep in motion.sweeps]
        self.shades = [Shade(spec.stick_board.name, s + 0.5, s + 6.0, 20.0) for s in digs[1::3]]
        self.shades += [
            Shade(spec.benchmarks[0].board.name, s + 0.8, s + 6.5, -25.0, 0.42) for s in digs[2::4]
        ]
        self.phase = rng.uniform(0, 2 * np.pi, 3)

    def gain(self, t: float) -> float:
        """Exposure: clouds and the camera's own control."""
        p = self.phase
        return 0.93 + 0.09 * np.sin(2 * np.pi * t / 47 + p[0]) + 0.05 * np.sin(2 * np.pi * t / 13.7 + p[1])

    def exposure_s(self, t: float) -> float:
        """Time the shutter is open: longer where it is darker."""
        return 0.0022 - 0.0006 * np.sin(2 * np.pi * t / 47 + self.phase[0])

    def frame(self, camera: str, index: int, t: float) -> np.ndarray:
        """(H, W) uint8: one frame, whose stamp is the middle of its exposure at `t` seconds."""
        spec = self.spec
        half = 0.5 * self.exposure_s(t)
        ends = self._poses(np.array([t - half, t + half]))
        moved = self._moved_px(camera, ends)
        n = int(np.clip(np.ceil(moved / 0.6), 1, 6))
        times = t + half * (2 * (np.arange(n) + 0.5) / n - 1)
        poses = self._poses(times)
        scene = self._scene(camera, poses, 0, t)
        for k in range(1, n):
            scene += self._scene(camera, poses, k, t)
        if n > 1:
            scene *= 1.0 / n
        blur = spec.blur_px if spec.focal < 1200 else 1.15 * spec.blur_px
        picture: np.ndarray = np.asarray(cv2.GaussianBlur(scene, (7, 7), blur), np.float32)
        picture = picture * (self.vignette * np.float32(self.gain(t)))
        rng = np.random.default_rng([self.seed, 991, [c.name for c in spec.cameras].index(camera), index])
        x, y, which = rng.integers(0, 64), rng.integers(0, 64), rng.integers(0, 3)
        noise = self.noise[which][y : y + spec.height, x : x + spec.width]
        spread = np.sqrt(picture * np.float32(0.65 / 128) + np.float32(0.35))
        picture += spread * noise * np.float32(spec.noise * rng.choice([-1.0, 1.0]))
        return np.clip(picture + np.float32(0.5), 0, 255).astype(np.uint8)

    def _poses(self, t: np.ndarray) -> dict[str, np.ndarray]:
        p = self.motion.poses(t)
        stick = p.stick(self.spec)
        return {
            "cab": p.T_world_cab,
            "boom": p.T_world_cab
            @ arm_frame(p.boom_rad, np.array(self.spec.arm.foot) + 0 * along(p.boom_rad)),
            "stick": stick,
            "bucket": bucket_pose(stick, self.mounts.axis, p.joint_rad()),
        }

    def _moved_px(self, camera: str, ends: dict[str, np.ndarray]) -> float:
        """How far things move in the frame while the shutter is open."""
        T = ends["cab"] @ self.mounts.cameras[camera]
        turn = np.linalg.norm(se3.local(T[0], T[1])[3:])
        marker = se3.inverse(T) @ ends["stick"] @ self.mounts.stick_marker
        p = marker[:, :3, 3] / np.maximum(marker[:, 2:3, 3], 1.0)
        return float(self.spec.focal * max(turn, np.linalg.norm(p[1] - p[0]) if marker[0, 2, 3] > 1 else 0.0))

    def _scene(self, camera: str, poses: dict[str, np.ndarray], k: int, t: float) -> np.ndarray:
        T_world_camera = poses["cab"][k] @ self.mounts.cameras[camera]
        T_camera_world = se3.inverse(T_world_camera)
        size = (self.spec.width, self.spec.height)
        view = View(T_camera_world, self.mounts.intrinsics[camera], size, self.dirt)
        canvas = self._background(camera, T_world_camera)
        self._earthworks(view, canvas, t)
        self._posts(view, canvas)
        scene = canvas.astype(np.float32)
        for plan in self.spec.benchmarks:
            name = plan.board.name
            self._paste(camera, scene, name, T_camera_world @ self.mounts.benchmarks[name], t)
        self._machine(camera, view, scene, poses, k, t)
        return scene

    def _earthworks(self, view: View, canvas: np.ndarray, t: float) -> None:
        """What was dug so far."""
        self._trench(view, canvas, t)

    def _machine(
        self, camera: str, view: View, scene: np.ndarray, poses: dict[str, np.ndarray], k: int, t: float
    ) -> None:
        """The arm and what hangs on it."""
        self._arm(view, scene, poses, k)
        self._bracket(view, scene, poses["stick"][k])
        T_camera_marker = view.T_camera_world @ poses["stick"][k] @ self.mounts.stick_marker
        self._paste(camera, scene, self.spec.stick_board.name, T_camera_marker, t)

    def _background(self, camera: str, T_world_camera: np.ndarray) -> np.ndarray:
        spec = self.spec
        xy = self.coarse[camera]
        d = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ T_world_camera[:3, :3].T.astype(
            np.float32
        )
        flat = np.hypot(d[..., 0], d[..., 1])
        elevation = np.rad2deg(np.arctan2(d[..., 2], flat))
        centre = T_world_camera[:3, 2]
        ahead = np.arctan2(centre[1], centre[0])
        azimuth = np.arctan2(d[..., 1], d[..., 0]) - ahead
        azimuth = np.mod(azimuth + np.pi, 2 * np.pi) - np.pi + ahead  # no seam inside the frame
        height, width = scenery.PANORAMA_SHAPE
        u = -azimuth / (2 * np.pi) * width
        span = scenery.PANORAMA_HIGH_DEG - scenery.PANORAMA_LOW_DEG
        v = (scenery.PANORAMA_HIGH_DEG - elevation) / span * height - 0.5
        size = (spec.width, spec.height)
        u, v = (cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) for m in (u, v))
        u = np.mod(u, np.float32(width))
        picture = cv2.remap(self.panorama, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        if elevation.min() > -5.0:
            return picture
        drop = T_world_camera[2, 3] - spec.ground
        far = drop / np.maximum(-d[..., 2] / flat, 0.02) / flat
        scale = scenery.GROUND_PX_PER_M
        gx, gy = ((T_world_camera[i, 3] + d[..., i] * far) * scale for i in (0, 1))
        gx, gy = (cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) for m in (gx, gy))
        soil = cv2.remap(self.ground, gx, gy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        near = cv2.resize(np.clip((-4.0 - elevation) / 2.0, 0, 1).astype(np.float32), size)
        return cv2.blendLinear(soil, picture, near, 1 - near)

    def _trench(self, view: View, canvas: np.ndarray, t: float) -> None:
        """The open trench before the machine, and the heap beside it: hinted with a few faces."""
        spec, place = self.spec, self.motion.place
        begun = [s for s in self.motion.sweeps if t >= s.start_s]
        last = (begun[-1] if begun else self.motion.sweeps[0]).station
        near = last + (spec.sweep_m * np.clip((t - begun[-1].start_s - 1.2) / 3.6, 0, 1) if begun else 0.3)
        for s in begun[:-1]:
            near = max(near, s.station + spec.sweep_m)
        first = spec.first_station - 7.0
        w = 0.5 * spec.arm.width_m
        z = self.motion.floor(np.array([first, near]))
        g, wide = spec.ground, w + 0.12

        def quad(*corners: Sequence[float] | np.ndarray) -> np.ndarray:
            return np.array([place.point(c[0], c[1], c[2]) for c in corners])

        view.fill(canvas, quad((first, wide, g), (near, wide, g), (near, w, z[1]), (first, w, z[0])), 66)
        view.fill(canvas, quad((first, -wide, g), (near, -wide, g), (near, -w, z[1]), (first, -w, z[0])), 88)
        view.fill(canvas, quad((first, w, z[0]), (near, w, z[1]), (near, -w, z[1]), (first, -w, z[0])), 76)
        view.fill(canvas, quad((first, wide, g), (first, -wide, g), (first, -w, z[0]), (first, w, z[0])), 82)
        # The heap: slices one behind the other, each a lumpy profile, lit from the crest downwards.
        along_it = np.linspace(first, near + 1.0, 40)
        k = np.array([[1.0], [2.0], [3.0], [5.0]])
        lumps = np.sum(np.sin(1.9 * k * along_it + k * self.phase[0]) / k, axis=0)
        for across, tall, tone in ((4.0, 0.75, 92), (3.5, 0.95, 104), (2.9, 0.6, 113), (2.4, 0.3, 106)):
            crest = np.maximum(tall + 0.13 * lumps + 0.03 * np.sin(7 * along_it + across), 0.05)
            crest = crest * np.clip((near + 1.0 - along_it) / 1.5, 0, 1)
            ridge = np.stack([along_it, np.full_like(crest, -across * spec.side), g + crest], axis=-1)
            foot = np.stack(
                [along_it, np.full_like(crest, (0.5 - across) * spec.side), np.full_like(crest, g)], axis=-1
            )[::-1]
            view.fill(canvas, quad(*ridge, *foot), tone)

    def _posts(self, view: View, canvas: np.ndarray) -> None:
        for plan in self.spec.benchmarks:
            T = self.mounts.benchmarks[plan.board.name]
            b = self.boards[plan.board.name]
            for side in (-0.3, 0.3):
                top = se3.transform(T, np.array([side * b.size[0], 0.4 * b.size[1], -0.03]))
                across = T[:3, 0] * 0.045
                foot = np.array([top[0], top[1], self.spec.ground])
                view.fill(canvas, np.array([top - across, top + across, foot + across, foot - across]), 58)

    def _bracket(self, view: View, scene: np.ndarray, T_world_stick: np.ndarray) -> None:
        T = T_world_stick @ self.mounts.stick_marker
        x, y, _ = self.spec.stick_marker
        for dy in (-0.1, 0.1):
            rod = np.array([[x + dy, y - 0.03, -0.1], [x + dy + 0.05, y - 0.03, -0.1]])
            ends = se3.transform(T, np.array([[0.05 + dy, 0.0, -0.02], [dy, 0.0, -0.02]]))
            view.paint(scene, np.concatenate([se3.transform(T_world_stick, rod), ends]), 52)

    def _arm(self, view: View, scene: np.ndarray, poses: dict[str, np.ndarray], k: int) -> None:
        for name, (outline, half, tone) in (("bucket", BUCKET), ("stick", STICK), ("boom", BOOM)):
            T = poses[name][k]
            self._prism(view, scene, np.array(outline), half, tone, T)
            if name == "boom":  # cylinder of the stick on top of the boom
                self._rod(view, scene, T, (1.9, 0.86), (4.1, 0.62), 0.07)
            if name == "stick":
                self._rod(
                    view, scene, T, self.spec.arm.linkage[:2], (0.9, 0.42), 0.05, shift=self.spec.arm.stick_m
                )

    def _rod(self, view: View, scene: np.ndarray, T, start, end, half: float, shift: float = 0.0) -> None:
        a, b = (
            np.array([start[0] + shift, start[1]]),
            np.array(end if not shift else (start[0] + shift + end[0], end[1])),
        )
        d = (b - a) / np.linalg.norm(b - a)
        n = np.array([-d[1], d[0]]) * half
        self._prism(view, scene, np.array([a + n, b + n, b - n, a - n]), half, 96.0, T)

    def _prism(self, view: View, scene: np.ndarray, outline: np.ndarray, half: float, tone: float, T) -> None:
        """A part of the arm: its outline in the plane of the arm, as wide as it is."""
        eye = se3.transform(se3.inverse(T), view.eye)
        flat = np.concatenate([outline, np.zeros((len(outline), 1))], axis=1)
        right, left = flat + [0, 0, half], flat - [0, 0, half]
        area = np.sum(outline[:, 0] * np.roll(outline[:, 1], -1) - np.roll(outline[:, 0], -1) * outline[:, 1])
        faces = []
        for i in range(len(outline)):
            j = (i + 1) % len(outline)
            edge = outline[j] - outline[i]
            normal = np.array([edge[1], -edge[0], 0.0]) * np.sign(area)
            normal /= np.linalg.norm(normal)
            quad = np.array([right[i], right[j], left[j], left[i]])
            if normal @ (eye - quad[0]) > 0:
                faces.append((np.linalg.norm(quad.mean(0) - eye), quad, normal))
        for _, quad, normal in sorted(faces, key=lambda f: -f[0]):
            view.paint(scene, se3.transform(T, quad), _lit(tone, T[:3, :3] @ normal))
        side = 1.0 if eye[2] > 0 else -1.0
        if abs(eye[2]) > half:
            face = right if side > 0 else left
            view.paint(scene, se3.transform(T, face), _lit(tone, T[:3, :3] @ np.array([0, 0, side])))

    def _paste(
        self, camera: str, scene: np.ndarray, name: str, T_camera_marker: np.ndarray, t: float
    ) -> None:
        """A board, looked up for several rays in each pixel."""
        b = self.boards[name]
        R, p = T_camera_marker[:3, :3], T_camera_marker[:3, 3]
        if p[2] < NEAREST_M or R[:, 2] @ p > -0.05:
            return
        w, h = b.size
        corners = p + np.array([[-w, h], [w, h], [w, -h], [-w, -h]]) * 0.5 @ R[:, :2].T
        if corners[:, 2].min() < NEAREST_M:
            return
        uv = pixels(corners, self.mounts.intrinsics[camera])
        spec, s = self.spec, self.supersample
        u0, v0 = np.maximum(np.floor(uv.min(0)).astype(int) - 3, 0)
        u1, v1 = np.minimum(np.ceil(uv.max(0)).astype(int) + 4, (spec.width, spec.height))
        if u1 - u0 < 4 or v1 - v0 < 4:
            return
        texture, per_m = self.textures[name]
        H = np.linalg.inv(np.stack([R[:, 0], R[:, 1], p], axis=-1))  # ray -> (x, y, 1) on the print
        to_texel = np.array(
            [[per_m, 0, 0.5 * texture.shape[1] - 0.5], [0, -per_m, 0.5 * texture.shape[0] - 0.5], [0, 0, 1]]
        )
        ray = self.rays[camera][v0:v1, u0:u1]
        fine = cv2.resize(ray, None, fx=s, fy=s, interpolation=cv2.INTER_LINEAR)
        x, y = _through(to_texel @ H, fine)
        print_ = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = (
            (x > -0.5) & (x < texture.shape[1] - 0.5) & (y > -0.5) & (y < texture.shape[0] - 0.5)
        ).astype(np.float32)
        size = (u1 - u0, v1 - v0)
        cover = cv2.resize(inside, size, interpolation=cv2.INTER_AREA)
        light = cv2.resize(print_ * inside, size, interpolation=cv2.INTER_AREA)
        normal = self._board_normal(name, R, camera)
        factor = np.float32(0.72 + 0.28 * max(0.0, normal))
        for shade in self.shades:
            if shade.board == name and shade.start_s < t < shade.end_s:
                light *= self._shadow(shade, H, ray, b, t)
        patch = scene[v0:v1, u0:u1]
        patch *= 1 - cover
        patch += light * factor

    def _board_normal(self, name: str, R: np.ndarray, camera: str) -> float:
        if name in self.mounts.benchmarks:
            return float(self.mounts.benchmarks[name][:3, 2] @ SUN)
        return 0.5

    def _shadow(self, shade: Shade, H: np.ndarray, ray: np.ndarray, b: Board, t: float) -> np.ndarray:
        x, y = _through(H, ray)
        a = np.deg2rad(shade.angle_deg)
        reach = 0.8 * max(b.size)
        at = -reach + 2 * reach * (t - shade.start_s) / (shade.end_s - shade.start_s)
        band = 0.35 * b.size[0]  # a bar of shadow, as of a boom or a cable drum, not half the world
        d = x * np.float32(np.cos(a)) + y * np.float32(np.sin(a)) - np.float32(at)
        dark = np.clip((band - np.abs(d)) / 0.03 + 0.5, 0, 1)
        return (1 - shade.depth * dark).astype(np.float32)


def _through(H: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The plane coordinates (float32 arrays) that rays hit."""
    h = H.astype(np.float32)
    x, y = ray[..., 0], ray[..., 1]
    scale = 1 / (h[2, 0] * x + h[2, 1] * y + h[2, 2])
    return (h[0, 0] * x + h[0, 1] * y + h[0, 2]) * scale, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) * scale


def _lit(tone: float, normal: np.ndarray) -> float:
    return float(tone * (0.5 + 0.5 * max(0.0, float(normal @ SUN))))
