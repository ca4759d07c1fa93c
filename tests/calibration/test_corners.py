"""Corners in rendered pictures of boards, against where the truth has them."""

import numpy as np
import pytest

from pipeline.calibration.board import parse_board
from pipeline.calibration.corners import CornerFinder
from pipeline.calibration.intrinsics import solve
from pipeline.calibration.start import first_guess
from pipeline.geometry import se3
from pipeline.geometry.lenses import BROWN5
from pipeline.synthetic.waved_board import PrintedBoard, WavedBoard

LENS = np.array([520.0, 522.0, 322.0, 236.0, -0.2, 0.06, 0.0006, -0.0004, -0.005])
SIZE = (640, 480)
CHARUCO = PrintedBoard(columns=9, rows=6, square_m=0.08, tag_share=0.75)


@pytest.fixture(scope="module")
def charuco():
    """Finder and views of six pictures, and the poses."""
    waved = WavedBoard(CHARUCO, LENS, SIZE, 4)
    finder = CornerFinder(parse_board(CHARUCO.text))
    poses = waved.poses(6)
    for index, T in enumerate(poses):
        finder.add(str(index), waved.picture(index, T))
    return finder, poses


def errors(board, views, poses):
    for view in views:
        truth = BROWN5.project(se3.transform(poses[int(view.name)], board.corners_m[view.point[:, 0]]), LENS)
        yield view, view.uv[:, 0] - truth


def test_charuco_corners_lie_where_they_were_drawn(charuco):
    finder, poses = charuco
    assert finder.found >= 5
    all_errors = np.concatenate([e for _, e in errors(finder.board, finder.views(), poses)])
    assert len(all_errors) > 100
    assert np.median(np.abs(all_errors)) < 0.03
    # The centre of the top-left pixel is (0, 0): half a pixel would stand out by far.
    assert np.all(np.abs(np.median(all_errors, axis=0)) < 0.01)


def test_covariances_are_of_the_size_of_the_errors(charuco):
    finder, poses = charuco
    ratio = []
    for view, error in errors(finder.board, finder.views(), poses):
        ratio.append(np.einsum("mi,mij,mj->m", error, np.linalg.inv(view.cov), error) / 2)
    assert 0.5 < np.sqrt(np.median(np.concatenate(ratio)) / 0.693) < 4


def test_a_chessboard_is_found_and_tells_the_lens():
    printed = PrintedBoard(columns=9, rows=6, square_m=0.08)
    waved, board = WavedBoard(printed, LENS, SIZE, 5), parse_board(printed.text)
    finder = CornerFinder(board)
    for index, T in enumerate(waved.poses(8)):
        finder.add(str(index), waved.picture(index, T))
    assert finder.found >= 7
    views = finder.views()
    k, T = first_guess(BROWN5, views, board.corners_m, SIZE)
    found = solve(BROWN5, views, board.corners_m, k, T)
    assert found.rms_px < 0.05
    assert np.all(np.abs(found.intrinsics - LENS) < 4 * found.sigma)


def test_a_chessboard_of_another_size_is_named():
    printed = PrintedBoard(columns=9, rows=6, square_m=0.08)
    waved = WavedBoard(printed, LENS, SIZE, 5)
    finder = CornerFinder(parse_board("chessboard:10x7:0.08"))
    for index, T in enumerate(waved.poses(2)):
        assert not finder.add(str(index), waved.picture(index, T))
    assert finder.instead() in [f"a chessboard of {a} inner corners is in view" for a in ("8x5", "5x8")]


def test_tags_that_a_board_has_not_are_named():
    waved = WavedBoard(CHARUCO, LENS, SIZE, 4)
    finder = CornerFinder(parse_board("charuco:5x4:0.08:0.06:DICT_4X4_50"))
    finder.add("0", waved.picture(0, waved.poses(1)[0]))
    assert not finder.found
    assert "DICT_4X4_50" in finder.instead()


@pytest.mark.slow
@pytest.mark.parametrize("upwards", [False, True], ids=["downwards", "upwards"])
@pytest.mark.parametrize("turned", [False, True], ids=["upright", "turned"])
def test_a_grid_of_tags_is_laid_out_as_it_is_printed(upwards, turned):
    """A grid drawn facing the camera, ids from the top or from the bottom, tags upright or turned half round."""
    import cv2

    board = parse_board("apriltag:4x3:0.08:0.024:tag36h11:5")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side, gap = 80, 24
    picture = np.full((400, 520), 200, np.uint8)
    for row in range(3):
        for column in range(4):
            tag = dictionary.generateImageMarker(5 + (2 - row if upwards else row) * 4 + column, side)
            x, y = 60 + column * (side + gap), 50 + row * (side + gap)
            picture[y : y + side, x : x + side] = 30 + (np.rot90(tag, 2) if turned else tag) // 255 * 170
    finder = CornerFinder(board)
    assert finder.add("a", picture)
    (view,) = finder.views()
    assert len(view.point) == 12
    p = board.corners_m[view.point.ravel(), :2]
    A = np.column_stack([p, np.ones(len(p))])
    uv = view.uv.reshape(-1, 2)
    x, *_ = np.linalg.lstsq(A, uv, rcond=None)
    # Edges lie between pixels: the first at 59.5. Upwards and turned is the whole grid turned, which nobody can tell.
    assert np.allclose(A @ x, uv, atol=0.05)
    assert np.allclose(np.abs(np.linalg.det(x[:2])), 1e6, rtol=1e-3)
    assert np.linalg.det(x[:2]) > 0, "a mirrored board"
    assert uv.min(axis=0) == pytest.approx([59.5, 49.5], abs=0.05)


def test_tags_of_another_share_of_their_square_than_said_are_told():
    waved = WavedBoard(CHARUCO, LENS, SIZE, 4)
    for square, said in ((0.08, ""), (0.0755, "its tags measure 0.75 of a square in the pictures, and 0.79")):
        finder = CornerFinder(parse_board(f"charuco:9x6:{square}:0.06:{CHARUCO.dictionary}"))
        for index, T in enumerate(waved.poses(6)):
            finder.add(str(index), waved.picture(index, T))
        assert finder.misprint().startswith(said) and bool(finder.misprint()) == bool(said)
