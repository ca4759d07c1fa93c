"""From the views of a recording to intrinsics that may be used, or a sentence on why not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.calibration.board import CalibrationBoard
from pipeline.calibration.coverage import Coverage, coverage
from pipeline.calibration.intrinsics import Solution, solve
from pipeline.calibration.placing import Difference, Placing, difference, placing
from pipeline.calibration.start import first_guess, pose_of
from pipeline.calibration.views import View, most_telling
from pipeline.errors import CalibrationError
from pipeline.geometry.lenses import Lens

LEAST_VIEWS = 4
MOST_VIEWS = 60
"""Beyond, more views add little to what is known and much to errors that repeat from frame to frame."""
MOST_CANDIDATES = 240
"""Views among which those are chosen."""
LEAST_EACH_HALF = 4
"""Views of a half of the recording that are solved apart."""
WORST_FOCAL = 0.01
"""Standard deviation of the focal length beyond which nothing is written: 100 mm at 10 m."""
ALIKE_DEG = 8.0
"""Angle between the attitudes of the board below which they are one."""
WORST_RMS = 0.002
"""Residual, as a part of the picture's width, of a board that is not the one described."""


@dataclass(frozen=True)
class Intrinsics:
    """What a recording says of a lens."""

    lens: Lens
    size: tuple[int, int]
    """Width and height, px."""
    distance_m: float
    """Working distance at which millimetres are given."""
    solution: Solution
    views: list[View]
    """Those that were solved with."""
    found: int
    """Views in all."""
    placing: Placing
    halves: Difference | None
    """Odd views against even ones; None where there are too few."""
    coverage: Coverage


def calibrate_lens(
    lens: Lens,
    views: Sequence[View],
    board: CalibrationBoard,
    size: tuple[int, int],
    distance_m: float = 10.0,
    most: int = MOST_VIEWS,
) -> Intrinsics:
    """Intrinsics from the views of a board.

    Parameters
    ----------
    lens : Lens
        Its model.
    views : sequence of View
        In the order of the recording.
    board : CalibrationBoard
        What they show.
    size : (width, height)
        Of the pictures, px.
    distance_m : float
        Working distance.
    most : int
        Views to solve with.

    Raises
    ------
    CalibrationError
        Too few views, all alike, another board, or a focal length that nobody should use.
    """
    corners = board.corners_m
    found = len(views)
    _refuse_few(found)
    if found > MOST_CANDIDATES:
        views = [views[i] for i in np.linspace(0, found - 1, MOST_CANDIDATES).round().astype(int)]
    k, T = first_guess(lens, views, corners, size)
    first = solve(lens, views, corners, k, T)
    _refuse_other_board(first, size)
    good = np.flatnonzero(first.views_used)
    _refuse_few(len(good))
    chosen = good[most_telling(list(first.information[good]), most)]
    views = [views[i] for i in chosen]
    solution = solve(lens, views, corners, first.intrinsics, first.T_camera_board[chosen])
    there = np.flatnonzero(solution.views_used)
    _refuse_few(len(there))
    covered = coverage([views[i] for i in there], solution.T_camera_board[there], corners, size)
    _refuse_unknown(solution, covered, len(there))
    return Intrinsics(
        lens=lens,
        size=size,
        distance_m=distance_m,
        solution=solution,
        views=views,
        found=found,
        placing=placing(lens, solution.intrinsics, solution.covariance, size, distance_m),
        halves=_halves(lens, [views[i] for i in there], corners, solution, size, distance_m),
        coverage=covered,
    )


def _halves(
    lens: Lens,
    views: Sequence[View],
    corners: np.ndarray,
    whole: Solution,
    size: tuple[int, int],
    distance_m: float,
) -> Difference | None:
    """Odd views against even ones."""
    if len(views) < 2 * LEAST_EACH_HALF:
        return None
    parts = []
    for half in (views[::2], views[1::2]):
        T = np.array([pose_of(lens, whole.intrinsics, view, corners)[0] for view in half])
        try:
            part = solve(lens, half, corners, whole.intrinsics, T)
        except CalibrationError:
            return None
        parts.append((part.intrinsics, part.covariance))
    return difference(lens, parts[0], parts[1], size, distance_m)


def _refuse_few(count: int) -> None:
    if count < LEAST_VIEWS:
        raise CalibrationError(
            f"{count or 'no'} usable view{'' if count == 1 else 's'} of the board, at least {LEAST_VIEWS} are needed "
            "and 30 are good; wave the board before the camera, near and far, tilted, and into every corner of the "
            "picture"
        )


def _refuse_other_board(solution: Solution, size: tuple[int, int]) -> None:
    used = solution.views_used
    if solution.rms_px > WORST_RMS * size[0] or np.count_nonzero(used) < 0.5 * len(used):
        raise CalibrationError(
            f"the corners lie {solution.rms_px:.1f} px from where a board of this layout puts them, in "
            f"{np.count_nonzero(used)} of {len(used)} views at all; correct --board: columns, rows, and the tag's "
            "side or gap beside the square's"
        )


def _refuse_unknown(solution: Solution, covered: Coverage, count: int) -> None:
    if covered.tilt_deg < ALIKE_DEG:
        raise CalibrationError(
            f"the board has one attitude in all {count} views (within {covered.tilt_deg:.0f} degrees), so that focal "
            "length and distance cannot be told apart; tilt it by 20 to 40 degrees to every side"
        )
    part = float(np.max(solution.sigma[:2] / solution.intrinsics[:2]))
    if part > WORST_FOCAL:
        raise CalibrationError(
            f"the focal length is known to {100 * part:.1f} % only, at most {100 * WORST_FOCAL:.0f} % is of use; add "
            "views of the board tilted by 20 to 40 degrees, near and far"
        )
