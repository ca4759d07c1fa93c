"""`gradetrace calibrate mounts`: mounts and joint axes from a log, into machine.toml, with a sheet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration.mounts import calibrate_mounts
from pipeline.calibration.pins import PinShot
from pipeline.config import Machine, Site
from pipeline.config.machine import JointBody
from pipeline.errors import CalibrationError
from pipeline.report.mounts_sheet import mounts_sheet
from pipeline.stages.calibrated import Written, demand_of, pose_table, provenance, put_into, refuse_twice
from pipeline.stages.calibration_log import searched
from pipeline.stages.runner import Watch
from pipeline.surface.shots import NO_TIME, order_of, read_shots

COMMAND = "gradetrace calibrate mounts"


def run(
    log: Path,
    machine: Path | None,
    site: Path | None,
    runs: Path,
    workers: int,
    watch: Watch,
    free: Sequence[str] = (),
    distance_m: float = 3.0,
    pins: Path | None = None,
) -> Written:
    """Calibrate what is freed, and what pins were shot of, and write it.

    Raises PipelineError; nothing is written then.
    """
    with searched(log, machine, site, runs, workers, watch) as found:
        shots = [] if pins is None else pin_shots(pins, found.machine, found.site)
        refuse_twice(found.machine, found.job.log_sha256, [*free, *(f"bodies.{s.joint}.axis" for s in shots)])
        mounts = calibrate_mounts(found.machine, found.site, free, found.detections, shots)
        sheet = mounts_sheet(
            mounts,
            demand_of(found.site, distance_m),
            subject=found.machine.machine.id,
            origin=found.origin,
        )
        stamp = provenance(found.date, COMMAND, found.job.log, found.job.log_sha256)
        values: dict[str, Any] = {t.key: pose_table(t.T, t.covariance, stamp) for t in mounts.told}
        page = found.folder / "calibration-mounts.html"
        kept = put_into(found.machine_file, "machine", values, sheet, page)
    return Written(sheet.sentence, tuple(sheet.remarks), page, found.machine_file, kept)


def pin_shots(file: Path, machine: Machine, site: Site) -> list[PinShot]:
    """Shots of pins, each named after the joint that turns about it: `bucket-L`.

    Raises
    ------
    CalibrationError
        A shot belongs to no joint or has no time, or there is none.
    SurfaceError
        The file is no table of shots.
    """
    checks, scale = site.checks, site.grid.metres_per_unit
    shots = read_shots(
        file,
        "named" if checks is None else order_of(file, checks.order),
        scale,
        site.report.time_zone,
    )
    origin = site.grid.to_grid_metres(np.zeros(3))
    joints = [name for name, body in machine.bodies.items() if isinstance(body, JointBody)]
    usual_m = (2.0 if checks is None else checks.sigma_mm) / 1000
    found = []
    for name, p, time_ns, sigma_m in zip(
        shots.point.astype(str), shots.p_grid, shots.time_ns, shots.sigma_m, strict=True
    ):
        of = [joint for joint in joints if name == joint or name.startswith(f"{joint}-")]
        if not of:
            raise CalibrationError(
                f"{file.name}: '{name[:40]}' is named after no joint of machine.toml ({', '.join(joints) or 'none'}); "
                "call the ends of the bucket's pin bucket-L and bucket-R"
            )
        if time_ns == NO_TIME:
            raise CalibrationError(
                f"{file.name}: shot '{name[:40]}' has no time; add a column time, such as 2025-06-15T15:07:20Z"
            )
        found.append(
            PinShot(
                name, max(of, key=len), int(time_ns), p - origin, float(sigma_m if sigma_m > 0 else usual_m)
            )
        )
    if not found:
        raise CalibrationError(f"{file.name}: there is no shot in it")
    return found
