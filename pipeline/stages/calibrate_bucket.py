"""``gradetrace calibrate bucket``: touches of a known point -> curve, cutting edge, wear in machine.toml; a sheet."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.calibration.agreement import agreed, kept_of
from pipeline.calibration.belt import belt_on
from pipeline.calibration.standings import RULE, Touched, machine_to_the_pin, standings, touched
from pipeline.calibration.touches import TOOL
from pipeline.config import Machine, Site
from pipeline.errors import CalibrationError
from pipeline.estimation.table import sensitivities_from_columns
from pipeline.report.bucket_sheet import BucketFacts, bucket_sheet
from pipeline.report.sheet import SHARE
from pipeline.runs import RunFolder
from pipeline.stages import calibrate_belt, stage_named
from pipeline.stages.bucket_files import points_of, rig_of, values_of, wear_values, worn_m
from pipeline.stages.calibrated import Written, put_into, refuse_twice
from pipeline.stages.calibration_log import machine_to_write
from pipeline.stages.job import Job, check_log_file, describe, open_log
from pipeline.stages.runner import Watch, run_if_stale
from pipeline.surface.rests import rests_of
from pipeline.tracks.table import cutting_edge_from_columns, states_from_columns

STAGES = ("ingest", "detect", "estimate", "track")


@dataclass(frozen=True)
class Wanted:
    """What the command was asked for."""

    log: Path
    checks: Path | None = None
    machine: Path | None = None
    site: Path | None = None
    runs: Path = Path("runs")
    point: str | None = None
    """Id, or E,N,H in the grid unit."""
    tooth: str = "middle"
    """left, middle, right or any."""
    sensor: str | None = None
    contact_mm: float = 1.0
    wear: bool = False
    workers: int = 1


def calibrate_bucket(wanted: Wanted, watch: Watch) -> Written:
    """Calibrate, write machine.toml and the sheet; nothing is written where anything is wrong.

    Raises
    ------
    CalibrationError
        Too few touches, a touch that contradicts the others, a curve that turns back.
    PipelineError
        The log, a description or a stage is at fault.
    """
    check_log_file(wanted.log)
    machine = describe(wanted.log, wanted.machine, wanted.site)[0]
    if (belt := belt_to_calibrate(machine, wanted)) is not None:
        return calibrate_belt.run(
            wanted.log,
            wanted.checks,
            wanted.machine,
            wanted.site,
            wanted.runs,
            wanted.workers,
            watch,
            belt,
            wanted.point,
            wanted.tooth,
            wanted.contact_mm / 1000,
        )
    # Of its own: in runs/<log> the tables are those of the whole machine.
    folder = RunFolder(wanted.runs / f"{wanted.log.stem}-bucket")
    job = open_log(wanted.log, wanted.machine, wanted.site, folder, wanted.workers, create_folder=True)
    machine, site = job.machine, job.site
    machine_file = machine_to_write(job, wanted.machine)
    name = sensor_of(machine, wanted.sensor)
    refuse_twice(machine, job.log_sha256, () if wanted.wear else (f"sensors.{name}.curve",))
    reduced, joint = machine_to_the_pin(machine)
    to_the_pin = replace(job, machine=reduced)
    with folder.locked():
        for stage in STAGES:
            run_if_stale(job if stage == "ingest" else to_the_pin, stage_named(stage), watch)
        found = _touched(job, wanted, machine, site, name)
        reader = job.at(stage_named("report"), "")
        start_ns = int(reader.read_json("log.json")["start_ns"])
        date = datetime.datetime.fromtimestamp(start_ns / 1e9, datetime.UTC).date()
        rig = rig_of(job.calibrated_machine(), site, name, date, wanted.wear)
        points = dict(zip(found.point_names, found.points))
        adjusted = agreed(rig, found.stands, found.touches, points, found.left_out)
        kept = None if wanted.wear else kept_of(adjusted, name)
        facts = BucketFacts(
            machine=f"{machine.machine.id}",
            sensor=name,
            adjusted=adjusted,
            kept=kept,
            touch_names=tuple(t.name for t in adjusted.touches),
            point_names=tuple(found.point_names),
            left_out=found.left_out,
            wear_m=None if kept else float(worn_m(machine, date) - adjusted.value[TOOL][2]),
            tolerance_m=min(site.tolerance.high_mm, site.tolerance.low_mm) / 1000 * SHARE,
            date=date,
            log=wanted.log.name,
            log_sha256=job.log_sha256,
            checks=None if wanted.checks is None else wanted.checks.name,
            machine_sha256=job.machine_source.sha256,
        )
        values = wear_values(machine, facts) if kept is None else values_of(machine, joint, name, kept, facts)
        sheet, page = bucket_sheet(facts), folder.file("bucket.html")
        before = put_into(machine_file, "machine", values, sheet, page)
    return Written(sheet.sentence, tuple(sheet.remarks), page, machine_file, before)


def belt_to_calibrate(machine: Machine, wanted: Wanted) -> str | None:
    """The belt that shows the bucket's angle where no sensor reads it. Raises CalibrationError with `--wear`."""
    joint = machine.cutting_edge.body
    read = any(sensor.joint == joint for sensor in machine.sensors.values())
    belt = None if read or wanted.sensor is not None else belt_on(machine, joint)
    if belt is not None and wanted.wear:
        raise CalibrationError(
            f"'{belt}' shows the bucket's angle by a belt, and --wear holds a sensor's curve; leave it out: the edge "
            "is told along with the belt"
        )
    return belt


