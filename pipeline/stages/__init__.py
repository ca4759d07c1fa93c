"""The stages, in order: the only code that reads and writes artefacts.

Each stage is one module ``pipeline/stages/<name>.py`` with one function::

    from pipeline.stages.job import Counts, Job, Progress


    def run(job: Job, progress: Progress) -> Counts: ...

- It reads what earlier stages wrote through ``job.read_table("frames")``, ``job.parts("detections")`` (camera names),
  ``job.read_table("detections", part="cab")`` and ``job.read_json("log.json")``; only stages in its `needs`.
- It writes through ``job.write_table("states", columns)``, ``job.write_table("detections", columns, part=camera)``,
  ``job.table_writer("states")`` (in portions), ``job.write_json("solution.json", dict)`` and
  ``job.write_bytes("report.html", data)``. The runner hashes these files into the manifest, which it writes last.
  Nothing that differs from run to run (seconds, dates, paths, process ids) may stand in an output: the same input
  gives the same bytes.
- ``job.scratch`` is a folder for finished pieces; it survives a kill and is found again under the same fingerprint.
- ``progress.total(amount, unit)`` once, ``progress.advance(amount)`` as work is done; ``progress.warn(sentence)`` for
  what a person should know though the stage goes on: printed, kept in the manifest, shown on the report.
- It returns its counts: word -> number, or word -> {reason: number}, printed as "860 frames, 41 rejected (border 3,
  ...)" and kept in the manifest. The report stage's counts have "verdict": PASS, FAIL or CANNOT TELL. The report asks
  for those of the others with ``job.counts("detect")`` and ``job.warnings("detect")``.

`log.json`, written by ingest: {"recovery": fields of `logs.reader.Recovery`, "start_ns", "end_ns", "channels": [...],
"clock": {...}, "calibrations": {camera: {"topic", "width", "height", "fx", "fy", "cx", "cy", "distortion": [5]}}}.

`detection.json`, written by detect: {"cameras": {camera: {"frames": {outcome: number}, "tags": {status: number},
"how": {searched or followed: number}, "pixel_noise": {"sizes": [...], "tags": [...]}}}}; each entry of the two lists
has "size", "low_px" and "high_px" (null: no limit) of its size class and the fields of `detection.stillness.Scatter`.

The table below is the one place where their order stands, what each depends on and which settings it uses. A stage is
redone when its version, a schema of its tables, an output of a stage it needs, a file it reads or one of its settings
changed, and for no other reason: raise the version when the same input gives another result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline import __version__

if TYPE_CHECKING:
    from pipeline.stages.job import Job

Settings = dict[str, Any]


def _reading(job: Job) -> Settings:
    return {
        "cameras": {
            name: {
                "topic": camera.topic,
                "calibration": None if camera.intrinsics else (camera.calibration_topic or "any"),
                # Held against the pictures' own.
                "size": [camera.intrinsics.width, camera.intrinsics.height] if camera.intrinsics else None,
            }
            for name, camera in job.machine.cameras.items()
        },
        "sensors": {
            name: {"topic": sensor.topic, "field": sensor.field, "joint": sensor.joint}
            for name, sensor in job.machine.sensors.items()
        },
    }


def _seeing(job: Job) -> Settings:
    markers = [*job.machine.markers.values(), *job.site.benchmarks.values()]
    return {
        "cameras": {
            name: {
                "topic": camera.topic,
                # Edges of a print are straight before the lens bends them. Those of the log come with ingest.
                "intrinsics": camera.intrinsics.vector().tolist() if camera.intrinsics else None,
            }
            for name, camera in job.machine.cameras.items()
        },
        # Where tags stand on their board tells where to look for them; the order of boards tells nothing.
        "boards": sorted(
            [marker.family, *([tag.id, tag.size_m, tag.x_m, tag.y_m] for tag in marker.tags)]
            for marker in markers
        ),
        "detection": job.site.detection.model_dump(mode="json"),
    }


def _adjusting(job: Job) -> Settings:
    return {
        "machine": job.machine.model_dump(mode="json", exclude={"format", "machine"}),
        **job.site.model_dump(mode="json", include={"grid", "benchmarks", "estimation"}),
    }


def _tracking(job: Job) -> Settings:
    return {
        "cutting_edge": job.machine.cutting_edge.model_dump(mode="json"),
        "bodies": job.machine.model_dump(mode="json", include={"bodies"})["bodies"],
        **job.site.model_dump(mode="json", include={"grid"}),
    }


def _surveying(job: Job) -> Settings:
    wanted = {"grid", "alignment", "design", "ground", "tolerance", "checks", "utilities", "survey"}
    return {
        "width_m": job.machine.cutting_edge.width_m,
        "time_zone": job.site.report.time_zone,
        **job.site.model_dump(mode="json", include=wanted),
    }


def _reporting(job: Job) -> Settings:
    # The page quotes both files and says where they came from, so any change in them is a change of the page.
    return {
        "gradetrace": __version__,
        "log": job.log.name,
        "machine": job.machine.model_dump(mode="json"),
        "site": job.site.model_dump(mode="json"),
        "sources": [job.machine_source.facts(), job.site_source.facts()],
    }


@dataclass(frozen=True)
class Stage:
    """One row of the table of stages."""

    name: str
    """Module of the stage and name of its manifest."""
    version: int
    """Raised when the same input gives another result."""
    doing: str
    """What the progress bar says."""
    needs: tuple[str, ...]
    """Stages whose outputs it reads."""
    reads: tuple[str, ...]
    """`log`, and which of the files that site.toml names: `design`, `ground`, `checks`, `utilities` (all of them)."""
    tables: tuple[str, ...]
    """Tables it writes."""
    settings: Callable[[Job], Settings]
    """The part of the two configuration files that it uses, as plain JSON."""


STAGES = (
    Stage("ingest", 1, "reading the log", (), ("log",), ("frames", "sensors"), _reading),
    Stage("detect", 7, "finding markers", ("ingest",), ("log",), ("detections",), _seeing),
    Stage(
        "estimate",
        19,
        "adjusting the network",
        ("ingest", "detect"),
        (),
        ("states", "statics", "residuals", "sensitivities"),
        _adjusting,
    ),
    Stage("track", 1, "poses and cutting edge", ("estimate",), (), ("poses", "cutting_edge"), _tracking),
    Stage(
        "survey",
        5,
        "as-built against design",
        ("estimate", "track"),
        ("design", "ground", "checks", "utilities"),
        ("as_built", "stations", "station_budgets", "sides", "volumes", "checks", "utilities"),
        _surveying,
    ),
    Stage(
        "report",
        5,
        "writing the report",
        ("ingest", "detect", "estimate", "track", "survey"),
        ("log", "design", "checks", "utilities"),
        (),
        _reporting,
    ),
)


def stage_named(name: str) -> Stage:
    return next(stage for stage in STAGES if stage.name == name)
