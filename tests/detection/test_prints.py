"""The prints against the two libraries that read them: drawn large, they are found with the right id and corners."""

import cv2
import numpy as np
import pyapriltags
import pytest

from benchmarks._tag_picture import View, picture
from pipeline.config.quantities import FAMILIES
from pipeline.detection.prints import (
    aruco_dictionary,
    cells_across,
    hamming_limit,
    is_aruco,
    print_of,
    spare_bits,
)
from pipeline.errors import DetectionError

APRILTAG = [family for family in FAMILIES if not is_aruco(family)]
ARUCO = [family for family in FAMILIES if is_aruco(family)]
CELL_PX = 12
MARGIN_PX = 40


def drawn(family, tag_id):
    """A grey picture of the print on grey ground, and the corners of its quad, pixel centres whole numbers."""
    print_ = print_of(family, tag_id)
    large = np.kron(print_.cells, np.full((CELL_PX, CELL_PX), 255.0))
    grey = np.pad(large, MARGIN_PX, constant_values=200).astype(np.uint8)
    first = MARGIN_PX + CELL_PX * (len(print_.cells) - print_.border) / 2 - 0.5
    last = first + CELL_PX * print_.border
    return grey, np.array([[first, first], [last, first], [last, last], [first, last]])


@pytest.mark.parametrize("family", APRILTAG)
def test_apriltags_library_reads_the_prints_of_its_families(family):
    detector = pyapriltags.Detector(families=family, quad_decimate=1.0)
    order = [3, 2, 1, 0] if family == "tagStandard41h12" else [1, 0, 3, 2]
    for tag_id in (0, 7, FAMILIES[family] - 1):
        grey, uv = drawn(family, tag_id)
        (tag,) = [tag for tag in detector.detect(grey) if tag.hamming == 0 and tag.decision_margin > 50]
        assert tag.tag_id == tag_id
        assert np.abs(tag.corners[order] - 0.5 - uv).max() < 0.1


@pytest.mark.parametrize("family", ARUCO)
def test_opencv_reads_the_prints_of_its_dictionaries(family):
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family)))
    for tag_id in (0, 7, FAMILIES[family] - 1):
        grey, uv = drawn(family, tag_id)
        corners, ids, _ = detector.detectMarkers(grey)
        assert ids.ravel().tolist() == [tag_id]
        # OpenCV's unrefined corners are whole pixels of the black side.
        assert np.abs(corners[0][0] - uv).max() < 1.1


@pytest.mark.parametrize("family", FAMILIES)
def test_the_number_of_tags_is_the_librarys(family):
    if family == "tagStandard41h12":
        detector = pyapriltags.Detector(families=family)
        assert detector.tag_families[family].contents.ncodes == FAMILIES[family]
    else:
        assert len(aruco_dictionary(family).bytesList) == FAMILIES[family]


@pytest.mark.parametrize("family", FAMILIES)
def test_every_print_of_a_family_differs_from_the_others(family):
    """However it is turned; but DICT_ARUCO_ORIGINAL, whose code words were never checked for turns."""
    seen = {}
    for tag_id in range(FAMILIES[family]):
        print_ = print_of(family, tag_id)
        assert set(np.unique(print_.cells)) <= {0.0, 1.0}
        for turn in range(4):
            key = np.rot90(print_.cells, turn).tobytes()
            if family != "DICT_ARUCO_ORIGINAL":
                assert key not in seen, (tag_id, turn, seen.get(key))
            seen[key] = tag_id, turn