def sensor_of(machine: Machine, asked: str | None) -> str:
    """The bucket's sensor. Raises CalibrationError where there is none, or several and none was named."""
    joint = machine.cutting_edge.body
    names = [name for name, sensor in machine.sensors.items() if sensor.joint == joint]
    if asked is not None:
        if asked not in names:
            raise CalibrationError(
                f"--sensor {asked}: no sensor of that name reads the joint '{joint}'; there is "
                f"{', '.join(names) or 'none'}"
            )
        return asked
    if not names:
        raise CalibrationError(
            f"machine.toml has no sensor that reads the bucket's joint '{joint}'; add [sensors.<name>]"
        )
    if len(names) > 1:
        raise CalibrationError(
            f"{len(names)} sensors read the joint '{joint}': name one with --sensor ({', '.join(names)})"
        )
    return names[0]


def _touched(job: Job, wanted: Wanted, machine: Machine, site: Site, name: str) -> Touched:
    reader = job.at(stage_named("report"), "")
    states = states_from_columns(reader.read_table("states"))
    edge = cutting_edge_from_columns(reader.read_table("cutting_edge"))
    rests = rests_of(edge, RULE)
    lasting = reader.read_json("solution.json").get("correlation_time_s") or {}
    answer = sensitivities_from_columns(reader.read_table("sensitivities"))
    sensors = reader.read_table("sensors")
    rows = sensors["sensor"].astype(str) == name
    sensor = machine.sensors[name]
    stamps = sensors["time_ns"][rows] + round(sensor.time_offset_s * 1e9)
    if not np.any(rows):
        raise CalibrationError(
            f"{wanted.log.name} has no reading of sensor '{name}' on {sensor.topic}; record it with the touches"
        )
    stands = standings(
        states,
        rests,
        edge.time_ns,
        answer,
        lasting.get("parked", lasting.get("median")),
        stamps,
        sensors["raw"][rows],
        sensor.noise,
    )
    checks = site.checks
    shots, known = points_of(wanted.checks, wanted.point, site)
    mount = np.array(machine.cutting_edge.mount.xyz_m)
    return touched(
        stands,
        shots,
        known,
        site.grid.to_grid_metres(np.zeros(3)),
        float(np.hypot(mount[0], mount[1])),
        machine.cutting_edge.width_m,
        0.15 if checks is None else checks.control_radius_m,
        5.0 if checks is None else checks.time_tolerance_s,
        (2.0 if checks is None else checks.sigma_mm) / 1000,
        wanted.contact_mm / 1000,
        "" if wanted.tooth == "any" else wanted.tooth,
    )
