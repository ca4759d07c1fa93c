"""A log to calibrate with: read and searched by the stages that every log goes through, and what they found."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np

from pipeline.config import Machine, Site
from pipeline.errors import ConfigError
from pipeline.runs import NEVER_RUN, RunFolder
from pipeline.stages import Stage, stage_named
from pipeline.stages.calibrated import refuse_read_only
from pipeline.stages.job import Job, open_log
from pipeline.stages.runner import Watch, run_stale

CALIBRATE = Stage("calibrate", 1, "working out what the markers tell", (), (), (), lambda job: {})
"""For those who watch: half a minute in which nothing else is said."""


@dataclass(frozen=True, eq=False)
class CalibrationLog:
    """A log after its pictures have been searched."""

    job: Job
    machine: Machine
    """Every camera with its intrinsics."""
    site: Site
    machine_file: Path
    """Into which what is told goes."""
    detections: dict[str, dict[str, np.ndarray]]
    """By camera: columns of the table `detections`."""
    date: date
    """Day of the recording."""

    @property
    def folder(self) -> Path:
        return self.job.folder.path

    @property
    def origin(self) -> dict[str, str]:
        """What a sheet says of where it comes from: names, hashes and the day of the recording."""
        job = self.job
        return {
            "log": f"{job.log.name}, sha256 {job.log_sha256[:12]}",
            "recorded": self.date.isoformat(),
            **{s.name: f"sha256 {s.sha256[:12]}" for s in (job.machine_source, job.site_source)},
        }


def machine_to_write(job: Job, given: Path | None) -> Path:
    """The machine.toml that values go into.

    Raises
    ------
    ConfigError
        There is only the one inside the log.
    ArtefactError
        It is read-only, or its folder is.
    """
    if job.machine_source.origin == "attachment":
        raise ConfigError(
            f"{job.log} has only the machine.toml inside it, and nothing can be written there; put one beside the log, "
            "or name it with --machine"
        )
    file = given or job.log.parent / "machine.toml"
    refuse_read_only(file)
    return file


@contextmanager
def searched(
    log: Path, machine: Path | None, site: Path | None, runs: Path, workers: int, watch: Watch
) -> Iterator[CalibrationLog]:
    """Read a log and find its markers, unless that is done; the run folder stays locked while it is used.

    Raises
    ------
    PipelineError
        The log, a description or the folder is at fault.
    """
    job = open_log(log, machine, site, RunFolder(runs / log.stem), workers, create_folder=True)
    machine_file = machine_to_write(job, machine)
    with job.folder.locked():
        run_stale(job, watch, last="detect")
        reader = job.at(stage_named("estimate"), "")
        found = CalibrationLog(
            job=job,
            machine=job.calibrated_machine(),
            site=job.site,
            machine_file=machine_file,
            detections={
                name: reader.read_table("detections", part=name) for name in reader.parts("detections")
            },
            date=datetime.fromtimestamp(job.read_json("log.json")["start_ns"] / 1e9, UTC).date(),
        )
        with watch.stage(CALIBRATE, NEVER_RUN):
            yield found
