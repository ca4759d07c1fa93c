"""Where a known tag is, by the correlation of its cells; and the decoder in a window."""

import cv2
import numpy as np
import pytest

from benchmarks._tag_picture import View, picture
from pipeline.detection.prints import cells_across
from pipeline.detection.windows import WindowDecoder, locate


def canvas(view, rng, at=(150, 80)):
    """A textured picture with a tag, and its corners."""
    ground = cv2.resize(rng.normal(110, 40, (60, 80)), (640, 480), interpolation=cv2.INTER_CUBIC)
    grey = np.clip(ground, 0, 255).astype(np.uint8)
    tag, uv = picture(view, rng, fine=4)
    grey[at[1] : at[1] + tag.shape[0], at[0] : at[0] + tag.shape[1]] = tag
    return grey, uv + at


@pytest.mark.parametrize("family", ["tag36h11", "tag16h5", "tagStandard41h12"])
@pytest.mark.parametrize("side_px", [18, 40, 110])
def test_a_tag_is_located_within_the_reach_of_the_refinement(family, side_px):
    """Half a cell; from guesses up to 12 px away, one of two nowhere near."""
    rng = np.random.default_rng([side_px, len(family)])
    errors = []
    for _ in range(12):
        view = View(family, 7, side_px, rng.uniform(0, 40), rng.uniform(0, 360), rng.uniform(0, 360))
        grey, uv = canvas(view, rng)
        guesses = np.stack([uv + 90, uv + rng.uniform(-12, 12, 2)])[None]
        found, score = locate(grey, [family], [7], guesses, np.array([2]), np.array([14.0]))
        errors.append(np.abs(found[0] - uv).max() * cells_across(family) / side_px)
        assert score[0] > 0.8
    print(f"{family} {side_px} px: worst corner {max(errors):.2f} cells")
    assert max(errors) < 0.5


def test_ground_without_a_tag_and_a_place_outside_correlate_with_nothing():
    rng = np.random.default_rng(1)
    grey, uv = canvas(View(side_px=40), rng)
    guesses = np.stack([uv + (200, 180), uv + 2000])[:, None]
    _, score = locate(grey, ["tag36h11"] * 2, [0, 0], guesses, np.array([1, 1]), np.array([14.0, 14.0]))
    print("ground", score[0])
    assert score[0] < 0.6
    assert score[1] == -1.0


def test_a_tag_whose_white_rim_is_cut_off_is_still_located():
    rng = np.random.default_rng(2)
    grey, uv = canvas(View(side_px=60, roll_deg=0), rng)
    edge = int(uv[:, 0].min()) - 1
    found, score = locate(
        np.ascontiguousarray(grey[:, edge:]),
        ["tag36h11"],
        [0],
        (uv - (edge, 0) + 3.0)[None, None],
        np.ones(1, int),
        np.array([8.0]),
    )
    assert score[0] > 0.8
    assert np.abs(found[0] - uv + (edge, 0)).max() < 3.0


@pytest.mark.parametrize("side_px", [16, 40, 110])
def test_the_decoder_finds_a_tag_near_where_it_was_whatever_its_size(side_px):
    """Enlarged, as it is, and decimated: the same corners, in the same convention of pixels."""
    rng = np.random.default_rng(side_px)
    decoder = WindowDecoder()
    errors = []
    for _ in range(8):
        grey, uv = canvas(View(side_px=side_px, tag_id=3, roll_deg=rng.uniform(0, 360)), rng)
        found = decoder.find(grey, "tag36h11", 3, uv + rng.uniform(-10, 10, 2), 12.0)
        if found is not None:
            errors.append(np.mean(found - uv, axis=0))
        assert decoder.find(grey, "tag36h11", 4, uv, 12.0) is None
        assert decoder.find(grey, "tag36h11", 3, uv + 3000, 12.0) is None
    print(f"{side_px} px: {len(errors)} of 8, mean offset {np.mean(errors, axis=0)}")
    assert len(errors) >= 7
    assert np.abs(np.mean(errors, axis=0)).max() < 0.15
