"""What is printed: the cells of each tag of each family, as the house turns and counts them.

Three kinds of family, one form:

- tag36h11, tag25h9, tag16h5: AprilTag's classic families, turned as OpenCV draws them;
- tagStandard41h12: as the AprilTag project draws it, from the code table of its library; its quad is the seam between
  a black ring and the white ring inside it, and its outermost cells are data;
- OpenCV's ArUco dictionaries by OpenCV's names (DICT_4X4_50 ...), as OpenCV draws them.

One white cell stands around every print but tagStandard's: a tag glued on black has no edge.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from pyapriltags import apriltags

from pipeline.config.quantities import FAMILIES
from pipeline.errors import DetectionError

CLASSIC = {
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
}
"""AprilTag family -> OpenCV's dictionary of the same tags. OpenCV's order of corners is the house's."""
STANDARD_ACROSS = 5
STANDARD_CELLS = 9
STANDARD_BITS = 41
SURE_BITS = 10.0
"""Bits to spare that make a tag of texture rare enough: one quad in 1,000."""


@dataclass(frozen=True)
class Print:
    """One tag as it is printed."""

    cells: np.ndarray
    """(n, n) float64, 1 white and 0 black; first row on top, so that corners 0..3 of the quad are top-left, top-right,
    bottom-right, bottom-left. Read-only."""
    border: int
    """Width in cells of the quad whose corners are reported; it lies in the middle of the cells."""


def is_aruco(family: str) -> bool:
    """Whether a family is one of OpenCV's ArUco dictionaries, which OpenCV's own search finds."""
    return family.startswith("DICT_")


def aruco_dictionary(family: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family, classic AprilTag or ArUco. Raises DetectionError."""
    _check_family(family)
    constant = CLASSIC.get(family)
    if constant is None:
        # Dictionaries were added over the years, and the file may name one that this OpenCV has not.
        constant = getattr(cv2.aruco, family, None)
    if constant is None:
        raise DetectionError(
            f"the installed OpenCV {cv2.__version__} has no dictionary {family}; print another"
        )
    return cv2.aruco.getPredefinedDictionary(constant)


@cache
def cells_across(family: str) -> int:
    """How many cells wide the quad of a family is: the outer side of the black border, 5 of 9 for tagStandard41h12.

    Raises DetectionError for a family that is not known.
    """
    _check_family(family)
    if family == "tagStandard41h12":
        return STANDARD_ACROSS
    return int(aruco_dictionary(family).markerSize) + 2


@cache
def spare_bits(family: str, corrected: int = 0) -> float:
    """How many bits a family's codes have beyond telling its tags apart: texture hits one in ``2 ** spare_bits``.

    The four ways a quad can be turned are counted, and all codes that correcting so many bits lets pass.
    """
    bits = code_length(family)
    passing = sum(math.comb(bits, wrong) for wrong in range(corrected + 1))
    return float(bits - np.log2(4 * FAMILIES[family] * passing))


def code_length(family: str) -> int:
    """Bits of a family's codes."""
    return STANDARD_BITS if family == "tagStandard41h12" else (cells_across(family) - 2) ** 2


@cache
def hamming_limit(family: str) -> int:
    """How many wrong bits are worth correcting: of more, texture makes tags.

    In 504 textured frames of 640 x 480 without a tag, all ids counted, margin 20 and over:

        bits corrected    tag36h11  DICT_6X6_250  DICT_5X5_100  tag25h9  tag16h5  DICT_4X4_50
        0                     0          0             0           0        3         13
        1                     0          0             0           0       71        184
        2                     1          -             -           1      553          -
    """
    allowed = [wrong for wrong in range(1, 3) if spare_bits(family, wrong) >= SURE_BITS]
    return max(allowed, default=0)


def print_of(family: str, tag_id: int) -> Print:
    """The print of one tag.

    Parameters
    ----------
    family : str
        One of `pipeline.config.quantities.FAMILIES`.
    tag_id : int
        From 0 to the number of the family's tags.

    Raises
    ------
    DetectionError
        There is no such family, or no such tag in it. The C libraries read past their tables instead.
    """
    _check_family(family)
    number = int(tag_id)
    if not 0 <= number < FAMILIES[family]:
        raise DetectionError(
            f"{family} has the ids 0 to {FAMILIES[family] - 1}, there is no tag {number} in it"
        )
    return _print(family, number)


@cache
def _print(family: str, tag_id: int) -> Print:
    if family == "tagStandard41h12":
        cells = _standard_cells(tag_id)
    else:
        dictionary = aruco_dictionary(family)
        bits = dictionary.getBitsFromByteList(
            dictionary.bytesList[tag_id : tag_id + 1], dictionary.markerSize
        )
        black = np.pad(bits.astype(float), 1, constant_values=0.0)
        cells = np.pad(black, 1, constant_values=1.0)
    cells.setflags(write=False)
    return Print(cells, cells_across(family))


def _standard_cells(tag_id: int) -> np.ndarray:
    """(9, 9): 32 bits around, a black ring, a white ring, 9 bits inside."""
    codes, column, row = _standard_table()
    cells = np.zeros((STANDARD_CELLS, STANDARD_CELLS))
    first = (STANDARD_CELLS - STANDARD_ACROSS) // 2
    last = first + STANDARD_ACROSS - 1
    cells[first : last + 1, [first, last]] = 1.0
    cells[[first, last], first : last + 1] = 1.0
    for k, (x, y) in enumerate(zip(column, row)):
        cells[y + first, x + first] = (codes[tag_id] >> (len(column) - 1 - k)) & 1
    return cells


@cache
def _standard_table() -> tuple[list[int], list[int], list[int]]:
    """Codes, and column and row of each of their bits counted from the quad's first cell, of tagStandard41h12."""
    # The wrapper's Detector would build its table of a million mistaken codes only to be asked for the right ones.
    folder = Path(apriltags.__file__).parent
    library = next(
        path for path in sorted(folder.rglob("*apriltag.*")) if path.suffix in (".so", ".dylib", ".dll")
    )
    loaded = ctypes.CDLL(str(library))
    make = loaded.tagStandard41h12_create
    make.restype = ctypes.POINTER(apriltags._ApriltagFamily)
    family = make().contents
    assert (family.total_width, family.width_at_border) == (STANDARD_CELLS, STANDARD_ACROSS)
    assert family.reversed_border and family.nbits == STANDARD_BITS
    codes = [int(family.codes[k]) for k in range(family.ncodes)]
    n = int(family.nbits)
    return codes, [int(family.bit_x[k]) for k in range(n)], [int(family.bit_y[k]) for k in range(n)]


def _check_family(family: str) -> None:
    if family not in FAMILIES:
        raise DetectionError(f"there is no family {family!r}; known are {', '.join(FAMILIES)}")
