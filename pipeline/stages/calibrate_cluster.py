"""`gradetrace calibrate cluster`: mounts of a camera cluster from a log, into machine.toml, with a sheet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration.cluster import (
    Cluster,
    calibrate_cluster,
    default_reference,
)
from pipeline.geometry import so3
from pipeline.report.cluster_sheet import cluster_sheet
from pipeline.stages.calibrated import provenance, put_into, put_sheet
from pipeline.stages.calibration_log import CalibrationLog, searched
from pipeline.stages.runner import Watch

COMMAND = "calibrate cluster"


@dataclass(frozen=True)
class Written:
    """What a calibration left."""

    sentence: str
    """Whether it is good enough, in one line."""
    remarks: tuple[str, ...]
    sheet: Path
    file: Path
    """With the new values."""
    kept: Path
    """The file as it was."""


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
        cluster = calibrate_cluster(found.machine, found.site, reference, found.detections)
        sheet = cluster_sheet(
            cluster,
            tolerance_m=min(found.site.tolerance.high_mm, found.site.tolerance.low_mm) / 1000,
            coverage_factor=found.site.tolerance.coverage_factor,
            distance_m=distance_m,
            free_intrinsics=free_intrinsics,
            subject=found.machine.machine.id,
            origin=origin_of(found),
        )
        values = values_of(cluster, found, free_intrinsics)
        page = found.folder / "calibration-cluster.html"
        put_sheet(sheet, page)
        kept = put_into(found.machine_file, "machine", values)
    return Written(sheet.sentence, tuple(sheet.remarks), page, found.machine_file, kept)


def origin_of(found: CalibrationLog) -> dict[str, str]:
    """What a sheet says of its origin: names, hashes and the day of the recording."""
    job = found.job
    return {
        "log": f"{job.log.name}, sha256 {job.log_sha256[:12]}",
        "recorded": found.date.isoformat(),
        **{s.name: f"sha256 {s.sha256[:12]}" for s in (job.machine_source, job.site_source)},
    }


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
            values[f"cameras.{name}.intrinsics"] = {
                "width": camera.intrinsics.width,
                "height": camera.intrinsics.height,
                **dict(zip(("fx", "fy", "cx", "cy"), lens[:4].tolist(), strict=True)),
                "distortion": lens[4:],
                "covariance": written_covariance(covariance),
                "calibrated": stamp,
            }
    return values


def pose_table(T: np.ndarray, covariance: np.ndarray | None, stamp: Mapping[str, Any]) -> dict[str, Any]:
    """A pose as machine.toml has it; without covariance it is exact: it says where its parent begins."""
    table: dict[str, Any] = {"xyz_m": T[:3, 3], "rpy_deg": so3.to_rpy_deg(T[:3, :3])}
    if covariance is None:
        table |= {"sigma_mm": 0.0, "sigma_deg": 0.0}
    else:
        table["covariance"] = written_covariance(covariance)
    return {**table, "calibrated": dict(stamp)}


def written_covariance(covariance: np.ndarray) -> np.ndarray:
    """A covariance as it goes into a file: symmetric, without what is only rounding."""
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    even = 0.5 * (covariance + covariance.T)
    return np.where(np.abs(even) > 1e-9 * np.outer(sigma, sigma), even, 0.0)
