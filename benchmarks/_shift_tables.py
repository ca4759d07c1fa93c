"""A run folder as an 8 h shift leaves it before the report: tables of full length, filled by drawing.

No log of that length is made: frames stand in the log only where the page looks for them, as pictures of noise, which
are the largest there are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import simplejpeg

from pipeline import tables
from pipeline.logs.writer import LogWriter
from pipeline.report.moments import Moment, worst_moments
from pipeline.runs import Manifest, RunFolder
from pipeline.stages import stage_named
from pipeline.stages.job import Job, open_job

SAMPLE = Path("sample_logs/trench")
SECOND = 1_000_000_000
START_NS = 1_750_000_000 * SECOND
WIDTH_M, CELL_M, STEP_M = 1.2, 0.05, 0.5
SIZE = (1280, 960)
SITE = """[alignment]
points = [[356131.0, 5812424.0], [{end}, 5812424.0]]
start_station = 0.0
[design]
file = "design.csv"
kind = "profile_csv"
[tolerance]
high_mm = 30.0
low_mm = 30.0
[checks]
file = "checks.csv"
order = "PNEZD"
"""
TAGS = {"bench": (10, 11, 12, 13), "arm": (1, 2)}
"""Camera -> tags that it sees in every frame."""


def job_of_a_shift(folder: Path, hours: float, rate_hz: float, length_m: float) -> Job:
    """A job whose every artefact before the report is there."""
    _describe(folder, length_m)
    frames = _frames(hours, rate_hz)
    times = frames["time_ns"][frames["camera"] == "bench"]
    stations, cells = _ground(length_m, times)
    floor = np.ones(len(cells["station"]), bool)
    _log(folder / "shift.mcap", frames, worst_moments(stations, cells, floor, STEP_M))
    job = open_job(folder / "shift.mcap", runs=folder / "runs", create_folder=True)
    rng = np.random.default_rng(1)
    _write(job, "frames", frames)
    found = {camera: _detections(rng, frames, camera) for camera in TAGS}
    for camera, columns in found.items():
        _write(job, "detections", columns, camera)
    _residuals(job, rng, found)
    _write(job, "cutting_edge", _edge(rng, times))
    _write(job, "as_built", cells)
    _write(job, "stations", stations)
    _write(job, "checks", _checks(rng, stations))
    for name, columns in _sides_and_volumes(stations).items():
        _write(job, name, columns)
    _write(job, "utilities", tables.empty_columns("utilities"))
    _write(job, "statics", _statics(rng))
    _facts(job, frames)
    return job.at(stage_named("report"), "f" * 64)


def _describe(folder: Path, length_m: float) -> None:
    """The sample's machine and benchmarks on a trench as long as wanted, to the east."""
    (folder / "machine.toml").write_text((SAMPLE / "machine.toml").read_text())
    site = (SAMPLE / "site.toml").read_text()
    site = site[: site.index("[alignment]")] + SITE.format(end=356131.0 + length_m)
    (folder / "site.toml").write_text(site)
    end = f"{length_m},{34.8 - 0.005 * length_m},{WIDTH_M},0"
    (folder / "design.csv").write_text(f"station,elevation,width,side_slope\n0,34.8,{WIDTH_M},0\n{end}\n")
    (folder / "checks.csv").write_text("1,5812424,356140,34.8,FL\n")


def _frames(hours: float, rate_hz: float) -> dict[str, np.ndarray]:
    n = round(hours * 3600 * rate_hz)
    number = np.arange(n)
    parts = []
    for delay in range(len(TAGS)):
        time_ns = START_NS + number * round(SECOND / rate_hz) + delay * 20_000_000
        parts.append(
            {"frame": number.astype(np.int32), "time_ns": time_ns, "log_time_ns": time_ns + 5_000_000}
        )
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return {
        "camera": np.repeat(np.array(list(TAGS), object), n),
        "bytes": np.full(2 * n, 200_000, np.int32),
        "encoding": np.full(2 * n, "jpeg", object),
        **columns,
    }


