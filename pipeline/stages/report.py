"""report: everything that the other stages wrote -> one page that a surveyor signs, and its numbers as files."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.errors import ArtefactError
from pipeline.report import FileSource, ReportInputs, render
from pipeline.report.exports import csv_of
from pipeline.report.hand_off import AS_BUILT_POINTS, DXF, LANDXML
from pipeline.report.moments import worst_moments
from pipeline.stages import STAGES
from pipeline.stages.job import Counts, Job, Progress, Source
from pipeline.stages.pictures import views_of
from pipeline.surface.design import read_design
from pipeline.surface.drawing_exchange import dxf_bytes
from pipeline.surface.landxml_out import landxml_bytes
from pipeline.surface.utilities import read_utilities

COLUMNS: dict[str, list[str] | None] = {
    "frames": ["camera", "time_ns"],
    "residuals": ["camera", "marker", "residual_u", "residual_v", "normalised", "weight"],
    "statics": None,
    "cutting_edge": ["time_ns", "point", "e", "n", "h", "seen"],
    "as_built": None,
    "stations": None,
    "station_budgets": None,
    "sides": None,
    "volumes": None,
    "checks": None,
    "utilities": None,
}
"""Columns that the page needs of each table; a shift has millions of rows of some."""
DETECTION_COLUMNS = ["time_ns", "status"]
LIBRARIES = (
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "pyapriltags",
    "simplejpeg",
    "mcap",
    "pyarrow",
    "matplotlib",
)


def run(job: Job, progress: Progress) -> Counts:
    """Write `report.html`, `report.json`, `stations.csv`, `checks.csv` and the as-built points, LandXML and DXF."""
    progress.total(4, "steps")
    inputs = gather(job)
    progress.advance()
    page = render(inputs)
    progress.advance()
    html = page.html.encode("utf-8")
    job.write_bytes("report.html", html)
    job.write_json("report.json", page.content)
    for name, table in page.exports.items():
        job.write_bytes(f"{name}.csv", csv_of(table, heading=name != AS_BUILT_POINTS))
    progress.advance()
    if page.hand_off is not None:
        job.write_bytes(LANDXML, landxml_bytes(page.hand_off))
        job.write_bytes(DXF, dxf_bytes(page.hand_off))
    progress.advance()
    return {
        "verdict": page.content["verdict"]["word"],
        "figures": sum(not figure["why"] for figure in page.content["figures"].values()),
        "remarks": len(page.content["attention"]["items"]) + len(page.content["attention"]["more"]),
        "kB": round(len(html) / 1000),
    }


def gather(job: Job) -> ReportInputs:
    """The artefacts of a run, and for those that are not there the reason why."""
    missing: dict[str, str] = {}
    tables: dict[str, dict[str, np.ndarray]] = {}
    for name, columns in COLUMNS.items():
        if name == "checks" and job.site.checks is None:
            missing[name] = "site.toml names no check shots"
            continue
        try:
            tables[name] = job.read_table(name, columns)
        except ArtefactError as error:
            missing[name] = str(error)
    facts: dict[str, Any] = {}
    for file in ("log.json", "detection.json", "solution.json", "survey.json"):
        try:
            facts[file] = job.read_json(file)
        except ArtefactError as error:
            facts[file], missing[file] = {}, str(error)
    cameras = set(job.parts("detections"))
    design, alignment = read_design(job.files["design"].path, job.site)
    manifests = {}
    for stage in STAGES:
        if stage.name != "report" and (manifest := job.folder.manifest(stage.name)) is not None:
            manifests[stage.name] = {
                "version": manifest.version,
                "fingerprint": manifest.fingerprint,
                "counts": manifest.counts,
                "warnings": manifest.warnings,
            }
    moments = []
    if (stations := tables.get("stations")) and (cells := tables.get("as_built")):
        floor = design.is_floor(cells["station"], cells["offset"])
        moments = worst_moments(stations, cells, floor, job.site.station_step_m)
    return ReportInputs(
        machine=job.machine,
        site=job.site,
        log=FileSource(job.log.name, "log", job.log_sha256),
        machine_file=_file(job.machine_source),
        site_file=_file(job.site_source),
        named_files={key: FileSource(file.name, "site", file.sha256) for key, file in job.files.items()},
        alignment=alignment,
        design=design,
        utilities=read_utilities(job.site, {key: file.path for key, file in job.files.items()}),
        tables=tables,
        detections={
            camera: job.read_table("detections", DETECTION_COLUMNS, part=camera)
            for camera in job.machine.cameras
            if camera in cameras
        },
        moments=moments,
        views=views_of(job, moments) if moments and "frames" in tables else (),
        log_facts=facts["log.json"],
        detection=facts["detection.json"],
        solution=facts["solution.json"],
        survey=facts["survey.json"],
        manifests=manifests,
        missing=missing,
        versions=_versions(),
    )


def _file(source: Source) -> FileSource:
    return FileSource(source.name, source.origin, source.sha256)


def _versions() -> dict[str, str]:
    found = {"gradetrace": __version__, "python": platform.python_version()}
    for library in LIBRARIES:
        try:
            found[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return found
