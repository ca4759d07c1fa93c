"""estimate: everything that was seen and read, adjusted at once; `states`, `statics`, `residuals`,
`sensitivities`, solution.json.
"""

from __future__ import annotations

import datetime
import logging
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import Machine
from pipeline.estimation import adjust
from pipeline.estimation.repeated import Repeated
from pipeline.estimation.table import (
    columns_of_residuals,
    columns_of_sensitivities,
    columns_of_states,
    columns_of_statics,
    observations_of,
    readings_of,
)
from pipeline.logs.clock import EARLIEST_NS
from pipeline.network import network_of
from pipeline.network.model import Readings
from pipeline.runs import atomic_file
from pipeline.stages.job import Counts, Job, Progress

PORTION_EPOCHS = 8192
"""Of the table of sensitivities, which has some twenty rows an epoch."""
WORTH_S = 1.0
"""An iteration that took less than this is not kept."""

logger = logging.getLogger(__name__)


def run(job: Job, progress: Progress) -> Counts:
    """Write the adjusted states, statics and residuals. Raises NetworkError, EstimationError, ConfigError."""
    started = time.monotonic()
    network = network_of(job.calibrated_machine(), job.site, _day_of(job.read_json("log.json")["start_ns"]))
    cameras = [name for name in job.parts("detections") if name in {c.name for c in network.cameras}]
    observations = observations_of(
        network, {name: job.read_table("detections", part=name) for name in cameras}
    )
    readings = readings_of(job.read_table("sensors"))
    logger.info("adjusting %d tags and %d sensors", len(observations.camera), len(readings))
    progress.total(1)
    checkpoint = Scratch(job.scratch, job.fingerprint)
    solution = adjust(network, observations, readings, job.site.estimation, Repeated(), True, checkpoint)
    with job.table_writer("states") as writer:
        for states in solution.states:
            writer.write(columns_of_states(states))
    job.write_table("statics", columns_of_statics(solution.statics))
    job.write_table("residuals", columns_of_residuals(network, solution.residuals))
    answer = solution.sensitivities
    with job.table_writer("sensitivities") as writer:
        for portion in () if answer is None else answer.portions(PORTION_EPOCHS):
            writer.write(columns_of_sensitivities(portion))
    beyond = beyond_stroke(job.machine, readings)
    job.write_json("solution.json", {**solution.diagnostics, "beyond_stroke": beyond})
    progress.advance(1)
    for sentence in solution.warnings:
        progress.warn(sentence)
    figures = solution.diagnostics
    logger.info(
        "adjusted %d epochs in %d iterations, %.1f s, sigma0 %s",
        figures["epochs"],
        figures["iterations"],
        time.monotonic() - started,
        figures["sigma0"],
    )
    return {
        "epochs": figures["epochs"],
        "tags": len(observations.camera),
        "corners weighed down": int(
            ((solution.residuals.weight > 0) & (solution.residuals.weight < 1)).sum()
        ),
        "corners rejected": int((solution.residuals.weight == 0).sum()),
        "readings": {name: len(r.raw) for name, r in readings.items()},
        **(
            {"readings beyond the calibrated stroke": {n: f["beyond"] for n, f in beyond.items()}}
            if beyond
            else {}
        ),
        "left out": figures["dropped"],
        "iterations": figures["iterations"],
        "sigma0": figures["sigma0"],
    }


def beyond_stroke(machine: Machine, readings: Mapping[str, Readings]) -> dict[str, dict[str, Any]]:
    """Sensors that read where their curve was never calibrated: how many of the readings, and how far they went.

    Parameters
    ----------
    machine : Machine
        A curve without a calibrated stroke says nothing.
    readings : mapping
        As recorded, those that the adjustment drops as well.
    """
    found = {}
    for name, sensor in machine.sensors.items():
        calibrated = sensor.curve.calibrated
        if calibrated is None or calibrated.raw_range is None or name not in readings:
            continue
        low, high = calibrated.raw_range
        raw = readings[name].raw
        raw = raw[np.isfinite(raw)]
        beyond = int(np.count_nonzero((raw < low) | (raw > high)))
        if beyond:
            found[name] = {
                "readings": len(raw),
                "beyond": beyond,
                "stroke": [low, high],
                "least": float(raw.min()),
                "most": float(raw.max()),
                "calibrated": calibrated.date.isoformat(),
            }
    return found


class Scratch:
    """A ``Checkpoint`` in files of the stage's scratch folder, each written whole or not at all."""

    def __init__(self, folder: Path, fingerprint: str, worth_s: float = WORTH_S):
        self._folder, self._fingerprint, self._worth_s = folder, fingerprint, worth_s
        self._last = time.monotonic()

    def _file(self, name: str) -> Path:
        return self._folder / f"{name.replace(' ', '-')}.npz"

    def recall(self, name: str) -> dict[str, np.ndarray] | None:
        """What a run that was killed kept; None where the file is of other inputs, or not to be read."""
        try:
            with np.load(self._file(name), allow_pickle=False) as file:
                found = dict(file)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None
        return found if found.pop("fingerprint", np.array("")).item() == self._fingerprint else None

    def keep(self, name: str, arrays: dict[str, np.ndarray]) -> None:
        """Declines what took less than a second or so: to write it would take longer than to do it again."""
        if time.monotonic() - self._last < self._worth_s:
            return
        with atomic_file(self._file(name)) as stream:
            np.savez(stream, fingerprint=np.array(self._fingerprint), allow_pickle=False, **arrays)
        self._last = time.monotonic()

    def forget(self, name: str) -> None:
        self._file(name).unlink(missing_ok=True)


def _day_of(start_ns: int) -> datetime.date | None:
    """Day of the log, by which tooth wear is chosen; None, the latest wear, where the clock was never set."""
    if start_ns < EARLIEST_NS:
        return None
    return datetime.datetime.fromtimestamp(start_ns / 1e9, datetime.UTC).date()