def _ground(length_m: float, times: np.ndarray) -> tuple[dict, dict]:
    """Stations and cells; every verdict occurs."""
    rng = np.random.default_rng(2)
    s = np.arange(CELL_M / 2, length_m, CELL_M)
    o = np.arange(-WIDTH_M / 2 + CELL_M / 2, WIDTH_M / 2, CELL_M)
    along, across = (a.ravel() for a in np.meshgrid(s, o, indexing="ij"))
    wave = 0.012 * np.sin(along / 3.0) + 0.006 * np.sin(along / 0.7) + rng.normal(0, 0.004, len(along))
    dug = along < 0.9 * length_m
    deviation = np.where(dug, wave + 0.03 * (np.abs(along - 0.4 * length_m) < 1.0), np.nan)
    when = times[np.minimum((along / length_m * len(times)).astype(int), len(times) - 1)]
    design = 34.8 - 0.005 * along
    cells = {
        "station": along,
        "offset": across,
        "state": np.where(dug, "cut", "never touched").astype(object),
        "h": design + deviation,
        "h_lowest": design + deviation - 0.002,
        "design_h": design,
        "deviation": deviation,
        "sigma_own": np.where(dug, 0.003, np.nan),
        "sigma_common": np.where(dug, 0.0035, np.nan),
        "passes": np.where(dug, 6, 0).astype(np.int32),
        "lowest_time_ns": np.where(dug, when, tables.NULL_INT),
    }
    centre = np.arange(STEP_M / 2, length_m, STEP_M)
    of_cell = np.minimum((along / STEP_M).astype(int), len(centre) - 1)
    each = np.bincount(of_cell)
    mean = np.bincount(of_cell, deviation) / each
    verdict = np.where(
        np.abs(mean) + 0.01 < 0.03, "PASS", np.where(np.abs(mean) - 0.01 > 0.03, "FAIL", "CANNOT TELL")
    )
    verdict = np.where(np.isfinite(mean), verdict, "NOT REACHED").astype(object)
    reason = np.full(len(centre), "the upper limit of the tolerance lies within deviation ± U", object)
    known = np.isfinite(mean)
    stations = {
        "station": centre,
        "state": np.where(known, "cut", "not reached").astype(object),
        "h": 34.8 - 0.005 * centre + mean,
        "design_h": 34.8 - 0.005 * centre,
        "deviation": mean,
        "sigma_own": np.where(known, rng.uniform(0.002, 0.004, len(centre)), np.nan),
        "sigma_common": np.where(known, 0.0035, np.nan),
        "expanded_uncertainty": np.where(known, 0.01, np.nan),
        "scatter": np.where(known, 0.003, np.nan),
        "width": np.where(known, WIDTH_M, np.nan),
        "cells_cut": np.where(known, each, 0).astype(np.int32),
        "cells_floor": each.astype(np.int32),
        "verdict": verdict,
        "reason": reason,
    }
    return stations, cells


def _log(path: Path, frames: dict[str, np.ndarray], moments: list[Moment]) -> None:
    """The frames within a second of each moment, and no others."""
    noise = np.random.default_rng(3).integers(0, 256, (SIZE[1], SIZE[0], 1), dtype=np.uint8)
    picture = simplejpeg.encode_jpeg(noise, 90, "GRAY", "Gray")
    time_ns = frames["time_ns"]
    near = np.flatnonzero(np.any([np.abs(time_ns - moment.time_ns) < SECOND for moment in moments], axis=0))
    with LogWriter(path, chunk_size=4 << 20) as log:
        for row in near[np.argsort(frames["log_time_ns"][near], kind="stable")]:
            camera, received = str(frames["camera"][row]), int(frames["log_time_ns"][row])
            log.image(f"/cab/{camera}/image", int(time_ns[row]), camera, picture, log_time_ns=received)


