"""Pictures of single tags whose corners are known: a renderer that shares nothing with detection or the synthetic site.

The print is averaged over the cells of a fine grid through lens and homography (not sampled at points: at six points
per pixel that left errors of 0.01 px in prints that lie square to the picture), lit and covered (`_light`), blurred,
averaged over each pixel, exposed; noise and JPEG follow. Pixel centres are whole numbers.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache

import cv2
import numba
import numpy as np
import pyapriltags
import simplejpeg
from pyapriltags import apriltags

from benchmarks import _light

FOCAL_PX = 1731.0
SQUARE = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
"""Corners top-left, top-right, bottom-right, bottom-left; x right, y up."""
OPENCV = {
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
}
REACH_PX = 12
"""Of the picture beyond the print, at the least."""


@cache
def cells(family: str, tag_id: int) -> tuple[np.ndarray, int]:
    """The print as cells (1 white), first row on top, and how many cells wide the black border's outside is.

    The classic families and ArUco's dictionaries as OpenCV draws them, with one white cell around; tagStandard as the
    AprilTag project does.
    """
    if family in OPENCV or family.startswith("DICT_"):
        dictionary = cv2.aruco.getPredefinedDictionary(OPENCV.get(family) or getattr(cv2.aruco, family))
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
    """Side it would have if it faced the camera at this distance in the middle of the picture."""
    tilt_deg: float = 0.0
    """Angle between the line of sight and the normal of the print."""
    axis_deg: float = 0.0
    """Direction in the print about which it is tilted."""
    roll_deg: float = 0.0
    """Turn of the whole picture of it, clockwise."""
    centre: tuple[float, float] = (0.0, 0.0)
    """Where the tag's centre is seen, px: in the camera's whole frame if there is a lens."""
    lens: tuple[float, ...] | None = None
    """fx fy cx cy k1 k2 p1 p2 k3 of the whole frame, OpenCV's model; without, a pinhole that looks at the tag."""
    blur_px: float = 0.6
    """Sigma of the lens's Gaussian."""
    disc_px: float = 0.0
    """Radius of a disc of defocus, besides the Gaussian."""
    motion_px: float = 0.0
    """Way of the picture while the shutter is open; the corners are those of half time."""
    motion_deg: float = 0.0
    noise: float = 2.0
    """Standard deviation of grey values."""
    photon: float = 0.0
    """Share of its variance, at a grey value of 128, that grows with the light."""
    quality: int = 85
    """Of JPEG; 0 leaves the picture uncompressed."""
    black: float = 40.0
    white: float = 190.0
    slope: float = 0.0
    """Change of the light across one side of the tag, as a share."""
    slope_deg: float = 0.0
    exposure: float = 1.0
    gamma: float = 1.0
    """Of the camera's response: grey values are 255 (light / 255) ** (1 / gamma)."""
    shadow: float = 1.0
    """Light that is left beyond a hard edge across the tag."""
    glare: float = 0.0
    """Height of a hot spot of low sun near the tag, in grey values; a quarter of it lies over all as a veil."""
    covered: float = 0.0
    """Share of the tag, its black border included, that something lies over."""


@dataclass(frozen=True)
class Shot:
    """A picture and what is true of it."""

    grey: np.ndarray
    """(H, W) uint8."""
    uv: np.ndarray
    """(4, 2) corners top-left, top-right, bottom-right, bottom-left, as the lens shows them."""
    intrinsics: np.ndarray
    """(9,) fx fy cx cy k1 k2 p1 p2 k3 for the pixels of this picture."""
    clean: np.ndarray
    """(H, W) grey values before noise, clipping, rounding and JPEG."""
    inside: np.ndarray
    """(H, W) bool, pixels whose centre lies on the print, its quiet zone included."""


@dataclass(frozen=True)
class Sight:
    """Where a print lies in a picture."""

    H: np.ndarray
    """(3, 3) print coordinates (x right, y up, the side is 1) -> normalised coordinates of the camera."""
    intrinsics: np.ndarray
    """(9,) for the pixels of the picture."""
    shape: tuple[int, int]

    def project(self, xy: np.ndarray) -> np.ndarray:
        """(n, 2) points of the print -> px as the lens shows them."""
        p = np.column_stack([xy, np.ones(len(xy))]) @ self.H.T
        return distort(p[:, :2] / p[:, 2:], self.intrinsics)

    def moved(self, uv: np.ndarray) -> Sight:
        """The same print with its corners at (4, 2) given px."""
        normalised = np.array([_straight(u, v, self.intrinsics, 0.0, 0.0, 30) for u, v in uv])
        rows, right = [], []  # not OpenCV's function: it takes single precision
        for (x, y), (a, b) in zip(0.5 * SQUARE, normalised):
            rows += [[x, y, 1, 0, 0, 0, -a * x, -a * y], [0, 0, 0, x, y, 1, -b * x, -b * y]]
            right += [a, b]
        H = np.append(np.linalg.solve(rows, right), 1.0).reshape(3, 3)
        return Sight(H, self.intrinsics, self.shape)


