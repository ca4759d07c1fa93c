"""What lies around, over and in front of a rendered tag: texture, things that cover it, shadow, glare, lens, response.

All of it works on the fine grid of `_tag_picture`, whose cells are ``1 / fine`` px wide; pixel centres are whole
numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from benchmarks._tag_picture import View

COVERS = ("half-plane", "disc", "strip", "blob")


def texture(shape: tuple[int, int], fine: int, rng: np.random.Generator) -> np.ndarray:
    """Grey values like ground and machine: grains from 2 to 40 px and a few patches with hard edges."""
    height, width = shape
    light = np.full(shape, rng.uniform(70, 150), np.float32)
    for grain_px, strength in ((2, 8), (5, 12), (14, 16), (40, 25)):
        few = (int(width / fine / grain_px) + 3, int(height / fine / grain_px) + 3)
        light += cv2.resize(rng.normal(0, strength, few[::-1]).astype(np.float32), (width, height))
    for _ in range(rng.integers(1, 4)):
        middle = rng.uniform(0, 1, 2) * (width, height)
        patch = middle + rng.normal(0, 0.3, (3, 2)) * (width, height)
        cv2.fillConvexPoly(light, np.rint(patch).astype(np.int32), float(rng.uniform(30, 200)))
    return np.clip(light, 5, 250)


def fall(view: View, light: np.ndarray, uv: np.ndarray, fine: int, rng: np.random.Generator) -> np.ndarray:
    """The light with what covers the tag, the slope across it, a shadow's edge and glare; linear in grey values."""
    light = decode(light, view.gamma)
    if not (view.covered or view.slope or view.shadow != 1 or view.glare):
        return light
    centre, side = uv.mean(axis=0), float(np.linalg.norm(np.roll(uv, -1, 0) - uv, axis=1).max())
    v, u = ((np.arange(n, dtype=np.float32) + 0.5) / fine - 0.5 for n in light.shape)
    u, v = (
        ((u - centre[0]) / side).astype(np.float32)[None],
        ((v - centre[1]) / side).astype(np.float32)[:, None],
    )
    if view.covered:
        light = _cover(view, light, (uv - centre) / side, u, v, fine, rng)
    if view.slope:
        angle = np.deg2rad(view.slope_deg)
        light = light * (1 + (view.slope * np.cos(angle) * u + view.slope * np.sin(angle) * v))
    if view.shadow != 1:
        angle, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4)
        light = np.where(np.cos(angle) * u + np.sin(angle) * v > offset, view.shadow, 1.0) * light
    if view.glare:
        at, width = rng.uniform(-1, 1, 2), rng.uniform(0.4, 1.2)
        spot = np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * width**2))
        light = light + view.glare * (0.25 + 0.75 * spot)
    return light.astype(np.float32)


def _cover(view, light, quad, u, v, fine, rng) -> np.ndarray:
    """Something of random shape and grey over the given share of the tag; lengths in sides."""
    kind = COVERS[rng.integers(len(COVERS))]
    angle = rng.uniform(0, 2 * np.pi)
    cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    at = rng.uniform(-0.6, 0.6, 2).astype(np.float32)
    if kind == "half-plane":
        field = cos * u + sin * v
    elif kind == "disc":
        field = (u - at[0]) ** 2 + (v - at[1]) ** 2
    elif kind == "strip":
        field = np.abs(cos * (u - at[0]) + sin * (v - at[1]))
    else:
        few = int(rng.integers(4, 9))
        bumps = rng.normal(size=(few, few)).astype(np.float32)
        field = cv2.resize(bumps, light.shape[::-1], interpolation=cv2.INTER_CUBIC)
        field += (u - at[0]) ** 2 + (v - at[1]) ** 2
    # On a coarse grid: which share of the tag lies below each level of the field.
    step = max(1, fine // 2)
    x, y = np.broadcast_arrays(u[:, ::step], v[::step])
    on_tag = np.ones(x.shape, bool)
    for a, b in zip(quad, np.roll(quad, -1, axis=0)):
        on_tag &= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0
    level = np.quantile(field[::step, ::step][on_tag], view.covered)
    choice = rng.integers(5)
    if choice < 3:
        # Any grey, or just the print's own white or black: those mislead most.
        cover = (rng.uniform(10, 240), view.white, view.black)[choice]
    elif choice == 3:
        cover = texture(light.shape, fine, rng)
    else:
        period = rng.uniform(0.1, 0.5)
        cover = np.where(
            (cos * v - sin * u) % period < period / 2, rng.uniform(10, 120), rng.uniform(120, 240)
        )
    return np.where(field < level, cover, light).astype(np.float32)


def blur(view: View, light: np.ndarray, fine: int) -> np.ndarray:
    """The light after the lens, Gaussian and disc, and after the way it went while the shutter was open."""
    if view.blur_px > 0:
        light = cv2.GaussianBlur(
            light, _odd(5 * view.blur_px * fine), view.blur_px * fine, borderType=cv2.BORDER_REPLICATE
        )
    if view.disc_px > 0:
        light = _filtered(light, _disc(view.disc_px * fine))
    if view.motion_px > 0:
        light = _filtered(light, _line(view.motion_px * fine, view.motion_deg))
    return light


def _odd(half: float) -> tuple[int, int]:
    n = 2 * int(np.ceil(half)) + 1
    return n, n


def _filtered(light: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    return cv2.filter2D(light, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE)


def _disc(radius: float) -> np.ndarray:
    n, parts = int(np.ceil(radius)) + 1, 8
    at = (np.arange((2 * n + 1) * parts) + 0.5) / parts - 0.5 - n
    inside = (np.hypot(at[None], at[:, None]) < radius).astype(np.float32)
    kernel = inside.reshape(2 * n + 1, parts, 2 * n + 1, parts).mean(axis=(1, 3))
    return kernel / kernel.sum()


def _line(length: float, angle_deg: float) -> np.ndarray:
    """A box along a direction, each point shared among its four neighbours so that its place is kept."""
    n = int(np.ceil(length / 2)) + 1
    steps = 8 * int(np.ceil(length)) + 1
    s = ((np.arange(steps) + 0.5) / steps - 0.5) * length
    x, y = n + s * np.cos(np.deg2rad(angle_deg)), n + s * np.sin(np.deg2rad(angle_deg))
    kernel = np.zeros((2 * n + 1, 2 * n + 1))
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    for dj, wj in ((0, 1 - (x - j)), (1, x - j)):
        for di, wi in ((0, 1 - (y - i)), (1, y - i)):
            np.add.at(kernel, (i + di, j + dj), wi * wj)
    return (kernel / kernel.sum()).astype(np.float32)


def encode(light: np.ndarray, gamma: float) -> np.ndarray:
    """Grey values of linear light; those over 255 are left for the noise to be added first."""
    return light if gamma == 1 else 255 * (np.maximum(light, 0) / 255) ** (1 / gamma)


def decode(grey: Any, gamma: float) -> Any:
    """Linear light of grey values."""
    return grey if gamma == 1 else 255 * (np.maximum(grey, 0) / 255) ** gamma