def _detections(
    rng: np.random.Generator, frames: dict[str, np.ndarray], camera: str
) -> dict[str, np.ndarray]:
    time_ns = frames["time_ns"][frames["camera"] == camera]
    tags = TAGS[camera]
    n = len(time_ns) * len(tags)
    found = {name: np.zeros(n, values.dtype) for name, values in tables.empty_columns("detections").items()}
    place = np.stack([[100 + 300 * i, 200] for i in range(len(tags))])
    corner = np.array([[0, 0], [60, 0], [60, 60], [0, 60]])
    for k in range(4):
        for axis, name in enumerate("uv"):
            at = np.tile(place[:, axis] + corner[k, axis], len(time_ns))
            found[f"{name}{k}"] = at + rng.normal(0, 0.02, n)
    found["time_ns"] = np.repeat(time_ns, len(tags))
    found["frame"] = np.repeat(np.arange(len(time_ns), dtype=np.int32), len(tags))
    found["tag_id"] = np.tile(np.array(tags, np.int32), len(time_ns))
    found["family"], found["how"] = np.full(n, "tag36h11", object), np.full(n, "followed", object)
    reasons = np.array(["covered", "does not fit", "blurred", "accepted"], object)
    found["status"] = reasons[np.searchsorted([0.01, 0.02, 0.05], rng.random(n))]
    return found


