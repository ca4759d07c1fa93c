"""Pictures of what stands around: ground, horizon, printed boards. Grey levels 0..255 in full sun."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.synthetic.excavator import Board

GROUND_PX_PER_M = 96
GROUND_SIDE = 2048
PANORAMA_SHAPE = (1536, 6144)
PANORAMA_LOW_DEG, PANORAMA_HIGH_DEG = -25.0, 65.0
CELL_TEXELS = 20
BLACK, WHITE = 22.0, 205.0
DICTIONARIES = {
    "tag36h11": (cv2.aruco.DICT_APRILTAG_36h11, 8),
    "tag25h9": (cv2.aruco.DICT_APRILTAG_25h9, 7),
    "tag16h5": (cv2.aruco.DICT_APRILTAG_16h5, 6),
}


def cloudy(shape: tuple[int, int], scale: float, rng: np.random.Generator, octaves: int = 5) -> np.ndarray:
    """Smooth noise that tiles, mean 0, standard deviation 1; the largest blobs are `scale` pixels."""
    total: np.ndarray = np.zeros(shape, np.float32)
    for octave in range(octaves):
        cell = max(scale / 2**octave, 1.0)
        rows, columns = max(int(shape[0] / cell), 2), max(int(shape[1] / cell), 2)
        coarse = rng.normal(size=(rows, columns)).astype(np.float32)
        y = ((np.arange(shape[0]) + 0.5) * rows / shape[0] - 0.5).astype(np.float32)
        x = ((np.arange(shape[1]) + 0.5) * columns / shape[1] - 0.5).astype(np.float32)
        padded = cv2.copyMakeBorder(coarse, 2, 2, 2, 2, cv2.BORDER_WRAP)
        fine = cv2.remap(
            padded, np.tile(x + 2, (shape[0], 1)), np.tile(y[:, None] + 2, (1, shape[1])), cv2.INTER_CUBIC
        )
        total += fine * 0.62**octave
    return (total - total.mean()) / total.std()


def ground(rng: np.random.Generator) -> np.ndarray:
    """Bare soil with gravel, a tile of `GROUND_SIDE` pixels that repeats, uint8."""
    shape = (GROUND_SIDE, GROUND_SIDE)
    soil: np.ndarray = 112 + 9 * cloudy(shape, 700, rng, 4) + 7 * cloudy(shape, 60, rng, 4)
    stones = rng.integers(0, GROUND_SIDE, (2600, 2))
    for (x, y), size, tone in zip(stones, rng.gamma(2.0, 1.7, 2600), rng.normal(0, 26, 2600)):
        axes = (int(1 + size), int(1 + 0.6 * size))
        cv2.ellipse(soil, (int(x), int(y)), axes, int(x) % 180, 0, 360, float(118 + tone), -1, cv2.LINE_AA)
    for _ in range(5):  # ruts of the tracks of other machines
        x = rng.integers(0, GROUND_SIDE)
        band = slice(x, x + 50)
        soil[:, band] -= (
            10 * np.sin(np.arange(GROUND_SIDE) * 2 * np.pi / 16)[:, None] * np.hanning(soil[:, band].shape[1])
        )
    return np.clip(cv2.GaussianBlur(soil, (0, 0), 1.1), 0, 255).astype(np.uint8)


def panorama(rng: np.random.Generator) -> np.ndarray:
    """Sky, a wood, a hedge and far fields all around the horizon, uint8; columns are azimuth, rows elevation."""
    height, width = PANORAMA_SHAPE
    per_deg = height / (PANORAMA_HIGH_DEG - PANORAMA_LOW_DEG)
    elevation = PANORAMA_HIGH_DEG - (np.arange(height) + 0.5) / per_deg
    sky = 196 - 0.55 * np.clip(elevation, 0, 65)[:, None] + np.zeros((1, width))
    sky += 7 * cloudy(PANORAMA_SHAPE, 700, rng, 4)
    picture = sky.astype(np.float32)
    leaves = cloudy(PANORAMA_SHAPE, 26, rng, 5)
    for base, tall, green, rough in ((5.5, 1.6, 92, 260), (3.1, 1.2, 70, 120), (1.4, 0.5, 84, 40)):
        outline = base + tall * cloudy((4, width), rough, rng, 5)[1]
        steep = (outline[None, :] - elevation[:, None]) * per_deg / 1.5
        inside = 1 / (1 + np.exp(-np.clip(steep, -40, 40)))
        tree = green + 11 * leaves + 5 * np.sin(elevation)[:, None]
        picture = picture * (1 - inside) + tree * inside
    field = (elevation < -0.6)[:, None]
    far = 116 + 5 * cloudy(PANORAMA_SHAPE, 90, rng, 3)
    picture = np.where(field, far, picture)
    for _ in range(9):  # site huts and containers before the wood
        x, w = int(rng.integers(0, width - 200)), int(rng.integers(50, 170))
        top, bottom = (int((PANORAMA_HIGH_DEG - e) * per_deg) for e in (rng.uniform(0.8, 2.2), -1.0))
        picture[top:bottom, x : x + w] = rng.uniform(70, 175)
        picture[top:bottom, x : x + w : 9] -= 14
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.8), 0, 255).astype(np.uint8)


def tag_cells(family: str, tag: int) -> np.ndarray:
    """(n, n) cells of a tag with its black border, 1 white, top row first."""
    dictionary, n = DICTIONARIES[family]
    printed = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(dictionary), int(tag), n * 8)
    return (printed[4::8, 4::8] > 127).astype(np.float32)


def board_texture(board: Board, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """The print of a board and its texels per metre.

    Each texel holds the mean over its area, so that an edge which falls inside a texel keeps its place.

    Returns
    -------
    (h, w) float32 array
        Grey levels in full sun.
    float
        Texels per metre; the texture is centred on the marker's origin.
    """
    n = DICTIONARIES[board.family][1]
    per_m = CELL_TEXELS * n / board.tag_m
    width, height = (int(np.ceil(side * per_m)) for side in board.size)
    texture = np.full((height, width), WHITE, np.float32)
    for tag, (x, y) in zip(board.ids, board.centres):
        left = (x - 0.5 * board.tag_m) * per_m + 0.5 * width
        top = (-y - 0.5 * board.tag_m) * per_m + 0.5 * height
        across, down = _overlap(width, left, n), _overlap(height, top, n)
        ink = (1 - tag_cells(board.family, int(tag))) * (WHITE - BLACK)
        texture -= down @ ink @ across.T
    # Dust and sun have been at the print: broad stains, no edges.
    texture *= 0.975 + 0.012 * cloudy(texture.shape, 260, rng, 3)
    return np.clip(texture, 0, 255).astype(np.float32), per_m


def _overlap(texels: int, start: float, cells: int) -> np.ndarray:
    """(texels, cells) share of each texel that lies in each cell."""
    low = np.arange(texels)[:, None]
    begin = start + np.arange(cells)[None, :] * CELL_TEXELS
    return np.clip(np.minimum(low + 1, begin + CELL_TEXELS) - np.maximum(low, begin), 0, 1).astype(np.float32)
