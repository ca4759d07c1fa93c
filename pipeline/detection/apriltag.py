"""Marker corners in a picture: AprilTag's search, brought into our conventions.

AprilTag's C library puts the centre of the top-left pixel at (0.5, 0.5) and its corners run the other way round,
from another corner. Both are put right here and nowhere else: 0.5 px is 2.9 mm at 10 m with f = 1731 px.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pyapriltags

from pipeline.config.site import DetectionSettings
from pipeline.detection.noise import CELLS, corner_covariance

PIXEL_ORIGIN = 0.5
"""Where AprilTag's library puts the centre of the top-left pixel; ours is 0."""
CORNERS_AS_OPENCV_PRINTS = (1, 0, 3, 2)
CORNERS_AS_APRILTAG_PRINTS = (3, 2, 1, 0)
"""Our corners 0..3 (top-left, top-right, bottom-right, bottom-left of the print) among the library's.

OpenCV draws the tags of the classic families upside down compared with the pictures that the AprilTag project hands
out, and "the print" is OpenCV's. It has no tagStandard families: there the print is the project's own.
"""


@dataclass(frozen=True)
class Found:
    """The tags found in one picture, sorted by family, id and place."""

    family: np.ndarray
    """(n,) object array of names."""
    tag_id: np.ndarray
    """(n,) int."""
    uv: np.ndarray
    """(n, 4, 2) corners top-left, top-right, bottom-right, bottom-left of the print; px, top-left pixel at (0, 0)."""
    cov: np.ndarray
    """(n, 4, 2, 2) covariance of each corner, px²."""
    side_px: np.ndarray
    """(n,) mean side of the quad."""
    hamming: np.ndarray
    """(n,) int, corrected bits."""
    margin: np.ndarray
    """(n,) decision margin of the decoder."""

    def __len__(self) -> int:
        return len(self.tag_id)


class TagFinder:
    """A search for tags of some families; one thread, not to be shared between threads.

    One library detector serves each family, so that what one family finds does not depend on which others are asked
    for.
    """

    def __init__(self, families: Iterable[str], settings: DetectionSettings | None = None):
        settings = settings or DetectionSettings()
        self._detectors = {}
        for family in sorted(set(families)):
            detector = pyapriltags.Detector(
                families=family, nthreads=1, quad_decimate=settings.quad_decimate, refine_edges=1
            )
            assert detector.tag_detector_ptr is not None
            # The wrapper makes an int of it, and so 0 of every value below 1.
            detector.tag_detector_ptr.contents.decode_sharpening = settings.decode_sharpening
            self._detectors[family] = detector

    def find(self, grey: np.ndarray) -> Found:
        """Every tag of the families in a picture, (H, W) uint8; which of them to believe is decided elsewhere."""
        rows = []
        for family, detector in self._detectors.items():
            standard = family.startswith("tagStandard")
            order = list(CORNERS_AS_APRILTAG_PRINTS if standard else CORNERS_AS_OPENCV_PRINTS)
            for tag in detector.detect(np.ascontiguousarray(grey)):
                uv = tag.corners[order] - PIXEL_ORIGIN
                rows.append((family, int(tag.tag_id), uv, int(tag.hamming), float(tag.decision_margin)))
        # The library's order depends on its hash tables; equal bytes for equal pictures need one of our own.
        rows.sort(key=lambda row: (row[0], row[1], row[2].tolist()))
        uv = np.array([row[2] for row in rows]).reshape(-1, 4, 2)
        return Found(
            family=np.array([row[0] for row in rows], object),
            tag_id=np.array([row[1] for row in rows], np.int32),
            uv=uv,
            cov=corner_covariance(uv, np.array([CELLS[row[0]] for row in rows], int)),
            side_px=np.linalg.norm(np.roll(uv, -1, axis=1) - uv, axis=-1).mean(axis=1),
            hamming=np.array([row[3] for row in rows], np.int32),
            margin=np.array([row[4] for row in rows], float),
        )
