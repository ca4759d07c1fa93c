"""Where the other tags of a board are."""

import numpy as np

from pipeline.detection.boards import Board
from pipeline.geometry import camera

SQUARE = 0.13 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
CENTRES = {1: (-0.16, 0.16), 2: (0.16, 0.16), 3: (-0.16, -0.16), 4: (0.16, -0.16)}
BOARD = Board(
    "tag36h11",
    tuple(CENTRES),
    tuple(tuple((float(x), float(y)) for x, y in SQUARE + centre) for centre in CENTRES.values()),
)
INTRINSICS = np.array([1730, 1730, 640, 480, -0.03, 0.01, 0, 0, 0.0])


def seen_from(tilt_rad, away_m):
    """Tag id -> corners on the board, through the lens."""
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    R = np.array([[c, 0, s], [0, -1, 0], [s, 0, -c]])
    return {
        number: camera.project(np.column_stack([xy, np.zeros(4)]) @ R.T + (0.3, 0.2, away_m), INTRINSICS)
        for number, xy in BOARD.corners.items()
    }


def test_one_tag_tells_where_the_others_are_to_a_quarter_of_a_cell():
    """A lens that bends lines and corners good to 0.03 px; the cells are 6 px wide."""
    rng = np.random.default_rng(3)
    worst = 0.0
    for tilt in (0.0, 0.5, 1.0):
        truth = seen_from(tilt, 8.0)
        for number in BOARD.tag_id:
            places = BOARD.places({number: truth[number] + rng.normal(0, 0.03, (4, 2))})
            assert sorted(places) == [other for other in BOARD.tag_id if other != number]
            worst = max(worst, *(np.abs(places[other] - truth[other]).max() for other in places))
    print(f"worst {worst:.2f} px of cells 7 px wide")
    assert worst < 0.25 * 7


def test_nothing_is_told_where_all_are_seen_or_none():
    truth = seen_from(0.2, 6.0)
    assert BOARD.places(truth) == {}
    assert BOARD.places({}) == {}
    assert BOARD.places({77: truth[1]}) == {}


def test_a_tag_behind_the_camera_has_no_place():
    """A wall seen aslant, 2 m away at tag 1, beside the camera at tag 4 and behind it at tag 5."""
    c, s = np.cos(1.0), np.sin(1.0)
    R = np.array([[c, 0, s], [0, -1, 0], [s, 0, -c]])
    centres = {1: 0.0, 2: 1.0, 3: -1.0, 4: -2.2, 5: -5.0}
    corners = {number: SQUARE + (x, 0.0) for number, x in centres.items()}
    wall = Board("tag36h11", tuple(centres), tuple(tuple(map(tuple, xy)) for xy in corners.values()))
    away = {number: np.column_stack([xy, np.zeros(4)]) @ R.T + (0, 0, 2.0) for number, xy in corners.items()}
    uv = away[1][:, :2] / away[1][:, 2:] * 1730 + (640, 480)
    depth = {number: round(float(p[:, 2].min()), 2) for number, p in away.items()}
    print(f"nearest corner of each tag, metres in front of the camera: {depth}")
    assert sorted(wall.places({1: uv})) == [2, 3]
