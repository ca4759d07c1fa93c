"""A shrunk picture: never larger than allowed, and its corners where they were."""

import io

import numpy as np
import pytest
from PIL import Image

from pipeline.detection.preview import preview_jpeg


def opened(data):
    return np.asarray(Image.open(io.BytesIO(data)), float)


@pytest.mark.parametrize("size", [(960, 1280), (480, 640), (3000, 4000), (40, 5000), (1, 1)])
def test_the_worst_of_pictures_is_small_enough(size):
    """Noise is what JPEG can do least about."""
    picture = np.random.default_rng(0).integers(0, 256, size, dtype=np.uint8)
    data = preview_jpeg(picture)
    assert len(data) <= 90_000
    assert opened(data).shape[1] <= 900


def test_a_limit_that_nothing_meets_ends_with_the_smallest():
    data = preview_jpeg(np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8), max_bytes=10)
    assert opened(data).shape == (12, 16)


def test_a_plain_picture_keeps_its_size_and_its_grey():
    picture = np.tile(np.linspace(40, 200, 640).astype(np.uint8), (480, 1))
    shown = opened(preview_jpeg(picture))
    assert shown.shape == (480, 640)
    assert np.abs(shown - picture).max() < 4


def test_a_spot_stays_at_its_part_of_the_width():
    """Centres of pixels are whole numbers: u of the picture is (u + 0.5) w / W - 0.5 of the preview."""
    u, v = np.meshgrid(np.arange(1280), np.arange(960))
    picture = 20 + 200 * np.exp(-((u - 1000.25) ** 2 + (v - 220.75) ** 2) / (2 * 12.0**2))
    shown = opened(preview_jpeg(picture.round().astype(np.uint8)))
    assert shown.shape == (675, 900)
    weight = np.where(shown > 40, shown - 20, 0)
    rows, columns = np.indices(shown.shape)
    at = [(weight * x).sum() / weight.sum() for x in (columns, rows)]
    k = 900 / 1280
    assert at == pytest.approx([(1000.25 + 0.5) * k - 0.5, (220.75 + 0.5) * k - 0.5], abs=0.05)


def test_the_same_picture_gives_the_same_bytes():
    picture = np.random.default_rng(3).integers(0, 256, (600, 1000), dtype=np.uint8)
    assert preview_jpeg(picture) == preview_jpeg(picture.copy())
