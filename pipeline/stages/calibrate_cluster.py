"""`gradetrace calibrate cluster`: mounts of a camera cluster from a log, into machine.toml, with a sheet."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.calibration.cluster import (
    Cluster,
    calibrate_cluster,
    default_reference,
)
from pipeline.report.cluster_sheet import cluster_sheet
from pipeline.stages.calibrated import (
    Written,
    demand_of,
    lens_table,
    pose_table,
    provenance,
    put_into,
    refuse_twice,
    written_covariance,
)
from pipeline.stages.calibration_log import CalibrationLog, searched
from pipeline.stages.runner import Watch

COMMAND = "gradetrace calibrate cluster"


def run(
    log: Path,
    machine: Path | None,
    site: Path | None,
    runs: Path,
    workers: int,
    watch: Watch,
    reference: str | None = None,
    free_intrinsics: bool = False,
    distance_m: float = 8.0,
) -> Written:
    """Calibrate the cluster of a log and write what it tells.

    Raises
    ------
    PipelineError
        Nothing is written then.
    """
    with searched(log, machine, site, runs, workers, watch) as found:
        reference = reference or default_reference(found.machine)
        refuse_twice(
            found.machine, found.job.log_sha256, [f"cameras.{n}.mount" for n in found.machine.cameras]
        )
        cluster = calibrate_cluster(found.machine, found.site, reference, found.detections)
        sheet = cluster_sheet(
            cluster,
            demand_of(found.site, distance_m),
            free_intrinsics=free_intrinsics,
            subject=found.machine.machine.id,
            origin=found.origin,
        )
        values = values_of(cluster, found, free_intrinsics)
        page = found.folder / "calibration-cluster.html"
        kept = put_into(found.machine_file, "machine", values, sheet, page)
    return Written(sheet.sentence, tuple(sheet.remarks), page, found.machine_file, kept)


def values_of(cluster: Cluster, found: CalibrationLog, free_intrinsics: bool) -> Mapping[str, Any]:
    """Dotted key -> value for machine.toml."""
    stamp = provenance(found.date, COMMAND, found.job.log, found.job.log_sha256)
    values: dict[str, Any] = {}
    for name, (T, covariance) in cluster.mounts.items():
        if name != cluster.reference:
            values[f"cameras.{name}.mount"] = pose_table(T, covariance, stamp)
        elif cluster.defines_body:
            values[f"cameras.{name}.mount"] = pose_table(T, None, stamp)
    if free_intrinsics:
        for name, (lens, covariance) in cluster.intrinsics.items():
            camera = found.machine.cameras[name]
            assert camera.intrinsics is not None
            size = camera.intrinsics.width, camera.intrinsics.height
            values[f"cameras.{name}.intrinsics"] = lens_table(
                size, lens, written_covariance(covariance), stamp
            )
    return values