def distort(xy: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """(n, 2) normalised coordinates -> px, Brown's model."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = intrinsics
    x, y = xy[:, 0], xy[:, 1]
    s = x * x + y * y
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    return np.column_stack(
        [
            fx * (x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)) + cx,
            fy * (y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y) + cy,
        ]
    )


@numba.njit(cache=True, error_model="numpy")
def _straight(u, v, intrinsics, x, y, steps):
    """Normalised coordinates of a pixel, by Newton's steps from x, y."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = intrinsics
    a, b = (u - cx) / fx, (v - cy) / fy
    for _ in range(steps):
        s = x * x + y * y
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
        ea = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x) - a
        eb = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y - b
        aa = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        bb = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        ab = slope * x * y + 2 * p1 * x + 2 * p2 * y
        det = aa * bb - ab * ab
        x -= (bb * ea - ab * eb) / det
        y -= (aa * eb - ab * ea) / det
    return x, y


@numba.njit(cache=True, error_model="numpy")
def _integral(table, x, y):
    """Integral of the print from its top left to x, y, in cells."""
    n = table.shape[0] - 1
    x, y = min(max(x, 0.0), n), min(max(y, 0.0), n)
    j, i = min(int(x), n - 1), min(int(y), n - 1)
    a, b = x - j, y - i
    top = table[i, j] * (1 - a) + table[i, j + 1] * a
    return top * (1 - b) + (table[i + 1, j] * (1 - a) + table[i + 1, j + 1] * a) * b


