"""Sequences of pictures with tags that move, come, go and are covered; their corners are known.

Shares nothing with detection or with the synthetic site: prints come from `_tag_picture`, each pixel is the mean of
points of the scene, and a Gaussian blur, noise and JPEG follow. The camera stands, swings and swings back in a period
that closes on itself, so that a sequence can be looped. Pixel centres are whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import simplejpeg

from benchmarks._tag_picture import cells

RATE_HZ = 10
PERIOD = 320
"""Frames: 32 s."""
SWING_PX = 1000.0
FINE = 6
"""Points of the scene to a pixel, each way, no two of them in one row or column of it: three in line moved an edge that
runs along the pixels by up to a sixth of a pixel, and its corners by ten of their sigmas."""


@dataclass(frozen=True)
class Post:
    """A tag in the scene."""

    tag_id: int
    at: tuple[float, float]
    """Px in the panorama, or in the picture for one that the arm carries."""
    side_px: float
    turn: float
    """Its homography: how far it is rolled (rad) ..."""
    tilt: tuple[float, float]
    """... and how fast its scale changes across it, right and down."""
    carried: bool = False


@dataclass(frozen=True)
class Shot:
    """One picture."""

    jpeg: bytes
    tag_id: np.ndarray
    """(n,) of the tags that lie whole in the picture, covered or not."""
    uv: np.ndarray
    """(n, 4, 2) their corners."""


def scene(tags_in_view: int, size: tuple[int, int], seed: int) -> list[Post]:
    """Posts such that about so many are in view at any time, 25 to 110 px (at a width of 1280), one of them carried."""
    rng = np.random.default_rng(seed)
    width, height = size
    scale = width / 1280
    posts = [Post(0, (0.6 * width, 0.5 * height), 90.0 * scale, 0.2, (0.10, 0.05), carried=True)]
    columns = int(np.ceil((tags_in_view - 1) / 2))
    reach = width + SWING_PX * scale
    step = width / (tags_in_view - 1) * (1 if columns == 1 else 2)
    number = 1
    for x in np.arange(0.5 * step, reach, step):
        for row in range(1 if columns == 1 else 2):
            y = height * ((0.25, 0.75)[row] if columns > 1 else 0.3 + 0.4 * (number % 2))
            side = float(rng.uniform(25, 110 if columns == 1 else 90)) * scale
            away = rng.uniform(-0.05, 0.05, 2) * (width, height)
            tilt = rng.uniform(-0.2, 0.2, 2)
            posts.append(
                Post(
                    number,
                    (float(x + away[0]), float(y + away[1])),
                    side,
                    rng.uniform(-0.6, 0.6),
                    tuple(tilt),
                )
            )
            number += 1
    return posts


def sequence(
    tags_in_view: int, size: tuple[int, int] = (1280, 960), seed: int = 1, quality: int = 90
) -> list[Shot]:
    """The pictures of one period."""
    rng = np.random.default_rng([seed, tags_in_view])
    width, height = size
    scale = width / 1280
    posts = scene(tags_in_view, size, seed)
    panorama = texture(rng, int(width + SWING_PX * scale) + 40, height + 40)
    arm = 0.6 * texture(rng, int(0.18 * width), height) + 20
    noise = [rng.normal(0, 2.0, (height, width)).astype(np.float32) for _ in range(3)]
    shots = []
    for k in range(PERIOD):
        pan = pan_at(k) * SWING_PX * scale
        shake = 1.5 * np.sin(2 * np.pi * k * np.array([21, 34]) / PERIOD) + 10
        move = np.array([[1, 0, pan + shake[0]], [0, 1, shake[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        light = cv2.warpAffine(panorama, move, size, flags=flags)
        seen, corners = [], []
        for post in posts:
            H = _homography(post, k, pan, shake, size)
            uv = project(H, 0.5 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]))
            if _paste(light, post.tag_id, H) and np.all((uv >= 0) & (uv <= (width - 1, height - 1))):
                seen.append(post.tag_id)
                corners.append(uv)
        left = arm_at(k, width)
        if left is not None:
            a, b = max(left, 0), max(min(left + arm.shape[1], width), 0)
            if a < b:
                light[:, a:b] = arm[:, a - left : b - left]
        light = cv2.GaussianBlur(light, (0, 0), 0.7)
        x, y = rng.integers(0, width), rng.integers(0, height)
        light += np.roll(noise[k % 3], (int(y), int(x)), (0, 1))
        grey = np.clip(np.rint(light), 0, 255).astype(np.uint8)
        jpeg = simplejpeg.encode_jpeg(grey[..., None], quality=quality, colorspace="GRAY")
        shots.append(Shot(jpeg, np.array(seen, int), np.array(corners).reshape(-1, 4, 2)))
    return shots


def pan_at(k: int) -> float:
    """Where the camera points, 0 to 1: stands, swings for 3 s, stands, swings back."""

    def eased(x: float) -> float:
        x = min(max(x, 0.0), 1.0)
        return x * x * (3 - 2 * x)

    return eased((k - 120) / 30) - eased((k - 260) / 30)


def arm_at(k: int, width: int) -> int | None:
    """Left edge of what passes before the camera for some seconds; None most of the time."""
    return int(-0.2 * width + (k - 40) / 40 * 1.3 * width) if 40 <= k < 80 else None


def project(H: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(n, 2) points of a print -> px."""
    p = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    return np.asarray(p[:, :2] / p[:, 2:])


