"""Boards from their short text."""

import cv2
import numpy as np
import pytest

from pipeline.calibration.board import parse_board
from pipeline.errors import CalibrationError


def test_charuco_corners_lie_where_opencv_has_them():
    board = parse_board("charuco:7x5:0.04:0.03:DICT_4X4_50")
    theirs = cv2.aruco.CharucoBoard(
        (7, 5), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    ).getChessboardCorners()
    # Theirs begin at the corner of the board, ours at the first inner corner.
    assert np.allclose(board.corners_m, theirs - theirs[0], atol=1e-7)


def test_chessboard_corners_run_row_by_row():
    corners = parse_board("chessboard:4x3:0.1").corners_m
    assert corners.shape == (12, 3)
    assert np.allclose(corners[5], [0.1, 0.1, 0.0])


def test_tags_of_a_grid_stand_a_gap_apart():
    board = parse_board("apriltag:6x6:0.088:0.0264:tag36h11:12")
    corners = board.corners_m.reshape(6, 6, 4, 3)
    assert board.first_id == 12
    assert np.allclose(corners[0, 1, 0] - corners[0, 0, 1], [0.0264, 0, 0])
    assert np.allclose(corners[2, 3, 2] - corners[2, 3, 0], [0.088, 0.088, 0])


@pytest.mark.parametrize(
    "text",
    ["chessboard:10x7:0.025", "charuco:7x5:0.04:0.03:DICT_4X4_50", "apriltag:6x6:0.088:0.0264:tag36h11:12"],
)
def test_the_text_of_a_board_is_the_one_it_was_read_from(text):
    assert parse_board(text).text == text


@pytest.mark.parametrize(
    "text, said",
    [
        ("checkers:8x8:0.1", "begins with none"),
        ("chessboard:8:0.1", "is written"),
        ("chessboard:8x6", "is written"),
        ("chessboard:2x6:0.1", "3 to 60 each way"),
        ("chessboard:8x6:wide", "metres between"),
        ("chessboard:8x6:25", "metres between"),
        ("charuco:7x5:0.03:0.04:DICT_4X4_50", "smaller than its square"),
        ("charuco:7x5:0.04:0.03:DICT_9X9_50", "not known"),
        ("charuco:12x12:0.04:0.03:DICT_4X4_50", "needs 72 tags"),
        ("apriltag:6x6:0.088:0.0264:tag36h11:580", "needs 36 tags"),
    ],
)
def test_a_text_that_is_no_board_is_refused_with_how_one_is_written(text, said):
    with pytest.raises(CalibrationError, match=said):
        parse_board(text)
