"""Which stages are stale, and running them in order."""

from __future__ import annotations

import importlib
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Protocol

from pipeline import tables
from pipeline.errors import ArtefactError
from pipeline.runs import Manifest, fingerprint, sha256_of
from pipeline.stages import STAGES, Stage, stage_named
from pipeline.stages.job import Job, Progress


class Watch(Protocol):
    """Who watches a run."""

    def stage(self, stage: Stage, why: str) -> AbstractContextManager[Progress]:
        """Entered while a stage runs; `why` it is stale."""

    def done(self, stage: Stage, manifest: Manifest, ran: bool) -> None:
        """Called after a stage ran, or was found up to date."""


@dataclass(frozen=True)
class Plan:
    """What a stage would be run with now."""

    inputs: dict[str, str]
    settings: dict[str, Any]
    schemas: dict[str, int]

    def fingerprint(self, stage: Stage) -> str:
        return fingerprint(stage.version, self.inputs, self.settings, self.schemas)


@dataclass(frozen=True)
class StageState:
    stage: Stage
    why: str | None
    """Why it is stale, None where it is up to date."""
    manifest: Manifest | None


def plan(job: Job, stage: Stage) -> Plan:
    """Inputs, settings and schema versions of a stage, from the manifests of the stages it needs."""
    inputs = {}
    for kind in stage.reads:
        if kind == "log":
            inputs["log"] = job.log_sha256
        else:  # of some kinds there are several: utilities.<name>
            inputs |= {key: file.sha256 for key, file in job.files.items() if key.partition(".")[0] == kind}
    for needed in stage.needs:
        manifest = job.folder.manifest(needed)
        if manifest is not None:
            inputs.update(manifest.outputs)
            # The page shows these as well: they are its input as much as the tables are.
            if stage.name == "report":
                shown = [manifest.fingerprint, manifest.counts, manifest.warnings]
                inputs[f"manifest of {needed}"] = sha256_of(shown)
    read = {name for needed in stage.needs for name in stage_named(needed).tables}
    schemas = {name: tables.read_schema(name).version for name in sorted(read | set(stage.tables))}
    return Plan(inputs, stage.settings(job), schemas)


def states(job: Job) -> list[StageState]:
    """Each stage with the reason why it is stale, without running anything."""
    found: list[StageState] = []
    for stage in STAGES:
        stale_before = [state.stage.name for state in found if state.why and state.stage.name in stage.needs]
        now = plan(job, stage)
        why = job.folder.why_stale(stage.name, stage.version, now.inputs, now.settings, now.schemas)
        if why is None and stale_before:
            why = f"{stale_before[0]} is stale"
        found.append(StageState(stage, why, job.folder.manifest(stage.name)))
    return found


def run_stale(job: Job, watch: Watch, last: str = "") -> list[str]:
    """Run every stale stage, in order, up to the one named `last` if any; the names of those that ran.

    The run folder must be locked by the caller. Raises PipelineError.
    """
    ran = []
    for stage in STAGES:
        if run_if_stale(job, stage, watch):
            ran.append(stage.name)
        if stage.name == last:
            break
    return ran


def run_if_stale(job: Job, stage: Stage, watch: Watch) -> bool:
    """Run one stage unless it is up to date; whether it ran. Raises PipelineError."""
    now = plan(job, stage)
    why = job.folder.why_stale(stage.name, stage.version, now.inputs, now.settings, now.schemas)
    if why is not None:
        run_stage(job, stage, now, watch, why)
    manifest = job.folder.manifest(stage.name)
    if manifest is None:
        raise ArtefactError(f"{job.folder.path}: the manifest of {stage.name} vanished while it was written")
    watch.done(stage, manifest, ran=why is not None)
    return why is not None


def run_stage(job: Job, stage: Stage, now: Plan, watch: Watch, why: str) -> None:
    """Run one stage and write its manifest last."""
    before = job.folder.manifest(stage.name)
    # From here until the new manifest the old outputs are being replaced one by one.
    job.folder.withdraw(stage.name)
    run = importlib.import_module(f"pipeline.stages.{stage.name}").run
    here = job.at(stage, now.fingerprint(stage))
    started = time.monotonic()
    with watch.stage(stage, why) as progress:
        kept = _Warnings(progress)
        counts = run(here, kept)
    outputs = {file: job.folder.hash_file(job.folder.file(file)) for file in sorted(here.written)}
    if before is not None:
        job.folder.remove([file for file in before.outputs if file not in outputs])
    job.folder.write_manifest(
        Manifest(
            stage=stage.name,
            version=stage.version,
            fingerprint=here.fingerprint,
            inputs=now.inputs,
            settings=now.settings,
            schemas=now.schemas,
            outputs=outputs,
            counts=counts,
            warnings=kept.sentences,
            seconds=round(time.monotonic() - started, 3),
            finished_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        )
    )
    job.folder.clear_scratch(stage.name)


class _Warnings:
    """Passes progress on and keeps the warnings."""

    def __init__(self, progress: Progress):
        self._progress = progress
        self.sentences: list[str] = []

    def total(self, amount: float, unit: str = "") -> None:
        self._progress.total(amount, unit)

    def advance(self, amount: float = 1) -> None:
        self._progress.advance(amount)

    def warn(self, sentence: str) -> None:
        if sentence not in self.sentences:
            self.sentences.append(sentence)
            self._progress.warn(sentence)
