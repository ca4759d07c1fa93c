"""A calibration board waved before a camera: pictures whose lens is known, without anything of the calibration in them.

As in `renderer`, pixels are made from rays: each pixel's rays are undistorted once and looked up where they hit the
print. The board's origin is its first corner, x to the right and y down on the print.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.geometry import se3, so3
from pipeline.synthetic import scenery
from pipeline.synthetic.view import rays

SQUARE_TEXELS = 56
BLACK, WHITE = 25.0, 205.0
SUPERSAMPLE = 3


@dataclass(frozen=True)
class PrintedBoard:
    """A chessboard (without tags) or a ChArUco board."""

    columns: int = 11
    """Squares."""
    rows: int = 8
    square_m: float = 0.06
    tag_share: float = 0.0
    """Side of a tag over that of its square; 0 for a plain chessboard."""
    dictionary: str = "DICT_5X5_250"
    margin: float = 1.0
    """White around the squares, in squares."""

    @property
    def text(self) -> str:
        """As `gradetrace calibrate intrinsics --board` takes it."""
        if not self.tag_share:
            return f"chessboard:{self.columns - 1}x{self.rows - 1}:{self.square_m:g}"
        tag = self.tag_share * self.square_m
        return f"charuco:{self.columns}x{self.rows}:{self.square_m:g}:{tag:g}:{self.dictionary}"

    @property
    def size_m(self) -> tuple[float, float]:
        """Of the squares, without the margin."""
        return self.columns * self.square_m, self.rows * self.square_m

    def texture(self) -> np.ndarray:
        """The print, float32 grey values; the first inner corner lies on the seam of texels."""
        n = SQUARE_TEXELS
        row, column = np.mgrid[0 : self.rows, 0 : self.columns]
        squares = np.where((row + column) % 2 == 0, BLACK, WHITE)
        picture = np.kron(squares, np.ones((n, n)))
        if self.tag_share:
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
            cells = int(dictionary.markerSize) + 2
            side = round(self.tag_share * n / cells) * cells
            assert abs(side - self.tag_share * n) < 1e-9 and (n - side) % 2 == 0, "cells are not whole texels"
            for tag, (i, j) in enumerate(np.argwhere(squares == WHITE)):
                drawn = dictionary.generateImageMarker(tag, side) / 255.0
                y, x = i * n + (n - side) // 2, j * n + (n - side) // 2
                picture[y : y + side, x : x + side] = BLACK + (WHITE - BLACK) * drawn
        edge = round(self.margin * n)
        return np.pad(picture, edge, constant_values=WHITE).astype(np.float32)


class WavedBoard:
    """Renders views of one board by one camera."""

    def __init__(self, board: PrintedBoard, intrinsics: np.ndarray, size: tuple[int, int], seed: int):
        cv2.setNumThreads(1)
        self.board, self.intrinsics, self.size, self.seed = board, intrinsics, size, seed
        self.print_ = board.texture()
        self.rays = rays(intrinsics, *size)
        width, height = size
        fine = cv2.resize(
            self.rays, (SUPERSAMPLE * width, SUPERSAMPLE * height), interpolation=cv2.INTER_LINEAR
        )
        self.fine = fine
        rng = np.random.default_rng([seed, 31])
        self.wall = (95 + 18 * scenery.cloudy((height, width), 200, rng, 5)).astype(np.float32)
        x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
        self.vignette = (1 - 0.07 * (x**2 + y**2)).astype(np.float32)

    def poses(self, count: int, alike: bool = False) -> np.ndarray:
        """(count, 4, 4) ``T_camera_board``: the board over all of the picture, near and far, tilted every way.

        `alike`: all parallel to the picture and at one distance, as somebody does who has not read the page.
        """
        rng = np.random.default_rng([self.seed, 32])
        width, height = self.size
        middle = np.array([*self.board.size_m, 0.0]) / 2 - [self.board.square_m, self.board.square_m, 0]
        found: list[np.ndarray] = []
        while len(found) < count:
            share = 0.5 if alike else rng.uniform(0.35, 0.9)
            z = self.intrinsics[0] * self.board.size_m[0] / (share * width)
            uv = rng.uniform([0.2 * width, 0.2 * height], [0.8 * width, 0.8 * height])
            way = rng.uniform(0, 2 * np.pi)
            tilt = np.deg2rad(0.5 if alike else rng.uniform(5, 42))
            R = so3.exp(tilt * np.array([np.cos(way), np.sin(way), 0.0]))
            R = R @ so3.exp(np.array([0, 0, 0.0 if alike else rng.normal(0, 0.25)]))
            ray = self.rays[int(uv[1]), int(uv[0])]
            centre = z * np.array([ray[0], ray[1], 1.0])
            T = se3.from_rotation_translation(R, centre - R @ middle)
            if self._mostly_in_view(T):
                found.append(T)
        return np.array(found)

    def picture(
        self, index: int, T_camera_board: np.ndarray, blur_px: float = 0.7, noise: float = 1.6
    ) -> np.ndarray:
        """(H, W) uint8."""
        rng = np.random.default_rng([self.seed, 33, index])
        width, height = self.size
        R, p = T_camera_board[:3, :3], T_camera_board[:3, 3]
        n = SQUARE_TEXELS / self.board.square_m
        first = SQUARE_TEXELS * (self.board.margin + 1) - 0.5
        to_texel = np.array([[n, 0, first], [0, n, first], [0, 0, 1]])
        H = (to_texel @ np.linalg.inv(np.stack([R[:, 0], R[:, 1], p], axis=-1))).astype(np.float32)
        x, y = self.fine[..., 0], self.fine[..., 1]
        scale = 1 / (H[2, 0] * x + H[2, 1] * y + H[2, 2])
        texel_x = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) * scale
        texel_y = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) * scale
        rows, columns = self.print_.shape
        looked_up = cv2.remap(
            self.print_, texel_x, texel_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        inside = (texel_x > -0.5) & (texel_x < columns - 0.5) & (texel_y > -0.5) & (texel_y < rows - 0.5)
        cover = cv2.resize(inside.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        light = cv2.resize(looked_up * inside, (width, height), interpolation=cv2.INTER_AREA)
        gain = np.float32(0.75 + 0.25 * abs(R[2, 2]) + rng.normal(0, 0.04))
        scene = self.wall * (1 - cover) + light * gain
        picture = np.asarray(cv2.GaussianBlur(scene, (9, 9), blur_px), np.float32) * self.vignette
        spread = np.sqrt(picture * np.float32(0.65 / 128) + np.float32(0.35))
        picture += spread * rng.normal(size=picture.shape).astype(np.float32) * np.float32(noise)
        return np.clip(picture + np.float32(0.5), 0, 255).astype(np.uint8)

    def _mostly_in_view(self, T: np.ndarray) -> bool:
        w, h = self.board.size_m
        s = self.board.square_m
        ends = np.array([[-s, -s, 0], [w - s, -s, 0], [w - s, h - s, 0], [-s, h - s, 0]])
        p = ends @ T[:3, :3].T + T[:3, 3]
        if p[:, 2].min() < 0.1:
            return False
        xy = p[:, :2] / p[:, 2:]
        low, high = self.rays.min(axis=(0, 1)), self.rays.max(axis=(0, 1))
        inside = (xy > low) & (xy < high)
        # A plain chessboard is found only whole.
        return bool(np.all(inside)) if not self.board.tag_share else int(np.all(inside, axis=1).sum()) >= 3