@pytest.mark.parametrize("family, cells, across", [
    ("tag36h11", 10, 8), ("tag25h9", 9, 7), ("tag16h5", 8, 6), ("tagStandard41h12", 9, 5),
    ("DICT_4X4_50", 8, 6), ("DICT_5X5_100", 9, 7), ("DICT_6X6_250", 10, 8), ("DICT_7X7_1000", 11, 9),
    ("DICT_ARUCO_ORIGINAL", 9, 7), ("DICT_ARUCO_MIP_36h12", 10, 8),
])  # fmt: skip
def test_the_quad_is_so_many_cells_wide(family, cells, across):
    print_ = print_of(family, 0)
    assert print_.cells.shape == (cells, cells)
    assert print_.border == cells_across(family) == across
    # The quad's side is an edge all around: what is just inside differs from what is just outside.
    first = (cells - across) // 2
    ring = np.zeros((cells, cells), bool)
    ring[first : first + across, first : first + across] = True
    ring[first + 1 : first + across - 1, first + 1 : first + across - 1] = False
    outside = np.zeros((cells, cells), bool)
    outside[first - 1 : first + across + 1, first - 1 : first + across + 1] = True
    outside[first : first + across, first : first + across] = False
    assert len(np.unique(print_.cells[ring])) == len(np.unique(print_.cells[outside])) == 1
    assert print_.cells[ring][0] != print_.cells[outside][0]


def test_bits_to_spare_are_what_random_quads_say():
    """Random bits, read in four turns, against the codes: the share that is a tag is ``2 ** -spare_bits``."""
    family, n = "DICT_4X4_250", 40_000
    codes = {
        np.rot90(print_of(family, number).cells[2:-2, 2:-2], turn).astype(np.uint8).tobytes()
        for number in range(FAMILIES[family])
        for turn in range(4)
    }
    draws = np.random.default_rng(3).integers(0, 2, (n, 4, 4), dtype=np.uint8)
    share = np.mean([draw.tobytes() in codes for draw in draws])
    print(f"share of random quads that are a tag: {share:.4f}")
    assert share == pytest.approx(2 ** -spare_bits(family), rel=0.15)


@pytest.mark.parametrize("family, limit", [
    ("tag36h11", 2), ("tag25h9", 1), ("tag16h5", 0), ("tagStandard41h12", 2), ("DICT_4X4_50", 0),
    ("DICT_5X5_100", 1), ("DICT_5X5_1000", 0), ("DICT_7X7_1000", 2), ("DICT_ARUCO_ORIGINAL", 0),
])  # fmt: skip
def test_bits_are_corrected_only_where_there_are_bits_to_spare(family, limit):
    assert hamming_limit(family) == limit


def test_prints_are_kept_and_cannot_be_written_to():
    assert print_of("tag36h11", 3) is print_of("tag36h11", np.int32(3))
    with pytest.raises(ValueError, match="read-only"):
        print_of("tag36h11", 3).cells[0, 0] = 0


@pytest.mark.parametrize("family, tag_id, said", [
    ("tag36h11", 587, "ids 0 to 586, there is no tag 587"),
    ("tagStandard41h12", 2115, "there is no tag 2115"),
    ("tagStandard41h12", -1, "there is no tag -1"),
    ("DICT_4X4_50", 50, "ids 0 to 49"),
    ("tag36h10", 0, "there is no family 'tag36h10'"),
    ("getPredefinedDictionary", 0, "there is no family"),
])  # fmt: skip
def test_what_is_not_in_the_tables_is_refused(family, tag_id, said):
    with pytest.raises(DetectionError, match=said):
        print_of(family, tag_id)


@pytest.mark.parametrize("family", ["tag36h11", "tagStandard41h12", "DICT_5X5_100"])
def test_a_rendered_tag_shows_these_cells(family):
    """The benchmark's renderer, which shares no code with the prints: sampled at each cell, black or white as said."""
    grey, uv = picture(
        View(family, 11, side_px=120, roll_deg=0, blur_px=0.4, noise=1), np.random.default_rng(1)
    )
    print_ = print_of(family, 11)
    n, cell = len(print_.cells), (uv[1, 0] - uv[0, 0]) / print_.border
    first = uv[0] - cell * (n - print_.border) / 2
    at = np.rint(first[:, None] + cell * (np.arange(n) + 0.5)).astype(int)
    assert np.array_equal(grey[np.ix_(at[1], at[0])] > 115, print_.cells > 0.5)
