"""As-built cells, verdicts, volumes and sides of many drawn trenches against their truth: `make bench-trenches`.

Trenches are dug by a drawn operator (`_drawn_trenches`) and surveyed with drawn errors of the stated covariance; the
truth is what the same edge leaves without errors. Bars: errors of cells and of stations over their sigma 0.9 to 1.1
RMS, no bias above 0.2 sigma, while the plain lowest pass is biased by more; of stations called PASS fewer than 5 % are
truly outside, of those called FAIL fewer than 5 % truly inside; errors of volumes and of sides within their sigma (RMS
at most 1.1). Runs on every core.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from dataclasses import dataclass

import numpy as np

from benchmarks._drawn_trenches import DrawnTrench, draw_trench
from benchmarks._results import keep_result
from pipeline.surface.as_built import AsBuilt, SurfaceRule, as_built
from pipeline.surface.decision import FAIL, PASS, Stations, ToleranceBand, judge, stations_along
from pipeline.surface.ground import Ground, LevelGround
from pipeline.surface.sides import Sides, sides
from pipeline.surface.sweep import path_along
from pipeline.surface.volumes import KINDS, Volumes, volumes
from pipeline.tracks.poses import CuttingEdge

TRENCHES = 120
STEP_M, CELL_M = 0.5, 0.05
BAND = ToleranceBand(0.030, 0.030)
DEVIATION_M = (0.008, 0.025)
"""How far operators leave the floor from its design, drawn between these."""
CELLS_BAR, BIAS_BAR, WRONG_BAR, VOLUME_BAR = (0.9, 1.1), 0.2, 0.05, 1.1


@dataclass(frozen=True)
class Survey:
    """What one edge leads to."""

    built: AsBuilt
    stations: Stations
    sides: Sides
    volumes: Volumes


@dataclass(frozen=True)
class Errors:
    """Errors of one trench over their sigmas."""

    cells: np.ndarray
    plain: np.ndarray
    """Of cells without the correction of the lowest pass."""
    stations: np.ndarray
    """Of deviations over their sigmas; less the common error, over their own part: (2, n)."""
    passed_wrong: int
    passed: int
    failed_wrong: int
    failed: int
    volumes: np.ndarray
    """(3,) cut, left to cut, over-dug."""
    sides: np.ndarray


def survey(drawn: DrawnTrench, edge: CuttingEdge, corrected: bool = True) -> Survey:
    """Everything that the survey stage makes of one edge."""
    path = path_along(edge, drawn.alignment)
    built = as_built(edge, drawn.alignment, drawn.design, CELL_M, SurfaceRule(corrected=corrected), path)
    station = stations_along(drawn.design, drawn.alignment.start_station, drawn.alignment.end_station, STEP_M)
    both = sides(path, built, drawn.design, station, STEP_M)
    ground = Ground(LevelGround(drawn.ground_h), 0.0)
    soil = volumes(built, drawn.design, ground, both.rows, station, STEP_M)
    return Survey(built, judge(built, drawn.design, station, STEP_M, BAND), both, soil)


def errors_of(seed: int) -> Errors:
    """One drawn trench, surveyed and compared."""
    rng = np.random.default_rng(seed)
    drawn = draw_trench(rng, deviation_m=rng.uniform(*DEVIATION_M))
    true, found = survey(drawn, drawn.truth, corrected=False), survey(drawn, drawn.measured)
    plain = survey(drawn, drawn.measured, corrected=False)
    inside = np.abs(true.stations.deviation) <= BAND.high_m
    known = np.isfinite(true.stations.deviation)
    passed = known & (found.stations.verdict == PASS)
    failed = known & (found.stations.verdict == FAIL)
    off = found.stations.deviation - true.stations.deviation
    told = np.isfinite(off)
    raised = (drawn.measured.p_grid - drawn.truth.p_grid)[:, 1, 2].mean()
    own, common = found.stations.sigma_own[told], found.stations.sigma_common[told]
    across = (found.sides.outward - true.sides.outward) / np.hypot(
        found.sides.sigma_own, found.sides.sigma_common
    )
    return Errors(
        cells=_cells(found.built, true.built),
        plain=_cells(plain.built, true.built),
        stations=np.stack([off[told] / np.hypot(own, common), (off[told] - raised) / own]),
        passed_wrong=int(np.count_nonzero(passed & ~inside)),
        passed=int(np.count_nonzero(passed)),
        failed_wrong=int(np.count_nonzero(failed & inside)),
        failed=int(np.count_nonzero(failed)),
        volumes=np.array([(a.m3 - b.m3) / a.sigma_m3 for a, b in zip(found.volumes.job, true.volumes.job)]),
        sides=across[np.isfinite(across)],
    )


def _cells(found: AsBuilt, true: AsBuilt) -> np.ndarray:
    """Errors of the floor's cells over their sigmas, where both were cut."""
    row = np.round((found.grid.station - true.grid.station[0]) / CELL_M).astype(int)
    column = np.round((found.grid.offset - true.grid.offset[0]) / CELL_M).astype(int)
    rows, columns = (
        (row >= 0) & (row < true.grid.rows),
        (column >= 0) & (column < true.grid.columns),
    )
    h = np.full(found.h.shape, np.nan)
    h[np.ix_(rows, columns)] = true.h[np.ix_(row[rows], column[columns])]
    error = (found.h - h) / np.hypot(found.sigma_own, found.sigma_common)
    return error[found.floor & np.isfinite(error)]


