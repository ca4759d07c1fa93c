"""The board that is waved before a camera: what is printed on it, and where its corners lie.

The frame of a board has x to the right and y down on the print, so that z points away from who looks at it. How large
the squares are does not matter to intrinsics, only that they are all of one size.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from pipeline.config.quantities import ALSO_CALLED, FAMILIES
from pipeline.errors import CalibrationError

CHESSBOARD, CHARUCO, APRILTAG = "chessboard", "charuco", "apriltag"
EXAMPLES = {
    CHESSBOARD: "chessboard:10x7:0.025 (inner corners, side of a square in metres)",
    CHARUCO: "charuco:7x5:0.04:0.03:DICT_4X4_50 (squares, side of a square, side of a tag, dictionary)",
    APRILTAG: "apriltag:6x6:0.088:0.0264:tag36h11 (tags, side of a tag, gap between tags, family, first id if not 0)",
}
MOST = 60
"""Corners or tags along one side of a board."""


@dataclass(frozen=True)
class CalibrationBoard:
    """A planar board with known corners."""

    kind: str
    """CHESSBOARD, CHARUCO or APRILTAG."""
    columns: int
    """Inner corners of a chessboard, squares of a ChArUco board, tags of a grid."""
    rows: int
    square_m: float
    """Side of a square; of a tag in a grid, the outer side of its black border."""
    second_m: float = 0.0
    """Side of a ChArUco tag, or the gap between the tags of a grid."""
    family: str = ""
    first_id: int = 0

    @property
    def text(self) -> str:
        """As it is written on the command line."""
        parts = [self.kind, f"{self.columns}x{self.rows}", f"{self.square_m:g}"]
        if self.kind != CHESSBOARD:
            parts += [f"{self.second_m:g}", self.family]
        return ":".join([*parts, *([str(self.first_id)] if self.first_id else [])])

    @property
    def corners_m(self) -> np.ndarray:
        """(n, 3) metres; row by row from the top left, tag by tag in a grid (top-left, top-right, bottom-right,
        bottom-left of each).
        """
        columns, rows = (
            (self.columns - 1, self.rows - 1) if self.kind == CHARUCO else (self.columns, self.rows)
        )
        pitch = self.square_m + (self.second_m if self.kind == APRILTAG else 0.0)
        row, column = (part.ravel() for part in np.mgrid[0:rows, 0:columns])
        p = pitch * np.column_stack([column, row, np.zeros(len(row))])
        if self.kind != APRILTAG:
            return p
        around = self.square_m * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        return (p[:, None] + around).reshape(-1, 3)


def parse_board(text: str) -> CalibrationBoard:
    """A board from its short text.

    Parameters
    ----------
    text : str
        As in `EXAMPLES`.

    Raises
    ------
    CalibrationError
        It is none; the message says how it is written.
    """
    kind, *rest = text.strip().split(":")
    if kind not in EXAMPLES:
        raise CalibrationError(
            f"board '{text}': begins with none of {', '.join(EXAMPLES)}; for example {EXAMPLES[CHARUCO]}"
        )
    wanted = {CHESSBOARD: (2, 2), CHARUCO: (4, 4), APRILTAG: (4, 5)}[kind]
    size = re.fullmatch(r"(\d{1,3})x(\d{1,3})", rest[0]) if rest else None
    if not wanted[0] <= len(rest) <= wanted[1] or size is None:
        raise CalibrationError(f"board '{text}': a {kind} board is written {EXAMPLES[kind]}")
    columns, rows = (int(part) for part in size.groups())
    least = {CHESSBOARD: 3, CHARUCO: 3, APRILTAG: 1}[kind]
    if not (least <= columns <= MOST and least <= rows <= MOST):
        raise CalibrationError(f"board '{text}': {columns} x {rows} is none, {least} to {MOST} each way are")
    lengths = []
    for part in rest[1 : 2 if kind == CHESSBOARD else 3]:
        try:
            lengths.append(float(part))
        except ValueError:
            lengths.append(float("nan"))
    if not all(0 < length < 10 for length in lengths):
        raise CalibrationError(f"board '{text}': lengths are metres between 0 and 10: {EXAMPLES[kind]}")
    if kind == CHESSBOARD:
        return CalibrationBoard(kind, columns, rows, lengths[0])
    if kind == CHARUCO and lengths[1] >= lengths[0]:
        raise CalibrationError(f"board '{text}': the tag ({lengths[1]:g} m) must be smaller than its square")
    family = ALSO_CALLED.get(rest[3], rest[3])
    first = rest[4] if len(rest) > 4 else "0"
    if family not in FAMILIES or (kind == CHARUCO and not family.startswith("DICT_")) or not first.isdigit():
        raise CalibrationError(f"board '{text}': the family or the first id is not known: {EXAMPLES[kind]}")
    tags = columns * rows // 2 if kind == CHARUCO else columns * rows
    if int(first) + tags > FAMILIES[family]:
        raise CalibrationError(f"board '{text}': needs {tags} tags, {family} has {FAMILIES[family]}")
    return CalibrationBoard(kind, columns, rows, lengths[0], lengths[1], family, int(first))