def _homography(post: Post, k: int, pan: float, shake: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(3, 3) print coordinates (x right, y up, the side is 1) -> px."""
    turn, side = post.turn, post.side_px
    u, v = post.at
    if post.carried:
        phase = 2 * np.pi * k / PERIOD
        u += 0.22 * size[0] * np.sin(3 * phase)
        v += 0.25 * size[1] * np.sin(2 * phase + 1)
        turn += 0.4 * np.sin(4 * phase)
        side *= 1 + 0.2 * np.sin(5 * phase)
    else:
        u, v = u - pan - shake[0], v - shake[1]
    c, s = side * np.cos(turn), side * np.sin(turn)
    near = np.array([[c, s, 0.0], [s, -c, 0.0], [post.tilt[0], post.tilt[1], 1.0]])
    return np.array([[1, 0, u], [0, 1, v], [0, 0, 1]]) @ near


def _paste(light: np.ndarray, tag_id: int, H: np.ndarray) -> bool:
    """Draw a tag into the scene; False if it lies outside."""
    print_, border = cells("tag36h11", tag_id)
    reach = 0.5 * len(print_) / border
    rim = project(H, reach * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]))
    height, width = light.shape
    low = np.maximum(np.floor(rim.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(rim.max(axis=0)).astype(int) + 2, (width, height))
    if np.any(high <= low):
        return False
    n = high - low
    u, v = np.arange(n[0] * FINE, dtype=np.float32), np.arange(n[1] * FINE, dtype=np.float32)[:, None]
    u, v = u + (v % FINE + 0.5) / FINE, v + (u % FINE + 0.5) / FINE
    u, v = low[0] + u / FINE - 0.5, low[1] + v / FINE - 0.5
    G = np.linalg.inv(H)
    w = G[2, 0] * u + G[2, 1] * v + G[2, 2]
    column = np.floor(((G[0, 0] * u + G[0, 1] * v + G[0, 2]) / w + reach) * border).astype(int)
    row = np.floor((reach - (G[1, 0] * u + G[1, 1] * v + G[1, 2]) / w) * border).astype(int)
    last = len(print_) - 1
    inside = (column >= 0) & (column <= last) & (row >= 0) & (row <= last)
    shade = 35 + 160 * print_[np.clip(row, 0, last), np.clip(column, 0, last)]
    blocks = (n[1], FINE, n[0], FINE)
    share = inside.reshape(blocks).mean(axis=(1, 3))
    part = (shade * inside).reshape(blocks).mean(axis=(1, 3))
    window = light[low[1] : high[1], low[0] : high[0]]
    window *= (1 - share).astype(np.float32)
    window += part.astype(np.float32)
    return True


def texture(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """(height, width) float32: something like ground, gravel and boards, without tags."""
    light = np.full((height, width), 105, np.float32)
    for cell, spread in ((120, 22), (40, 14), (12, 12), (4, 10), (2, 7)):
        coarse = rng.normal(0, spread, (height // cell + 3, width // cell + 3)).astype(np.float32)
        light += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(int(width * height / 40_000)):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        shade = float(rng.uniform(15, 235))
        kind = rng.integers(3)
        if kind == 0:
            corners = (x, y) + rng.normal(0, 18, (4, 2))
            cv2.fillConvexPoly(light, cv2.convexHull(np.rint(corners).astype(np.int32)), shade)
        elif kind == 1:
            a, b = rng.integers(6, 40, 2)
            cv2.rectangle(light, (x, y), (x + int(a), y + int(b)), shade, -1)
            cv2.rectangle(
                light, (x + int(a) // 4, y + int(b) // 4), (x + int(a) // 2, y + int(b) // 2), 255 - shade, -1
            )
        else:
            end = (x + int(rng.normal(0, 60)), y + int(rng.normal(0, 60)))
            cv2.line(light, (x, y), end, shade, int(rng.integers(1, 5)))
    return np.clip(light, 5, 250)