def main() -> int:
    """Run, print the table and the line, keep the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trenches", type=int, default=TRENCHES)
    count = parser.parse_args().trenches
    with multiprocessing.get_context("spawn").Pool(os.cpu_count()) as pool:
        drawn = list(pool.imap(errors_of, range(count)))
    # A job is one draw of the common error: each counts alike, however many cells it has.
    rms = float(np.sqrt(np.mean([np.mean(one.cells**2) for one in drawn])))
    bias, plain = (
        float(np.mean([np.mean(part) for part in parts]))
        for parts in ([one.cells for one in drawn], [one.plain for one in drawn])
    )
    passed, failed = sum(one.passed for one in drawn), sum(one.failed for one in drawn)
    passed_wrong, failed_wrong = (
        sum(one.passed_wrong for one in drawn),
        sum(one.failed_wrong for one in drawn),
    )
    of_volumes = np.sqrt(np.mean([one.volumes**2 for one in drawn], axis=0))
    of_stations, of_own = np.sqrt(np.mean([np.mean(one.stations**2, axis=1) for one in drawn], axis=0))
    of_sides = float(np.sqrt(np.mean(np.concatenate([one.sides for one in drawn]) ** 2)))
    print(
        f"cells: error over sigma {rms:.2f} RMS, bias {bias:+.2f}; without the correction bias {plain:+.2f}"
    )
    print(
        f"stations: error over sigma {of_stations:.2f} RMS; without the common error over the own part {of_own:.2f}"
    )
    print(f"PASS {passed}, truly outside {passed_wrong}; FAIL {failed}, truly inside {failed_wrong}")
    for kind, value in zip(KINDS, of_volumes):
        print(f"volume {kind}: error over sigma {value:.2f} RMS")
    print(f"sides: error over sigma {of_sides:.2f} RMS")
    line = (
        f"trenches: {count} drawn; cells {rms:.2f} of sigma, bias {bias:+.2f} (plain {plain:+.2f}); "
        f"stations {of_stations:.2f}, own part {of_own:.2f}; "
        f"PASS {passed_wrong} of {passed} wrong, FAIL {failed_wrong} of {failed}; "
        f"volumes {', '.join(f'{kind} {value:.2f}' for kind, value in zip(KINDS, of_volumes))}; sides {of_sides:.2f}"
    )
    row = {
        "trenches": count, "cells_rms": rms, "cells_bias": bias, "plain_bias": plain,
        "stations_rms": float(of_stations), "stations_own_rms": float(of_own),
        "passed": passed, "passed_wrong": passed_wrong, "failed": failed, "failed_wrong": failed_wrong,
        **{f"volume {kind}": float(value) for kind, value in zip(KINDS, of_volumes)}, "sides_rms": of_sides,
    }  # fmt: skip
    keep_result("trenches", [row], line)
    print(line)
    missed = [
        what
        for what, bad in (
            ("cells", not CELLS_BAR[0] <= rms <= CELLS_BAR[1]),
            ("stations", not CELLS_BAR[0] <= of_stations <= CELLS_BAR[1]),
            ("bias", abs(bias) > BIAS_BAR),
            ("plain", abs(plain) <= BIAS_BAR),
            ("PASS", passed_wrong >= WRONG_BAR * passed),
            ("FAIL", failed_wrong >= WRONG_BAR * failed),
            ("volumes", float(of_volumes.max()) > VOLUME_BAR),
            ("sides", of_sides > VOLUME_BAR),
        )
        if bad
    ]
    for what in missed:
        print(f"missed bar: {what}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
