"""Marker corners in a picture: AprilTag's search, brought into our conventions.

It serves the families of AprilTag and, told of their codes by `aruco`, those of OpenCV's ArUco.

AprilTag's C library puts the centre of the top-left pixel at (0.5, 0.5) and its corners run the other way round,
from another corner. Both are put right here and nowhere else: 0.5 px is 2.9 mm at 10 m with f = 1731 px.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable

import cv2
import numpy as np
import pyapriltags

from pipeline.config.site import DetectionSettings
from pipeline.detection.aruco import correctable_bits, library_family
from pipeline.detection.found import Found, Sighting, gathered
from pipeline.detection.prints import CLASSIC, hamming_limit, is_aruco

__all__ = ["Found", "TagFinder"]

PIXEL_ORIGIN = 0.5
"""Where AprilTag's library puts the centre of the top-left pixel; ours is 0."""
CORNERS_OF_CLASSIC_PRINTS = [1, 0, 3, 2]
CORNERS_AS_APRILTAG_PRINTS = [3, 2, 1, 0]
"""Our corners 0..3 (top-left, top-right, bottom-right, bottom-left of the print) among the library's.

OpenCV draws the tags of the classic families upside down compared with the pictures that the AprilTag project hands
out, and "the print" is OpenCV's. It has no tagStandard families: there the print is the project's own. Codes of ArUco
dictionaries are given to the library as OpenCV draws them.
"""


class TagFinder:
    """A search for tags of some families; one thread, not to be shared between threads.

    One library detector serves each family, so that what one family finds does not depend on which others are asked
    for. Dictionaries of ArUco are parts of one another; only the ids of the one asked for are found.

    Parameters
    ----------
    families : iterable of str
        Of `pipeline.config.quantities.FAMILIES`.
    settings : DetectionSettings
        Decimation, sharpening, and how many wrong bits ArUco's codes are corrected by.
    shrink : int
        Search the means of blocks of so many pixels each way. The library's own decimation takes single pixels and
        reads the codes in the whole picture: on drawn pictures of 1280x960 with nine tags a search decimated by two
        took 45 ms and one of the means of 2x2 pixels 29, by four 15 and 8, and both found the same tags. The codes are
        then read off those means, and have wrong bits: what is found so is a place to look at.
    """

    def __init__(self, families: Iterable[str], settings: DetectionSettings | None = None, shrink: int = 1):
        settings = settings or DetectionSettings()
        self._shrink = shrink
        self._detectors = {family: _detector(family, settings) for family in sorted(set(families))}

    def find(self, grey: np.ndarray) -> Found:
        """Every tag of the families in a picture, (H, W) uint8; which of them to believe is decided elsewhere."""
        shrink = self._shrink if min(grey.shape) >= 8 * self._shrink else 1
        grey = _shrunk(grey, shrink)
        sightings = []
        for family, detector in self._detectors.items():
            order = CORNERS_OF_CLASSIC_PRINTS if family in CLASSIC else CORNERS_AS_APRILTAG_PRINTS
            for tag in detector.detect(grey):
                uv = shrink * tag.corners[order] - PIXEL_ORIGIN
                sightings.append(
                    Sighting(family, int(tag.tag_id), uv, int(tag.hamming), float(tag.decision_margin))
                )
        return gathered(sightings)


class ArucoDetector(pyapriltags.Detector):
    """The library's detector for one ArUco dictionary; the library reads the codes where they lie until it is gone."""

    def __init__(self, family: str, corrected_bits: int, decimate: float, refine_edges: bool):
        super().__init__(families="", nthreads=1, quad_decimate=decimate, refine_edges=int(refine_edges))
        self.codes = library_family(family)
        assert self.libc is not None
        self.libc.apriltag_detector_add_family_bits(
            self.tag_detector_ptr, ctypes.byref(self.codes[0]), corrected_bits
        )


def _shrunk(grey: np.ndarray, shrink: int) -> np.ndarray:
    if shrink == 1:
        return np.ascontiguousarray(grey)
    height, width = (length // shrink for length in grey.shape)
    # What is left of a block at the ends is left out.
    whole = grey[: height * shrink, : width * shrink]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def _detector(family: str, settings: DetectionSettings) -> pyapriltags.Detector:
    decimate = settings.quad_decimate
    # The library can fit the sides of each quad to the picture before it decodes. The photometric fit does that better
    # from corners that are 0.1 px off (0.16 px in tags of 20 px), and of 47 tags on photographs one of 13 px was not
    # read with fitted sides. Where the library decimates the picture the sides are that much coarser than what the code
    # is read from: by four without the fit gave 44 codes of two wrong bits in the sample log instead of 1.
    refine_edges = decimate > 1
    detector: pyapriltags.Detector
    if is_aruco(family):
        # The library keeps every mistaken code: two wrong bits of DICT_7X7_1000 would take 59 MB.
        bits = min(settings.max_hamming, hamming_limit(family), correctable_bits(family))
        detector = ArucoDetector(family, bits, decimate, refine_edges)
    else:
        detector = pyapriltags.Detector(
            families=family, nthreads=1, quad_decimate=decimate, refine_edges=int(refine_edges)
        )
    assert detector.tag_detector_ptr is not None
    # The wrapper makes an int of it, and so 0 of every value below 1.
    detector.tag_detector_ptr.contents.decode_sharpening = settings.decode_sharpening
    return detector
