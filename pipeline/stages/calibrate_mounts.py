"""`gradetrace calibrate mounts`: mounts and joint axes from a log, into machine.toml, with a sheet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.calibration.mounts import calibrate_mounts
from pipeline.report.mounts_sheet import mounts_sheet
from pipeline.stages.calibrated import Written, demand_of, pose_table, provenance, put_into, put_sheet
from pipeline.stages.calibration_log import searched
from pipeline.stages.runner import Watch

COMMAND = "calibrate mounts"


def run(
    log: Path,
    machine: Path | None,
    site: Path | None,
    runs: Path,
    workers: int,
    watch: Watch,
    free: Sequence[str] = (),
    distance_m: float = 3.0,
) -> Written:
    """Calibrate what is freed and write it. Raises PipelineError; nothing is written then."""
    with searched(log, machine, site, runs, workers, watch) as found:
        mounts = calibrate_mounts(found.machine, found.site, free, found.detections)
        sheet = mounts_sheet(
            mounts,
            demand_of(found.site, distance_m),
            subject=found.machine.machine.id,
            origin=found.origin,
        )
        stamp = provenance(found.date, COMMAND, found.job.log, found.job.log_sha256)
        values: dict[str, Any] = {t.key: pose_table(t.T, t.covariance, stamp) for t in mounts.told}
        page = found.folder / "calibration-mounts.html"
        put_sheet(sheet, page)
        kept = put_into(found.machine_file, "machine", values)
    return Written(sheet.sentence, tuple(sheet.remarks), page, found.machine_file, kept)
