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
from pipeline.runs import RunFolder
from pipeline.stages import stage_named
from pipeline.stages.job import Job, check_log_file, describe
from pipeline.stages.runner import Watch, plan, run_stage

STAGES = ("ingest", "detect")


@dataclass(frozen=True, eq=False)
class CalibrationLog:
    """A log after its pictures have been searched."""

    job: Job
    machine: Machine
    """Every camera with its intrinsics."""
    site: Site
    machine_file: Path
    """Into which what is told goes."""
    site_file: Path | None
    """None where the site came as an attachment."""
    detections: dict[str, dict[str, np.ndarray]]
    """By camera: columns of the table `detections`."""
    sensors: dict[str, np.ndarray]
    """Columns of the table `sensors`."""
    date: date
    """Day of the recording."""

    @property
    def folder(self) -> Path:
        return self.job.folder.path


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
    check_log_file(log)
    model, machine_source, site_model, site_source = describe(log, machine, site)
    if machine_source.origin == "attachment":
        raise ConfigError(
            f"{log} has only the machine.toml inside it, and nothing can be written there; put one beside the log, or "
            "name it with --machine"
        )
    folder = RunFolder(runs / log.stem)
    folder.create()
    job = Job(
        log=log,
        log_sha256=folder.hash_file(log),
        folder=folder,
        machine=model,
        site=site_model,
        machine_source=machine_source,
        site_source=site_source,
        files={},
        workers=workers,
    )
    with folder.locked():
        for name in STAGES:
            stage = stage_named(name)
            now = plan(job, stage)
            why = folder.why_stale(stage.name, stage.version, now.inputs, now.settings, now.schemas)
            if why is not None:
                run_stage(job, stage, now, watch, why)
            manifest = folder.manifest(stage.name)
            assert manifest is not None
            watch.done(stage, manifest, ran=why is not None)
        reader = job.at(stage_named("estimate"), "")
        yield CalibrationLog(
            job=job,
            machine=job.calibrated_machine(),
            site=site_model,
            machine_file=machine or log.parent / "machine.toml",
            site_file=None if site_source.origin == "attachment" else (site or log.parent / "site.toml"),
            detections={
                name: reader.read_table("detections", part=name) for name in reader.parts("detections")
            },
            sensors=reader.read_table("sensors"),
            date=datetime.fromtimestamp(job.read_json("log.json")["start_ns"] / 1e9, UTC).date(),
        )
