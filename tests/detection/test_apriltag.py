"""Conventions of what detection hands on, against a renderer that shares nothing with it."""

import numpy as np
import pytest

from benchmarks._tag_picture import View, picture
from pipeline.config.site import DetectionSettings
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.found import sides_px

FAMILIES = ("tag36h11", "tag25h9", "tag16h5", "tagStandard41h12")
# Neither upright nor symmetric: a corner order that is rolled, or runs the other way, cannot pass.
LYING = View(
    tag_id=3,
    side_px=90,
    tilt_deg=40,
    axis_deg=25,
    roll_deg=75,
    centre=(3.3, -1.8),
    blur_px=0.6,
    noise=1,
    quality=95,
)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("roll_deg", [0, 75, 160, 250])
def test_corners_are_those_of_the_print_in_our_order_and_origin(family, roll_deg):
    """Marker frame (-,+) (+,+) (+,-) (-,-); an origin of AprilTag's kind would be 0.5 px off."""
    view = View(**{**LYING.__dict__, "family": family, "roll_deg": roll_deg})
    grey, uv = picture(view, np.random.default_rng(1))
    found = TagFinder([family]).find(grey)
    (k,) = np.flatnonzero(found.tag_id == 3)  # tag16h5 also sees tags where there are none
    assert np.abs(found.uv[k] - uv).max() < 0.2
    assert sides_px(found.uv)[k] == pytest.approx(
        np.linalg.norm(np.roll(uv, -1, 0) - uv, axis=1).mean(), abs=0.1
    )


def test_the_pixel_origin_is_the_centre_of_the_top_left_pixel():
    """Forty views: the mean error is a tenth of the half pixel between the two conventions, with no side fitted."""
    rng = np.random.default_rng(2)
    finder = TagFinder(["tag36h11"])
    errors = []
    for k in range(40):
        grey, uv = picture(
            View(tag_id=k, side_px=60, roll_deg=rng.uniform(0, 360), centre=tuple(rng.uniform(0, 8, 2))), rng
        )
        errors.append(finder.find(grey).uv[0] - uv)
    mean = np.mean(errors, axis=(0, 1))
    print(f"mean error {mean[0]:+.4f}, {mean[1]:+.4f} px")
    assert np.abs(mean).max() < 0.08


def test_equal_pictures_give_equal_answers_whatever_was_searched_before():
    rng = np.random.default_rng(3)
    pictures = [picture(View(tag_id=k, side_px=40 + 5 * k), rng)[0] for k in range(5)]
    one, other = TagFinder(["tag36h11"]), TagFinder(["tag36h11"])
    for grey in reversed(pictures):
        other.find(grey)
    for grey in pictures:
        a, b = one.find(grey), other.find(grey)
        assert np.array_equal(a.uv, b.uv)
        assert np.array_equal(a.margin, b.margin)


def test_families_do_not_disturb_one_another():
    grey, _ = picture(View("tag25h9", 4, 60, 20, 10, 30), np.random.default_rng(4))
    alone = TagFinder(["tag25h9"]).find(grey)
    together = TagFinder(["tag36h11", "tag25h9"]).find(grey)
    assert together.family.tolist() == ["tag25h9"]
    assert np.array_equal(alone.uv, together.uv)


def test_sharpening_reaches_the_library():
    """The wrapper makes 0 of 0.25; on a small blurred tag the decision margin tells the difference."""
    grey, _ = picture(View(tag_id=5, side_px=22, blur_px=0.9), np.random.default_rng(5))
    margins = [
        TagFinder(["tag36h11"], DetectionSettings(decode_sharpening=value)).find(grey).margin[0]
        for value in (0.0, 0.25, 1.0)
    ]
    assert margins[0] < margins[1] < margins[2]


def test_an_empty_picture_gives_nothing():
    found = TagFinder(["tag36h11"]).find(np.full((60, 80), 120, np.uint8))
    assert len(found) == 0
    assert found.uv.shape == (0, 4, 2)
