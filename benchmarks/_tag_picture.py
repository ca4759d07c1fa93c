"""Pictures of single tags whose corners are known: a renderer that shares nothing with the synthetic site.

The print is sampled on a fine grid through its homography, blurred with a Gaussian and averaged over each pixel;
noise and JPEG follow. Pixel centres are whole numbers.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import pyapriltags
import simplejpeg
from pyapriltags import apriltags

FOCAL_PX = 1731.0
OPENCV = {
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
}


@cache
def cells(family: str, tag_id: int) -> tuple[np.ndarray, int]:
    """The print as cells (1 white), first row on top, and how many cells wide the black border's outside is.

    The classic families as OpenCV draws them, with one white cell around; tagStandard as the AprilTag project does.
    """
    if family in OPENCV:
        dictionary = cv2.aruco.getPredefinedDictionary(OPENCV[family])
        width = dictionary.markerSize + 2
        picture = cv2.aruco.generateImageMarker(dictionary, tag_id, width, borderBits=1)
        return np.pad((picture > 127).astype(np.float32), 1, constant_values=1), width
    detector = pyapriltags.Detector(families=family)
    draw = detector.libc.apriltag_to_image
    draw.restype = ctypes.POINTER(apriltags._ImageU8)
    draw.argtypes = [ctypes.POINTER(apriltags._ApriltagFamily), ctypes.c_uint32]
    drawn = draw(detector.tag_families[family], tag_id).contents
    picture = np.ctypeslib.as_array(drawn.buf, shape=(drawn.height, drawn.stride))[:, : drawn.width]
    width = detector.tag_families[family].contents.width_at_border
    return (picture > 127).astype(np.float32), width


@dataclass(frozen=True)
class View:
    """How a tag is seen."""

    family: str = "tag36h11"
    tag_id: int = 0
    side_px: float = 80.0
    """Side it would have if it faced the camera at this distance."""
    tilt_deg: float = 0.0
    """Angle between the line of sight and the normal of the print."""
    axis_deg: float = 0.0
    """Direction in the print about which it is tilted."""
    roll_deg: float = 0.0
    """Turn of the whole picture of it, clockwise."""
    centre: tuple[float, float] = (0.0, 0.0)
    """Offset of the tag's centre from the middle of the picture, px."""
    blur_px: float = 0.6
    noise: float = 2.0
    quality: int = 85
    """Of JPEG; 0 leaves the picture uncompressed."""
    black: float = 40.0
    white: float = 190.0


def homography(view: View) -> np.ndarray:
    """(3, 3) print coordinates (x right, y up, the side is 1) -> px from the middle of the picture."""
    t, a, r = np.deg2rad([view.tilt_deg, view.axis_deg, view.roll_deg])
    turn = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    k = np.array([np.cos(a), np.sin(a), 0])
    K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    tilt = np.eye(3) + np.sin(t) * K + (1 - np.cos(t)) * K @ K
    R = turn @ tilt @ np.diag([1.0, -1.0, -1.0])
    z = FOCAL_PX / view.side_px
    H = np.column_stack([R[:, 0], R[:, 1], [0, 0, z]])
    H = np.diag([FOCAL_PX, FOCAL_PX, 1.0]) @ H
    return np.array([[1, 0, view.centre[0]], [0, 1, view.centre[1]], [0, 0, 1]]) @ H


def project(H: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(n, 2) points of the print -> px."""
    p = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    return p[:, :2] / p[:, 2:]


def picture(view: View, rng: np.random.Generator, fine: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A grey picture of one tag, and its corners top-left, top-right, bottom-right, bottom-left; (H, W), (4, 2)."""
    print_, border = cells(view.family, view.tag_id)
    reach = 0.5 * len(print_) / border  # half the print with its white rim, in sides
    H = homography(view)
    rim = project(H, reach * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]))
    half = int(np.ceil(np.abs(rim).max())) + 12
    size = 2 * half + 1
    H = np.array([[1, 0, half], [0, 1, half], [0, 0, 1]]) @ H

    at = (np.arange(size * fine) + 0.5) / fine - 0.5
    u, v = np.meshgrid(at, at)
    G = np.linalg.inv(H)
    w = G[2, 0] * u + G[2, 1] * v + G[2, 2]
    column = np.floor(((G[0, 0] * u + G[0, 1] * v + G[0, 2]) / w + reach) * border).astype(int)
    row = np.floor((reach - (G[1, 0] * u + G[1, 1] * v + G[1, 2]) / w) * border).astype(int)
    inside = (column >= 0) & (column < len(print_)) & (row >= 0) & (row < len(print_))
    inside &= w * w[size * fine // 2, size * fine // 2] > 0
    last = len(print_) - 1
    shade = view.black + (view.white - view.black) * print_[np.clip(row, 0, last), np.clip(column, 0, last)]
    coarse = cv2.resize(rng.normal(110, 25, (size // 9 + 2, size // 9 + 2)), (size * fine, size * fine))
    light = np.where(inside, shade, coarse).astype(np.float32)
    if view.blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), view.blur_px * fine, borderType=cv2.BORDER_REPLICATE)
    grey = light.reshape(size, fine, size, fine).mean(axis=(1, 3)) + rng.normal(0, view.noise, (size, size))
    grey = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    if view.quality:
        data = simplejpeg.encode_jpeg(grey[..., None], quality=view.quality, colorspace="GRAY")
        grey = simplejpeg.decode_jpeg(data, colorspace="GRAY")[..., 0]
    return grey, project(H, 0.5 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]))
