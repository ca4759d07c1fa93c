"""ArUco dictionaries through AprilTag's search, against a renderer of our own and against OpenCV's search."""

import ctypes

import cv2
import numpy as np
import pyapriltags
import pytest

from benchmarks._tag_picture import View, picture
from pipeline.config.quantities import FAMILIES
from pipeline.config.site import DetectionSettings
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.aruco import LibraryFamily, bits_by_quarters, code_table
from pipeline.detection.prints import cells_across, is_aruco

ARUCO = [family for family in FAMILIES if is_aruco(family)]
LYING = {"side_px": 90, "tilt_deg": 40, "axis_deg": 25, "centre": (3.3, -1.8), "blur_px": 0.6, "noise": 1.0}


def opencv_search(family):
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
    return cv2.aruco.ArucoDetector(dictionary, parameters)


@pytest.mark.parametrize("family", ARUCO)
@pytest.mark.parametrize("roll_deg", [0, 75, 160, 250])
def test_corners_are_those_of_the_print_in_our_order_and_origin(family, roll_deg):
    grey, uv = picture(View(family, 3, roll_deg=roll_deg, **LYING), np.random.default_rng(1))
    found = TagFinder([family]).find(grey)
    (k,) = np.flatnonzero((found.tag_id == 3) & (found.hamming == 0))
    assert np.abs(found.uv[k] - uv).max() < 0.2
    assert found.margin[k] > 50


def test_the_pixel_origin_is_the_centre_of_the_top_left_pixel():
    """Forty views: the mean error is a tenth of the half pixel between the two conventions, with no side fitted."""
    rng = np.random.default_rng(2)
    finder = TagFinder(["DICT_5X5_100"])
    errors = []
    for k in range(40):
        view = View(
            "DICT_5X5_100", k, 60, roll_deg=rng.uniform(0, 360), centre=tuple(rng.uniform(0, 8, 2).tolist())
        )
        grey, uv = picture(view, rng)
        found = finder.find(grey)
        errors.append(found.uv[found.tag_id == k][0] - uv)
    mean = np.mean(errors, axis=(0, 1))
    print(f"mean error {mean[0]:+.4f}, {mean[1]:+.4f} px")
    assert np.abs(mean).max() < 0.08


@pytest.mark.parametrize("family", ["DICT_4X4_50", "DICT_6X6_250", "DICT_ARUCO_ORIGINAL"])
def test_opencvs_own_search_says_the_same_tag_and_corners(family):
    """Its refined corners are good to some tenths of a pixel, its whole-pixel convention to much less."""
    rng = np.random.default_rng(4)
    ours, theirs = TagFinder([family]), opencv_search(family)
    differences = []
    for number in range(12):
        view = View(family, int(rng.integers(50)), side_px=100, tilt_deg=20, axis_deg=rng.uniform(0, 360),
                    roll_deg=rng.uniform(0, 360))  # fmt: skip
        grey, _ = picture(view, rng)
        corners, ids, _ = theirs.detectMarkers(grey)
        found = ours.find(grey)
        assert ids.ravel().tolist() == found.tag_id[found.hamming == 0].tolist() == [view.tag_id], number
        differences.append(found.uv[found.hamming == 0][0] - corners[0][0])
    assert np.abs(differences).max() < 1.0
    assert np.abs(np.mean(differences, axis=(0, 1))).max() < 0.1


def test_small_tags_are_found_more_often_than_by_opencv():
    rng = np.random.default_rng(5)
    ours, theirs = TagFinder(["DICT_6X6_250"]), opencv_search("DICT_6X6_250")
    hits = np.zeros(2, int)
    for _ in range(30):
        view = View("DICT_6X6_250", int(rng.integers(250)), side_px=15, roll_deg=rng.uniform(0, 360))
        grey, _ = picture(view, rng)
        ids = theirs.detectMarkers(grey)[1]
        hits += view.tag_id in ours.find(grey).tag_id, ids is not None and view.tag_id in ids
    print(f"of 30 tags 15 px wide: here {hits[0]}, OpenCV {hits[1]}")
    assert hits[0] >= max(hits[1], 24)


def test_a_smaller_dictionary_does_not_see_the_other_tags_of_the_larger_one():
    grey, _ = picture(View("DICT_5X5_1000", 77, 80), np.random.default_rng(6))
    assert TagFinder(["DICT_5X5_1000"]).find(grey).tag_id.tolist() == [77]
    assert TagFinder(["DICT_5X5_100"]).find(grey).tag_id.tolist() == [77]
    assert len(TagFinder(["DICT_5X5_50"]).find(grey)) == 0


def test_bits_are_corrected_as_far_as_settings_and_dictionary_allow():
    """A cell of DICT_6X6_50, which could put six bits right, and of DICT_4X4_1000, which can none, painted over."""
    for family, allowed in (("DICT_6X6_50", 2), ("DICT_4X4_1000", 0)):
        view = View(family, 7, 80, blur_px=0.5, noise=0.5)
        grey, uv = picture(view, np.random.default_rng(7))
        at = np.rint(uv[0] + (uv[2] - uv[0]) * 1.5 / cells_across(family)).astype(int)
        patch = grey[at[1] - 5 : at[1] + 6, at[0] - 5 : at[0] + 6]
        patch[:] = 40 if patch.mean() > 115 else 190
        for max_hamming in (0, 1, 2):
            found = TagFinder([family], DetectionSettings(max_hamming=max_hamming)).find(grey)
            seen = found.hamming[found.tag_id == 7].tolist()
            assert seen == ([1] if min(max_hamming, allowed) >= 1 else []), (family, max_hamming)


@pytest.mark.parametrize("size", [4, 5, 6, 7])
def test_a_quarter_turn_of_the_print_moves_its_bits_on_by_a_quarter(size):
    column, row = bits_by_quarters(size)
    assert len({*zip(column.tolist(), row.tolist())}) == size * size
    cells = np.random.default_rng(size).integers(0, 2, (size, size))
    turned = np.rot90(cells)
    quarter = size * size // 4
    bits, after = cells[row, column], turned[row, column]
    assert np.array_equal(np.roll(bits[: 4 * quarter], -quarter), after[: 4 * quarter])
    assert np.array_equal(bits[4 * quarter :], after[4 * quarter :])


def test_codes_fit_in_the_librarys_words_and_differ():
    for family in ARUCO:
        codes, column, row = code_table(family)
        assert codes.dtype == np.uint64
        assert len(set(codes.tolist())) == FAMILIES[family]
        assert int(codes.max()).bit_length() <= len(column) == len(row)


def test_the_structure_is_the_librarys():
    """Its own families, read through ours: were a field moved by an update, nothing else would tell but a crash."""
    detector = pyapriltags.Detector(families="tag25h9")
    theirs = ctypes.cast(detector.tag_families["tag25h9"], ctypes.POINTER(LibraryFamily)).contents
    assert (theirs.ncodes, theirs.nbits, theirs.width_at_border, theirs.total_width) == (35, 25, 7, 9)
    assert theirs.name == b"tag25h9"
    assert theirs.h == 9
    assert not theirs.reversed_border
    assert theirs.impl  # written by the library when it was told how many bits to correct


def test_finders_come_and_go():
    """The library frees its table with the detector; ours must outlive that, and a new one must not see the old."""
    grey, _ = picture(View("DICT_4X4_250", 9, 60), np.random.default_rng(8))
    for _ in range(50):
        assert TagFinder(["DICT_4X4_250", "DICT_5X5_50"]).find(grey).tag_id.tolist() == [9]
