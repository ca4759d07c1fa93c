"""Polynomials that straighten windows of a picture, against the lens model itself."""

import numpy as np
import pytest

from pipeline.detection.straightening import Straightening, bent_back, ideal_of
from pipeline.geometry import camera

SHAPE = (960, 1280)
CENTRE = (647.0, 471.0)
LENSES = {
    "f 1731, k1 -0.12": (1731.0, 1729.0, *CENTRE, -0.12, 0.01, 0.0005, 0.001, 0.0),
    "f 900, k1 +0.05": (900.0, 900.0, *CENTRE, 0.05, 0.0, 0.0, 0.0, 0.0),
    "f 1731, k1 -0.3": (1731.0, 1729.0, *CENTRE, -0.3, 0.09, 0.0005, 0.001, 0.0),
    "f 1100, k1 -0.3": (1100.0, 1103.0, *CENTRE, -0.3, 0.09, 0.0005, 0.001, 0.0),
}
BARS_PX = {
    "f 1731, k1 -0.12": (0.0001, 0.0002, 0.0015),
    "f 900, k1 +0.05": (0.0001, 0.0002, 0.002),
    "f 1731, k1 -0.3": (0.0002, 0.0005, 0.008),
    "f 1100, k1 -0.3": (0.0006, 0.06, 0.7),
}
"""For tags of 30, 100 and 200 px: what a polynomial of the fourth degree leaves of a lens that bends that much. A tenth
of the noise of corners, but for the last two, which are those of the picture's own corners."""
SIDES_PX = (30, 100, 200)


def quad_at(middle, side_px, angle):
    """(4, 2) corners of a square."""
    at = angle + np.pi / 4 + np.pi / 2 * np.arange(4)
    return middle + side_px / np.sqrt(2) * np.column_stack([np.cos(at), np.sin(at)])


def straight_at(uv, intrinsics):
    """Where pixels would be without distortion: the ray through each, through a pinhole."""
    xy = camera.undistort(uv, intrinsics)
    pinhole = np.array([*intrinsics[:4], 0, 0, 0, 0, 0])
    return camera.project(np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1), pinhole)


def windows(lens_name, side_px, number=40):
    """Windows of tags anywhere in the picture, every fourth at its border, and pixels that the print reaches.

    The white rim of a tag lies beyond its quad by an eighth of the side.
    """
    rng = np.random.default_rng(1)
    intrinsics = np.array(LENSES[lens_name])
    straightening = Straightening(intrinsics, SHAPE)
    last = np.array([SHAPE[1] - 1, SHAPE[0] - 1])
    for k in range(number):
        quad = quad_at(np.zeros(2), side_px, rng.uniform(0, 2 * np.pi))
        reach = np.abs(quad).max(axis=0)
        middle = rng.uniform(reach, last - reach)
        if k % 4 == 0:
            middle[0] = (reach, last - reach)[k % 8 // 4][0]
        right, down = 0.5 * (quad[1] - quad[0]), 0.5 * (quad[2] - quad[1])
        pixels = middle + rng.uniform(-1.25, 1.25, (80, 1)) * right + rng.uniform(-1.25, 1.25, (80, 1)) * down
        inside = np.all((pixels >= 0) & (pixels <= last), axis=1)
        yield straightening.windows((middle + quad)[None])[0], pixels[inside], intrinsics


@pytest.mark.parametrize("lens_name", LENSES)
def test_windows_straighten_as_the_camera_does(lens_name):
    """Largest difference over all windows, beside the largest bow across a window, which it straightens."""
    for side_px, bar in zip(SIDES_PX, BARS_PX[lens_name]):
        worst, rest, bow = 0.0, [], 0.0
        for lens, pixels, intrinsics in windows(lens_name, side_px):
            ours = np.array([ideal_of(x, y, lens) for x, y in pixels])
            truth = straight_at(pixels, intrinsics)
            rest.append(np.abs(ours - truth).max())
            shift = truth - pixels
            plane = np.column_stack([pixels, np.ones(len(pixels))])
            bow = max(bow, np.abs(shift - plane @ np.linalg.lstsq(plane, shift)[0]).max())
        worst = max(rest)
        print(
            f"{lens_name}, {side_px} px: at most {worst:.5f} px, median window {np.median(rest):.5f} px; "
            f"bow {bow:.2f} px"
        )
        assert worst < bar
        assert worst < 0.06 * bow


@pytest.mark.parametrize("lens_name", LENSES)
def test_bent_back_undoes_what_straightens(lens_name):
    """There and back, and its derivative against differences of `ideal_of`."""
    worst, slope = 0.0, 0.0
    h = 1e-3
    for side_px in SIDES_PX:
        for lens, pixels, _ in windows(lens_name, side_px, number=16):
            for x, y in pixels[:12]:
                back_x, back_y, D = bent_back(*ideal_of(x, y, lens), lens)
                worst = max(worst, abs(back_x - x), abs(back_y - y))
                across = np.subtract(ideal_of(x + h, y, lens), ideal_of(x - h, y, lens)) / (2 * h)
                down = np.subtract(ideal_of(x, y + h, lens), ideal_of(x, y - h, lens)) / (2 * h)
                slope = max(slope, np.abs(np.column_stack([across, down]) - D).max())
    print(f"{lens_name}: there and back {worst:.1e} px, derivative off by {slope:.1e}")
    assert worst < 1e-6
    assert slope < 1e-4


def test_a_window_far_from_its_ray_finds_its_way_back():
    """A tag of 30 px in the corner of a picture whose lens shifts it there by several of its widths."""
    intrinsics = np.array(LENSES["f 1100, k1 -0.3"])
    quad = quad_at(np.array([1257.0, 938.0]), 30, 0.3)
    (lens,) = Straightening(intrinsics, SHAPE).windows(quad[None])
    straight = straight_at(quad, intrinsics)
    shift = np.linalg.norm(straight - quad, axis=1).min()
    back = np.array([bent_back(*at, lens)[:2] for at in straight])
    print(f"shifted by {shift:.0f} px, back within {np.abs(back - quad).max():.5f} px")
    assert shift > 60
    assert np.abs(back - quad).max() < 0.001


def test_no_tags_have_no_windows():
    assert len(Straightening(np.array(LENSES["f 1731, k1 -0.3"]), SHAPE).windows(np.empty((0, 4, 2)))) == 0
