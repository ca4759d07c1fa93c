"""``gradetrace calibrate bucket`` for a bucket whose angle a belt shows: its phase and the edge into machine.toml."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.calibration.belt import EdgeTouch, calibrate_belt
from pipeline.config import Site
from pipeline.errors import CalibrationError
from pipeline.report.belt_sheet import belt_sheet
from pipeline.report.sheet import SHARE
from pipeline.stages.bucket_files import COMMAND, belt_values, points_of
from pipeline.stages.calibrated import Written, provenance, put_into, refuse_twice
from pipeline.stages.calibration_log import searched
from pipeline.stages.runner import Watch
from pipeline.surface.shots import NO_TIME


def run(
    log: Path,
    checks: Path | None,
    machine: Path | None,
    site: Path | None,
    runs: Path,
    workers: int,
    watch: Watch,
    belt: str,
    point: str | None = None,
    tooth: str = "middle",
    contact_m: float = 1e-3,
) -> Written:
    """Calibrate a belt by the touches of a check file and write it. Raises PipelineError; nothing is written then."""
    with searched(log, machine, site, runs, workers, watch) as found:
        touches, known = edge_touches(checks, point, found.site, tooth, contact_m)
        refuse_twice(found.machine, found.job.log_sha256, ())
        told = calibrate_belt(found.machine, found.site, belt, found.detections, touches, known)
        tolerance = found.site.tolerance
        allowed_m = min(tolerance.high_mm, tolerance.low_mm) / 1000 * SHARE
        sheet = belt_sheet(told, allowed_m, found.machine.machine.id, found.origin)
        stamp = provenance(found.date, COMMAND, found.job.log, found.job.log_sha256)
        page = found.folder / "belt.html"
        values = belt_values(found.machine, told, stamp)
        kept = put_into(found.machine_file, "machine", values, sheet, page)
    return Written(sheet.sentence, tuple(sheet.remarks), page, found.machine_file, kept)


def edge_touches(
    checks: Path | None, point: str | None, site: Site, tooth: str, contact_m: float
) -> tuple[list[EdgeTouch], dict[str, float]]:
    """Touches with a time, and sigmas of the known points among them in the order of their indices.

    Raises
    ------
    CalibrationError
        There is no point, or a touch has no time.
    """
    shots, points = points_of(checks, point, site)
    origin = site.grid.to_grid_metres(np.zeros(3))
    usual_m = (2.0 if site.checks is None else site.checks.sigma_mm) / 1000
    known: dict[str, float] = {}
    touches: list[EdgeTouch] = []
    for k in range(len(shots)):
        kind, name = str(shots.kind[k]), str(shots.point[k])
        if kind == "floor":
            continue
        if shots.time_ns[k] == NO_TIME:
            raise CalibrationError(
                f"touch '{name[:40]}' has no time, and the belt shows no rest by itself; add a column time"
            )
        given = points.get(name) if kind == "control" else None
        p = shots.p_grid[k] if given is None else given.p_grid
        sigma_m = float(shots.sigma_m[k]) if given is None else given.sigma_m
        sigma_m = sigma_m if np.isfinite(sigma_m) else usual_m
        if kind == "control":
            known.setdefault(name, sigma_m)
        touches.append(
            EdgeTouch(
                f"{name} {len(touches) + 1}",
                int(shots.time_ns[k]),
                p - origin,
                contact_m if kind == "control" else sigma_m,
                list(known).index(name) if kind == "control" else -1,
                str(shots.edge_point[k]) or ("" if tooth == "any" or kind == "edge" else tooth),
            )
        )
    return touches, known
