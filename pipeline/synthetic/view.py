"""A camera of the synthetic site: its lens, and how it projects and fills faces.

Nothing here is shared with detection, nor with `pipeline.geometry.camera`. The centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.geometry import se3

NEAREST_M = 0.25


class View:
    """A camera at one instant: projects and fills faces."""

    def __init__(
        self, T_camera_world: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], dirt: np.ndarray
    ):
        self.T_camera_world = T_camera_world
        self.eye = se3.inverse(T_camera_world)[:3, 3]
        self.intrinsics = intrinsics
        self.size = size
        self.dirt = dirt

    def outline(self, p_world: np.ndarray) -> np.ndarray | None:
        """Pixels of a face's outline with what is behind the camera cut away; None if nothing is left."""
        p = se3.transform(self.T_camera_world, p_world)
        kept: list[np.ndarray] = []
        for a, b in zip(p, np.roll(p, -1, axis=0)):
            if a[2] > NEAREST_M:
                kept.append(a)
            if (a[2] > NEAREST_M) != (b[2] > NEAREST_M):
                kept.append(a + (b - a) * (NEAREST_M - a[2]) / (b[2] - a[2]))
        if len(kept) < 3:
            return None
        # Beyond the picture the polynomial of the lens folds back: there a plain pinhole will do.
        uv = pixels(np.array(kept), self.intrinsics, wide=True)
        width, height = self.size
        if uv[:, 0].max() < 0 or uv[:, 1].max() < 0 or uv[:, 0].min() > width or uv[:, 1].min() > height:
            return None
        return np.clip(uv, -4000, 4000)

    def fill(self, canvas: np.ndarray, p_world: np.ndarray, tone: float) -> None:
        """Fill a face on a uint8 canvas, keeping a little of the texture below."""
        uv = self.outline(p_world)
        if uv is None:
            return
        x0, y0, x1, y1 = self._box(uv)
        if x1 <= x0 or y1 <= y0:
            return
        patch = canvas[y0:y1, x0:x1]
        mask = np.zeros(patch.shape, np.uint8)
        cv2.fillPoly(mask, [_fixed(uv - [x0, y0])], 255, cv2.LINE_AA, 4)
        rough = patch.astype(np.float32) * 0.35 + (tone - 0.35 * 112)
        blend = mask.astype(np.float32) / 255
        patch[:] = np.clip(patch * (1 - blend) + rough * blend, 0, 255).astype(np.uint8)

    def paint(self, scene: np.ndarray, p_world: np.ndarray, tone: float) -> None:
        """Fill a face of one tone on a float scene."""
        uv = self.outline(p_world)
        if uv is None:
            return
        x0, y0, x1, y1 = self._box(uv)
        if x1 <= x0 or y1 <= y0:
            return
        mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
        cv2.fillPoly(mask, [_fixed(uv - [x0, y0])], 255, cv2.LINE_AA, 4)
        blend = mask.astype(np.float32) / 255
        patch = scene[y0:y1, x0:x1]
        patch *= 1 - blend
        # Mud and glare: a face is never of one tone. The pattern slides with the face's first corner.
        rows, columns = mask.shape
        x, y = (int(v) % 512 for v in uv[0])
        dirt = self.dirt[y : y + rows, x : x + columns]
        patch += blend * (dirt * np.float32(tone))

    def _box(self, uv: np.ndarray) -> tuple[int, int, int, int]:
        x0, y0 = np.maximum(np.floor(uv.min(0)).astype(int) - 1, 0)
        x1, y1 = np.minimum(np.ceil(uv.max(0)).astype(int) + 2, self.size)
        return int(x0), int(y0), int(x1), int(y1)


def pixels(p_camera: np.ndarray, intrinsics: np.ndarray, wide: bool = False) -> np.ndarray:
    """Pixels (n, 2) of points (n, 3) before the camera."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = intrinsics
    x, y = p_camera[:, 0] / p_camera[:, 2], p_camera[:, 1] / p_camera[:, 2]
    r2 = x * x + y * y
    if wide:
        r2 = np.minimum(r2, 0.35)
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + (0 if wide else 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
    v = y * radial + (0 if wide else p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    return np.stack([fx * u + cx, fy * v + cy], axis=-1)


def rays(intrinsics: np.ndarray, columns: int, rows: int, step: int = 1) -> np.ndarray:
    """(rows, columns, 2) float32: x/z and y/z of the rays through the centres of blocks of `step` pixels."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = intrinsics
    u = (np.arange(columns) + 0.5) * step - 0.5
    v = (np.arange(rows) + 0.5) * step - 0.5
    xd, yd = np.meshgrid((u - cx) / fx, (v - cy) / fy)
    x, y = xd.copy(), yd.copy()
    for _ in range(60):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x, y = (
            (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
            (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    return np.stack([x, y], axis=-1).astype(np.float32)


def _fixed(uv: np.ndarray) -> np.ndarray:
    return np.round(uv * 16).astype(np.int32)
