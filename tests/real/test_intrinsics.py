"""Corners of a webcam that another calibrator was run on, and a ChArUco video."""

import numpy as np
import pytest

from pipeline.calibration.board import parse_board
from pipeline.calibration.corners import CornerFinder
from pipeline.calibration.video import frames_of_video
from pipeline.errors import CalibrationError
from pipeline.stages.intrinsics import calibrate_intrinsics

pytestmark = pytest.mark.real

THEIRS = np.array([1131.171517, 1129.437477, 609.574878, 349.7414005])
"""Focal lengths and principal point of the other calibrator (eight coefficients); two of the twelve boards are bent or
were moved, and its own treatment of outliers is not known."""


@pytest.mark.parametrize("model", ["brown5", "brown8"])
def test_the_other_calibrators_answer_lies_within_three_sigma(real_data, tmp_path, model):
    source = real_data / "intrinsics" / "lifecam_1280p_10x10.vnl"
    done = calibrate_intrinsics(
        source, "chessboard:10x10:0.0254", model=model, size=(1280, 720), out=tmp_path / "sheet.html"
    )
    solution = done.found.solution
    assert np.all(np.abs(solution.intrinsics[:4] - THEIRS) < 3 * solution.sigma[:4])
    assert np.all(solution.sigma[:2] < 15), "three sigma of anything holds anything"
    assert solution.rms_px < 0.3
    assert done.found.halves is not None and "Odd and even" not in done.sentence
    assert "odd and from the even views" in (tmp_path / "sheet.html").read_text()
    assert done.kept is None


def test_the_video_is_read_as_frames_and_its_views_are_all_alike(real_data):
    board = parse_board("charuco:12x8:0.0180086:0.0139954:DICT_5X5_100")
    finder = CornerFinder(board)
    for name, grey in frames_of_video(real_data / "intrinsics" / "testcalibration.mp4", 6):
        assert grey.shape == (1080, 1920)
        assert finder.add(name, grey), name
    assert finder.pictures in (5, 6)
    assert all(view.corners == 77 for view in finder.views())
    from pipeline.calibration.procedure import calibrate_lens
    from pipeline.geometry.lenses import BROWN5

    with pytest.raises(CalibrationError):
        calibrate_lens(BROWN5, finder.views(), board, (1920, 1080))
