"""What may be used and what is refused, and what a set of views cannot tell."""

import numpy as np
import pytest

from pipeline.calibration.coverage import coverage
from pipeline.calibration.procedure import calibrate_lens
from pipeline.calibration.views import View
from pipeline.errors import CalibrationError
from pipeline.geometry.lenses import BROWN5
from tests.calibration.views_of_truth import BOARD, SIZE, TRUTH, drawn_views, poses


def test_a_good_recording_gives_a_lens_and_halves_that_agree():
    views, _ = drawn_views(BROWN5, count=24, seed=1)
    found = calibrate_lens(BROWN5, views, BOARD, SIZE, most=20)
    assert len(found.views) == 20 and found.found == 24
    assert np.all(np.abs(found.solution.intrinsics - TRUTH["brown5"]) < 4 * found.solution.sigma)
    assert found.halves is not None and found.halves.fits


def test_too_few_views_are_refused():
    with pytest.raises(CalibrationError, match="3 usable views of the board, at least 4"):
        calibrate_lens(BROWN5, drawn_views(BROWN5, count=3)[0], BOARD, SIZE)
    with pytest.raises(CalibrationError, match="no usable views"):
        calibrate_lens(BROWN5, [], BOARD, SIZE)


def test_views_that_are_all_alike_are_refused():
    with pytest.raises(CalibrationError, match=r"one attitude|do not tell|to .* % only"):
        calibrate_lens(BROWN5, drawn_views(BROWN5, count=12, alike=True)[0], BOARD, SIZE)


def test_corners_of_another_board_are_refused():
    rng = np.random.default_rng(4)
    views = [View(v.name, rng.permutation(v.point), v.uv, v.cov) for v in drawn_views(BROWN5)[0]]
    with pytest.raises(CalibrationError, match="board"):
        calibrate_lens(BROWN5, views, BOARD, SIZE)


def test_missing_corners_of_the_picture_and_one_distance_are_seen():
    views, T = drawn_views(BROWN5, count=6, alike=True)
    uv = np.array([[[[10.0, 10.0]], [[320.0, 240.0]], [[630.0, 470.0]]]])[0]
    few = [View(v.name, v.point[:3], uv, v.cov[:3]) for v in views]
    found = coverage(few, T, BOARD.corners_m, SIZE)
    assert found.missing == ("upper right", "lower left")
    assert found.one_distance and found.little_tilt
    assert found.counts[0, 0] == found.counts[-1, -1] == 6 and found.counts.sum() == 18
    tilted = coverage(few, poses(6, 3), BOARD.corners_m, SIZE)
    assert not tilted.little_tilt
