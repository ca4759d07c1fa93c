"""OpenCV's ArUco dictionaries as AprilTag's library wants to be told of them.

AprilTag's search takes any square code within a black border, if it gets its table; so one search serves all
families, and bits corrected, decision margin and sharpening mean the same for all of them. OpenCV's own search was
measured beside it (DICT_6X6_250 facing the camera, blur 0.5 to 0.9 px, noise 2, JPEG 85, 100 tags each 20 / 30 / 60
/ 160 px wide, RMS corner error per axis):

    OpenCV, corners as found             0.69   0.74   0.59   0.58 px
    OpenCV, CORNER_REFINE_SUBPIX         0.46   0.53   0.21   0.12
    OpenCV, CORNER_REFINE_APRILTAG       0.46   0.47   0.47   0.46   (finds 78 of 100 at 20 px)
    this search                          0.17   0.13   0.09   0.07
    and refined (`refine`)               0.014  0.011  0.008  0.005

It found 75 % of tags 16 px wide, says nothing of bits and contrast, and takes 10 to 28 times as long in a window.
It remains the oracle of the tests.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np

from pipeline.config.quantities import FAMILIES
from pipeline.detection.prints import aruco_dictionary, print_of


class LibraryFamily(ctypes.Structure):
    """The C library's `apriltag_family_t`, whole: its wrapper leaves out the last field, which the library writes."""

    _fields_ = (
        ("ncodes", ctypes.c_uint32),
        ("codes", ctypes.POINTER(ctypes.c_uint64)),
        ("width_at_border", ctypes.c_int),
        ("total_width", ctypes.c_int),
        ("reversed_border", ctypes.c_bool),
        ("nbits", ctypes.c_uint32),
        ("bit_x", ctypes.POINTER(ctypes.c_uint32)),
        ("bit_y", ctypes.POINTER(ctypes.c_uint32)),
        ("h", ctypes.c_uint32),
        ("name", ctypes.c_char_p),
        ("impl", ctypes.c_void_p),
    )


def library_family(family: str) -> tuple[LibraryFamily, object]:
    """An ArUco dictionary for `apriltag_detector_add_family_bits`, and what must live as long as it does.

    A new one each time: the library hangs its own table into it and frees that with the detector.
    """
    codes, column, row = code_table(family)
    arrays = codes.copy(), column.astype(np.uint32), row.astype(np.uint32)
    size = aruco_dictionary(family).markerSize
    made = LibraryFamily(
        ncodes=len(codes),
        codes=arrays[0].ctypes.data_as(ctypes.POINTER(ctypes.c_uint64)),
        width_at_border=size + 2,
        total_width=size + 4,
        reversed_border=False,
        nbits=size * size,
        bit_x=arrays[1].ctypes.data_as(ctypes.POINTER(ctypes.c_uint32)),
        bit_y=arrays[2].ctypes.data_as(ctypes.POINTER(ctypes.c_uint32)),
        h=2 * correctable_bits(family) + 1,
        name=family.encode(),
        impl=None,
    )
    return made, arrays


def correctable_bits(family: str) -> int:
    """How many wrong bits a dictionary can put right without taking one tag for another."""
    return int(aruco_dictionary(family).maxCorrectionBits)


@cache
def code_table(family: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Codes (n,) uint64 of a dictionary, and column and row of each bit, the highest first, in cells of the quad."""
    size = aruco_dictionary(family).markerSize
    column, row = bits_by_quarters(size)
    shift = np.arange(size * size)[::-1].astype(np.uint64)
    # One cell of quiet zone and one of border lie outside the bits.
    bits = [print_of(family, number).cells[row + 2, column + 2] for number in range(FAMILIES[family])]
    codes = np.bitwise_or.reduce(np.array(bits).astype(np.uint64) << shift, axis=1)
    return codes, column + 1, row + 1


def bits_by_quarters(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of the cells of a square, in the library's order: a quarter turn moves them on by a quarter.

    Its decoder turns a code by rotating its bits; a cell in the middle, which stays where it is, comes last.
    """
    cells = []
    quarter = [(x, y) for y in range(size // 2) for x in range((size + 1) // 2)]
    for _ in range(4):
        cells += quarter
        quarter = [(size - 1 - y, x) for x, y in quarter]
    if size % 2:
        cells.append((size // 2, size // 2))
    column, row = np.array(cells).T
    return column, row
