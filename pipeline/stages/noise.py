"""``gradetrace noise``: how corners scatter while nothing moves, from any log."""

from __future__ import annotations

from pathlib import Path

from pipeline.calibration.noise import COLUMNS, CornerNoise, corner_noise
from pipeline.report.noise_sheet import noise_sheet
from pipeline.report.sheet import Sheet
from pipeline.stages import stage_named
from pipeline.stages.calibrated import put_sheet
from pipeline.stages.job import Job
from pipeline.stages.runner import Watch, run_stale

READS_AS = "estimate"
"""The stage whose inputs are read: those of ingest and detect."""


def measure_noise(job: Job, distance_m: float, watch: Watch, out: Path | None = None) -> tuple[Sheet, Path]:
    """The sheet on corner noise of a log; runs ingest and detect where they are stale.

    Parameters
    ----------
    job
        Of the log; its run folder must be locked by the caller.
    distance_m
        Working distance at which millimetres are told.
    watch
        Who watches the stages.
    out
        Of the sheet; left out, ``noise.html`` in the run folder.

    Raises
    ------
    PipelineError
        What ingest and detect raise.
    """
    run_stale(job, watch, last="detect")
    here = job.at(stage_named(READS_AS), "")
    found: dict[str, CornerNoise] = {}
    for camera in here.parts("detections"):
        found[camera] = corner_noise(here.read_table("detections", list(COLUMNS), part=camera))
    cameras = here.calibrated_machine().cameras
    focal = {name: camera.intrinsics.fx for name, camera in cameras.items() if camera.intrinsics}
    sheet = noise_sheet(
        found, focal, distance_m, job.log.stem, {"file": job.log.name, "sha256": job.log_sha256}
    )
    page = out or job.folder.file("noise.html")
    put_sheet(sheet, page)
    return sheet, page
