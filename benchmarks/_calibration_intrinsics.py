"""Drawn lenses, calibrated from rendered views of a waved board."""

from __future__ import annotations

import numpy as np

from benchmarks._calibration_bars import Normalised, Row, normalised
from benchmarks._calibration_rigs import drawn
from pipeline.calibration.board import parse_board
from pipeline.calibration.corners import CornerFinder
from pipeline.calibration.procedure import calibrate_lens
from pipeline.geometry.lenses import BROWN5
from pipeline.synthetic.waved_board import PrintedBoard, WavedBoard

VIEWS = 30
SIZE = (640, 480)
BOARDS = (PrintedBoard(11, 8, 0.06), PrintedBoard(11, 8, 0.06, tag_share=0.75))


def drawn_lens(rng: np.random.Generator) -> np.ndarray:
    """(9,) a lens as they are sold for such cameras: 39 to 70 degrees wide, with barrel or pincushion."""
    f = rng.uniform(450, 900)
    k1 = rng.uniform(-0.25, 0.1)
    return np.array(
        [
            f, f * rng.normal(1, 0.003), rng.normal(319.5, 8), rng.normal(239.5, 8),
            k1, rng.uniform(-0.1, 0.35) * abs(k1), rng.normal(0, 0.0008), rng.normal(0, 0.0008), rng.normal(0, 0.01),
        ]
    )  # fmt: skip


def errors_of(seed: int) -> tuple[np.ndarray, float, float]:
    """Errors over sigmas (9,) of one drawn lens, the mean square of all together, and its place's sigma, m at 10 m."""
    rng = np.random.default_rng([seed, 606])
    truth = drawn_lens(rng)
    printed = BOARDS[seed % len(BOARDS)]
    waved, board = WavedBoard(printed, truth, SIZE, seed), parse_board(printed.text)
    finder = CornerFinder(board)
    noise, blur = rng.uniform(1.0, 3.0), rng.uniform(0.5, 1.0)
    for index, T in enumerate(waved.poses(VIEWS)):
        finder.add(str(index), waved.picture(index, T, blur, noise))
    found = calibrate_lens(BROWN5, finder.views(), board, SIZE)
    error = found.solution.intrinsics - truth
    together = float(error @ np.linalg.solve(found.solution.covariance, error)) / len(error)
    return error / found.solution.sigma, together, found.placing.total_m


def intrinsics(draws: int) -> list[Row]:
    """Intrinsics of drawn cameras: all nine, and each for itself."""
    lenses = drawn(errors_of, draws)
    z = np.array([one[0] for one in lenses])
    place_mm = 1000 * float(np.median([one[2] for one in lenses]))
    together = float(np.sqrt(np.mean([one[1] for one in lenses])))
    return [
        normalised("intrinsics", z, note=f"a tag's place to {place_mm:.1f} mm at 10 m, median"),
        Normalised("intrinsics, with correlations", draws, together, np.nan, False),
        *(normalised(name, z[:, i], held=False) for i, name in enumerate(BROWN5.parameters)),
    ]