@numba.njit(cache=True, error_model="numpy")
def _average(print_, table, G, intrinsics, fine, shade, alpha):
    """Mean of the print (1 white) over each cell of the fine grid, and the share of it that is print.

    The footprint of a cell of the grid is taken as a rectangle along the print's axes with the same variances.
    """
    n = table.shape[0] - 1
    pitch_u, pitch_v = 1 / (fine * intrinsics[0]), 1 / (fine * intrinsics[1])
    bent = np.any(intrinsics[4:] != 0)
    for r in range(shade.shape[0]):
        v = (r + 0.5) / fine - 0.5
        x, y = (-0.5 - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
        for c in range(shade.shape[1]):
            u = (c + 0.5) / fine - 0.5
            if bent:
                x, y = _straight(u, v, intrinsics, x, y, 1 if c else 12)
            else:
                x, y = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
            w = G[2, 0] * x + G[2, 1] * y + G[2, 2]
            shade[r, c], alpha[r, c] = 1.0, 0.0
            if w <= 0:
                continue
            w = 1 / w
            col = (G[0, 0] * x + G[0, 1] * y + G[0, 2]) * w
            row = (G[1, 0] * x + G[1, 1] * y + G[1, 2]) * w
            if col < -1 or col > n + 1 or row < -1 or row > n + 1:
                continue
            ca, cb = (G[0, 0] - col * G[2, 0]) * pitch_u, (G[0, 1] - col * G[2, 1]) * pitch_v
            ra, rb = (G[1, 0] - row * G[2, 0]) * pitch_u, (G[1, 1] - row * G[2, 1]) * pitch_v
            hc, hr = 0.5 * w * np.sqrt(ca * ca + cb * cb), 0.5 * w * np.sqrt(ra * ra + rb * rb)
            left, right, top, bottom = col - hc, col + hc, row - hr, row + hr
            if right <= 0 or left >= n or bottom <= 0 or top >= n:
                continue
            if left >= 0 and top >= 0 and int(left) == int(right) and int(top) == int(bottom):
                shade[r, c], alpha[r, c] = print_[int(row), int(col)], 1.0  # wholly in one cell of the print
                continue
            left_in, right_in, top_in, bottom_in = (
                max(left, 0.0),
                min(right, n),
                max(top, 0.0),
                min(bottom, n),
            )
            area = (right_in - left_in) * (bottom_in - top_in)
            whole = (
                _integral(table, right_in, bottom_in)
                - _integral(table, left_in, bottom_in)
                - _integral(table, right_in, top_in)
                + _integral(table, left_in, top_in)
            )
            shade[r, c] = whole / max(area, 1e-12)
            alpha[r, c] = area / (4 * hc * hr)


def sight(view: View, rng: np.random.Generator | None = None) -> tuple[Sight, np.ndarray]:
    """Where the print lies in a picture cut out around it, and the cut's top-left pixel in the whole frame.

    With a generator the cut begins anywhere on the 8 x 8 raster of JPEG.
    """
    lens = np.array(view.lens or (FOCAL_PX, FOCAL_PX, *view.centre, 0, 0, 0, 0, 0), float)
    t, a, r = np.deg2rad([view.tilt_deg, view.axis_deg, view.roll_deg])
    turn = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    tilt = _rotation(np.array([np.cos(a), np.sin(a), 0]), t)
    R = turn @ tilt @ np.diag([1.0, -1.0, -1.0])
    x, y = _straight(*view.centre, lens, 0.0, 0.0, 30)
    ray = np.array([x, y, 1]) / np.sqrt(x * x + y * y + 1)
    side = np.array([-ray[1], ray[0], 0])
    if np.linalg.norm(side) > 0:
        R = _rotation(side / np.linalg.norm(side), np.arccos(ray[2])) @ R
    H = np.column_stack([R[:, 0], R[:, 1], ray * lens[0] / view.side_px])
    print_, border = cells(view.family, view.tag_id)
    rim = Sight(H, lens, (0, 0)).project(0.5 * len(print_) / border * SQUARE)
    reach = REACH_PX + (0 if rng is None else rng.integers(0, 8, 2))
    corner = np.floor(rim.min(axis=0)).astype(int) - reach
    size = np.ceil(rim.max(axis=0)).astype(int) + REACH_PX - corner + 1
    lens[2:4] -= corner
    return Sight(H, lens, (int(size[1]), int(size[0]))), corner


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def print_light(print_: np.ndarray, border: int, where: Sight, fine: int) -> tuple[np.ndarray, np.ndarray]:
    """The print on the fine grid (1 white, white beyond it too), and how much of each cell of it is print."""
    table = np.zeros((len(print_) + 1,) * 2)
    table[1:, 1:] = np.cumsum(np.cumsum(print_, axis=0), axis=1)
    half = 0.5 * len(print_)
    to_cells = np.array([[border, 0, half], [0, -border, half], [0, 0, 1.0]])
    G = to_cells @ np.linalg.inv(where.H)
    centre = where.H @ [0, 0, 1]
    G /= G[2] @ centre
    shade = np.empty((where.shape[0] * fine, where.shape[1] * fine), np.float32)
    alpha = np.empty_like(shade)
    _average(print_, table, G, where.intrinsics, fine, shade, alpha)
    return shade, alpha


def coarse(light: np.ndarray, fine: int) -> np.ndarray:
    """Mean of a fine grid over each pixel."""
    return light.reshape(light.shape[0] // fine, fine, light.shape[1] // fine, fine).mean(axis=(1, 3))


def shoot(view: View, rng: np.random.Generator, fine: int = 0, background: np.ndarray | None = None) -> Shot:
    """A grey picture of one tag, cut out around it, and what is true of it.

    Parameters
    ----------
    view : View
        How the tag is seen.
    rng : Generator
        Of the surroundings, what covers the tag, its shadow, the noise.
    fine : int
        Cells of the fine grid across a pixel; 0 takes as many as keep corners true to 0.001 px.
    background : (H, W) array
        Grey values of the whole frame, to see the tag before; left out, some texture.
    """
    fine = fine or (6 if view.side_px < 50 else 4)
    where, corner = sight(view, rng)
    print_, border = cells(view.family, view.tag_id)
    shade, alpha = print_light(print_, border, where, fine)
    if background is None:
        around = _light.texture(shade.shape, fine, rng)
    else:
        rows, columns = (np.arange(where.shape[k]) + corner[1 - k] for k in (0, 1))
        cut = background[np.ix_(*(np.clip(at, 0, n - 1) for at, n in zip((rows, columns), background.shape)))]
        around = cv2.resize(cut.astype(np.float32), shade.shape[::-1], interpolation=cv2.INTER_LINEAR)
    light = around + alpha * (view.black + (view.white - view.black) * shade - around)
    uv = where.project(0.5 * SQUARE)
    light = _light.fall(view, light, uv, fine, rng)
    light = _light.blur(view, light, fine)
    clean = _light.encode(coarse(light, fine) * view.exposure, view.gamma)
    sigma = view.noise * np.sqrt(1 - view.photon + view.photon * np.clip(clean, 0, 255) / 128)
    grey = np.clip(np.rint(clean + rng.normal(size=clean.shape) * sigma), 0, 255).astype(np.uint8)
    if view.quality:
        grey = compress(grey, view.quality)
    return Shot(grey, uv, where.intrinsics, clean, coarse(alpha, fine) > 0.5)


def compress(grey: np.ndarray, quality: int) -> np.ndarray:
    """The picture after JPEG."""
    data = simplejpeg.encode_jpeg(np.ascontiguousarray(grey)[..., None], quality=quality, colorspace="GRAY")
    return simplejpeg.decode_jpeg(data, colorspace="GRAY")[..., 0]


def picture(view: View, rng: np.random.Generator, fine: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A grey picture of one tag, and its corners top-left, top-right, bottom-right, bottom-left; (H, W), (4, 2)."""
    shot = shoot(view, rng, fine)
    return shot.grey, shot.uv