def _residuals(job: Job, rng: np.random.Generator, found: dict[str, dict[str, np.ndarray]]) -> None:
    owner = {10: "bm-near", 11: "bm-near", 12: "bm-near", 13: "bm-near", 1: "stick-board", 2: "stick-board"}
    with job.table_writer("residuals") as writer:
        for camera, detections in found.items():
            good = np.flatnonzero(detections["status"] == "accepted")
            for part in np.array_split(good, max(1, len(good) // 200_000)):
                rows = np.repeat(part, 4)
                n = len(rows)
                tag_id = detections["tag_id"][rows]
                length = rng.rayleigh(1.0, n)
                writer.write(
                    {
                        "camera": np.full(n, camera, object),
                        "time_ns": detections["time_ns"][rows],
                        "marker": np.array([owner[int(tag)] for tag in tag_id], object),
                        "tag_id": tag_id,
                        "corner": np.tile(np.arange(4, dtype=np.int32), len(part)),
                        "residual_u": rng.normal(0, 0.02, n),
                        "residual_v": rng.normal(0, 0.02, n),
                        "sigma_px": np.full(n, 0.02),
                        "normalised": length,
                        "weight": np.minimum(1.0, 2.5 / length),
                    }
                )


def _edge(rng: np.random.Generator, times: np.ndarray) -> dict[str, np.ndarray]:
    """Cycles of 20 s, a wait of a minute in every ten, and a gap of some seconds in every five."""
    n = len(times)
    columns = {
        name: np.zeros(3 * n, values.dtype) for name, values in tables.empty_columns("cutting_edge").items()
    }
    t = (times - times[0]) / SECOND
    phase = np.where(t % 600 < 540, 2 * np.pi * t / 20, 0.0)
    middle = np.stack([3 * np.sin(phase), np.cos(phase), np.cos(phase)], axis=1) + [356140.0, 5812424.0, 35.0]
    for i, side in enumerate((-0.6, 0.0, 0.6)):
        for k, axis in enumerate("enh"):
            columns[axis][i::3] = middle[:, k] + (side if axis == "e" else 0) + rng.normal(0, 0.003, n)
    columns["time_ns"] = np.repeat(times, 3)
    columns["point"] = np.tile(np.array(["left", "middle", "right"], object), n)
    columns["seen"] = np.repeat(t % 300 > 7, 3)
    return columns


def _checks(rng: np.random.Generator, stations: dict[str, np.ndarray], n: int = 120) -> dict[str, np.ndarray]:
    found = {name: np.zeros(n, values.dtype) for name, values in tables.empty_columns("checks").items()}
    station = np.linspace(stations["station"][0], 0.9 * stations["station"][-1], n)
    difference = rng.normal(0.001, 0.005, n)
    found |= {
        "point": np.array([f"{i:03d}" for i in range(n)], object),
        "code": np.full(n, "FL", object),
        "e": 356131.0 + station,
        "n": np.full(n, 5812424.0),
        "h": 34.8 - 0.005 * station,
        "station": station,
        "as_built_h": 34.8 - 0.005 * station + difference,
        "difference": difference,
        "kind": np.full(n, "floor", object),
        "edge_point": np.full(n, "", object),
        "sigma_own": np.full(n, 0.003),
        "sigma_common": np.full(n, 0.004),
        **{name: np.full(n, np.nan) for name in ("difference_e", "difference_n", "sigma_e", "sigma_n")},
        "sigma": np.full(n, 0.005),
        "sigma_ts": np.full(n, 0.002),
        "z": difference / np.hypot(0.005, 0.002),
        "result": np.full(n, "compared", object),
    }
    return found


BUDGET = (
    "benchmarks",
    "mounts",
    "intrinsics",
    "linkage and sensor",
    "cutting edge",
    "time offset",
    "corners",
)


def _sides_and_volumes(stations: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Two sides, three volumes and the sources of every station's common error."""
    found = {}
    for name, kind, words in (
        ("sides", "side", ("left", "right")),
        ("volumes", "kind", ("cut", "left to cut", "over-dug")),
        ("station_budgets", "source", BUDGET),
    ):
        n = len(words) * len(stations["station"])
        columns = {key: np.full(n, 0.01).astype(v.dtype) for key, v in tables.empty_columns(name).items()}
        columns["station"] = np.repeat(stations["station"], len(words))
        columns[kind] = np.tile(np.array(words, object), len(stations["station"]))
        if name == "sides":
            columns |= {"verdict": np.full(n, "PASS", object), "reason": np.full(n, "", object)}
        found[name] = columns
    return found


def _statics(rng: np.random.Generator, n: int = 200) -> dict[str, np.ndarray]:
    found = {name: np.zeros(n, values.dtype) for name, values in tables.empty_columns("statics").items()}
    found["quantity"] = np.array([f"camera bench corner {i}" for i in range(n)], object)
    found["source"], found["component"] = np.full(n, "corners", object), np.full(n, "u", object)
    found["unit"], found["shift_sigmas"] = np.full(n, "px", object), rng.normal(0, 1, n)
    return found


def _write(job: Job, name: str, columns: dict[str, np.ndarray], part: str | None = None) -> None:
    tables.write_table(
        job.folder.file(f"{name}/{part}.parquet" if part else f"{name}.parquet"), name, columns
    )


def _facts(job: Job, frames: dict[str, np.ndarray]) -> None:
    """The JSON files and manifests of the stages before."""
    noise = {"sizes": [], "tags": []}
    start, end = int(frames["time_ns"].min()), int(frames["time_ns"].max())
    budget = {"own": 0.0049, "benchmarks": 0.0019, "mounts": 0.0021, "intrinsics": 0.0014, "corners": 0.0005}
    written = job.at(stage_named("report"), "f" * 64)
    written.write_json(
        "log.json",
        {
            "start_ns": start,
            "end_ns": end,
            "recovery": {"complete": True},
            "cameras": {camera: {"topic": f"/cab/{camera}/image"} for camera in TAGS},
        },
    )
    written.write_json("detection.json", {"cameras": {camera: {"pixel_noise": noise} for camera in TAGS}})
    written.write_json(
        "solution.json",
        {
            "iterations": 6,
            "error_budget": budget,
            "error_budget_by_class": {"digging": {"epochs": 200_000, "sigma": 0.006, **budget}},
            "correlation_time_s": {"digging": 0.06},
        },
    )
    statistics = {"n": 120, "bias": 0.001, "rmse": 0.0051, "worst": 0.012, "reduced_chi_square": 0.9}
    written.write_json("survey.json", {"verdict": "FAIL", "reason": "drawn", "checks": statistics})
    folder: RunFolder = job.folder
    outputs = {f"detections/{camera}.parquet": "0" * 64 for camera in TAGS}
    for name in ("ingest", "detect", "estimate", "track", "survey"):
        made = outputs if name == "detect" else {}
        folder.write_manifest(Manifest(name, 1, "f" * 64, {}, {}, {}, made, {}))
