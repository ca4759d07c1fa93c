"""One recorded site: the log and the files beside it."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from pipeline.logs.writer import LogWriter
from pipeline.synthetic import files, survey, table, truth
from pipeline.synthetic.cycle import Motion
from pipeline.synthetic.draws import Uncertainty, file_mounts, uncertainty
from pipeline.synthetic.excavator import Mounts, raw_reading, true_mounts
from pipeline.synthetic.renderer import Renderer
from pipeline.synthetic.specification import SensorPlan, Specification
from pipeline.synthetic.touching import Touching, check_file

SLICE_FRAMES = 12
CELL_M = 0.05
STATION_STEP_M = 0.5


@dataclass(frozen=True)
class World:
    """Everything about a site that the seed decides, except the noise in frames and readings."""

    spec: Specification
    seed: int
    truth: Mounts
    files: Mounts
    sigma: Uncertainty
    motion: Motion


@dataclass(frozen=True)
class Shot:
    """One frame to be rendered."""

    camera: str
    index: int
    time_ns: int
    """Since the start of the log: middle of the exposure, which is the stamp."""


def world(spec: Specification, seed: int) -> World:
    """The site of a specification and a seed."""
    # Streams are apart, so that another camera or one more cycle does not change every other draw.
    built = true_mounts(spec, np.random.default_rng([seed, 2]))
    streams = np.random.default_rng([seed, 1])
    motion = Touching(spec, streams, built) if spec.touches else Motion(spec, streams)
    sigma = uncertainty(spec)
    return World(
        spec, seed, built, file_mounts(built, sigma, np.random.default_rng([seed, 3])), sigma, motion
    )


def shots(w: World) -> list[Shot]:
    """All frames in the order of their stamps."""
    rng = np.random.default_rng([w.seed, 4])
    found = []
    for camera in w.spec.cameras:
        ticks = np.arange(0.05, w.motion.duration_s - 0.05, 1 / w.spec.rate_hz) + camera.stamp_delay_ms / 1000
        ticks = ticks + rng.normal(0, 0.0002, len(ticks))
        found += [Shot(camera.name, i, round(t * 1e9)) for i, t in enumerate(ticks)]
    return sorted(found, key=lambda shot: shot.time_ns)


def readings(w: World, plan: SensorPlan) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) in ns since the start of the log and raw readings (n,) of a sensor."""
    rng = np.random.default_rng([w.seed, 5, [s.name for s in w.spec.sensors].index(plan.name)])
    ticks = np.arange(0.0, w.motion.duration_s - 0.1, 1 / plan.rate_hz)
    stamp_ns = np.round((ticks + 0.003 + rng.normal(0, plan.jitter_s, len(ticks)).clip(-0.003, 0.01)) * 1e9)
    true_s = stamp_ns / 1e9 + w.truth.time_offsets[plan.name]
    angle = w.motion.poses(true_s).joint_rad()
    raw = raw_reading(plan.kind, angle, w.truth, w.spec.arm.linkage_side, plan.name)
    raw = raw + rng.normal(0, plan.noise, len(raw))
    return stamp_ns.astype(np.int64), np.round(raw / plan.step) * plan.step


def record(
    spec: Specification,
    seed: int,
    folder: Path,
    jobs: int,
    progress: Callable[[int, int], None] = lambda done, of: None,
    machine: str | None = None,
) -> Path:
    """Write a site's log and all files beside it; the same bytes for any number of jobs.

    Parameters
    ----------
    spec, seed
        What to record.
    folder
        Made if it does not exist.
    jobs
        Processes that render.
    progress
        Called with frames written and frames in all.
    machine
        Text of a machine.toml that several logs share; left out, the log has one of its own beside it.

    Returns
    -------
    Path
        The log.
    """
    w = world(spec, seed)
    folder.mkdir(parents=True, exist_ok=True)
    if machine is None:
        machine = files.machine_toml(spec, w.files, w.sigma)
        (folder / "machine.toml").write_text(machine, encoding="utf-8", newline="\n")
    site = files.site_toml(spec, w.files)
    for name, text in (
        ("site.toml", site + files.afterwards_toml(spec)),
        ("design.csv", survey.design_csv(spec)),
        ("design.xml", survey.design_xml(spec)),
        ("checks.csv", _checks(w)),
    ):
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    write_truth(w, folder / "truth")
    path = folder / f"{spec.name}.mcap"
    _write_log(w, path, machine, site, jobs, progress)
    return path


def _write_log(
    w: World, path: Path, machine: str, site: str, jobs: int, progress: Callable[[int, int], None]
) -> None:
    spec, start = w.spec, w.spec.start_utc_ns
    planned = shots(w)
    rng = np.random.default_rng([w.seed, 6])
    # (log time, order, what): a recorder writes messages in the order in which it receives them.
    events: list[tuple[int, int, tuple]] = []
    for i, shot in enumerate(planned):
        events.append((shot.time_ns + 31_000_000 + int(rng.exponential(1.5e6)), 1, ("frame", i)))
    for plan in spec.sensors:
        for stamp, raw in zip(*readings(w, plan)):
            delay = 1_200_000 + int(rng.exponential(4e5))
            events.append((int(stamp) + delay, 0, ("sample", plan, int(stamp), float(raw))))
    events.sort(key=lambda event: event[:2])
    with LogWriter(path) as log:
        for name, text in (("machine.toml", machine), ("site.toml", site)):
            log.add_attachment(name, "application/toml", text.encode(), start)
        for camera in spec.cameras:
            log.camera_calibration(
                camera.topic.removesuffix("/image") + "/calibration",
                start,
                camera.name,
                spec.width,
                spec.height,
                np.round(w.files.intrinsics[camera.name], 7),
            )
        rendered = frames(w, planned, jobs)
        ready: dict[int, bytes] = {}
        taken, done = 0, 0
        topics = {c.name: c.topic for c in spec.cameras}
        for log_time, _, event in events:
            if event[0] == "sample":
                _, plan, stamp, raw = event
                log.sample(
                    plan.topic,
                    start + stamp,
                    raw,
                    unit={"potentiometer": "V", "encoder": "rad", "card": "count"}[plan.kind],
                    message=plan.message,
                    name="bucket",
                    encoding=plan.encoding,
                    log_time_ns=start + log_time,
                )
                continue
            index = event[1]
            while index not in ready:
                ready[taken] = next(rendered)
                taken += 1
            shot = planned[index]
            log.image(
                topics[shot.camera],
                start + shot.time_ns,
                shot.camera,
                ready.pop(index),
                log_time_ns=start + log_time,
            )
            done += 1
            progress(done, len(planned))


def frames(w: World, planned: list[Shot], jobs: int) -> Iterator[bytes]:
    """JPEGs of the planned frames, in order, rendered by `jobs` spawned processes."""
    if jobs <= 1:
        _start(w.spec, w.seed)
        for shot in planned:
            yield _render([shot])[0]
        return
    slices = [planned[i : i + SLICE_FRAMES] for i in range(0, len(planned), SLICE_FRAMES)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=_start, initargs=(w.spec, w.seed)) as pool:
        # A few slices ahead, not all: hours of rendered frames would not fit into memory.
        pending = [pool.submit(_render, piece) for piece in slices[: 2 * jobs]]
        for next_slice in range(len(pending), len(slices) + len(pending)):
            jpegs = pending.pop(0).result()
            if next_slice < len(slices):
                pending.append(pool.submit(_render, slices[next_slice]))
            yield from jpegs
            if not pending:
                return


_renderer: Renderer | None = None


def _start(spec: Specification, seed: int) -> None:
    global _renderer
    cv2.setNumThreads(1)
    w = world(spec, seed)
    _renderer = Renderer(spec, w.truth, w.motion, seed)


def _render(piece: list[Shot]) -> list[bytes]:
    assert _renderer is not None
    quality = _renderer.spec.jpeg_quality
    return [
        simplejpeg.encode_jpeg(
            _renderer.frame(shot.camera, shot.index, shot.time_ns / 1e9)[..., None],
            quality=quality,
            colorspace="GRAY",
        )
        for shot in piece
    ]


def _checks(w: World) -> str:
    """Total-station shots: along the finished floor, left, middle and right, and the control point."""
    if isinstance(w.motion, Touching):
        return check_file(w.spec, w.motion)
    rng = np.random.default_rng([w.seed, 7])
    floor = truth.dug_floor(w.spec, w.truth, w.motion, CELL_M)
    place = w.motion.place
    points, notes = [w.motion.control_point], ["CP control point"]
    cut = np.flatnonzero(np.isfinite(floor.z).all(axis=1))
    middle = floor.z.shape[1] // 2
    for i, row in enumerate(cut[6:-6:7]):
        column = (middle, 3, middle, floor.z.shape[1] - 4)[i % 4]
        points.append(place.point(floor.station[row], floor.offset[column], floor.z[row, column]))
        notes.append("FL floor")
    return survey.check_shots(w.spec, np.array(points), notes, rng)


def write_truth(w: World, folder: Path) -> None:
    """truth/: cutting_edge, stations and as_built as Parquet, statics as JSON. No stage may read it."""
    folder.mkdir(parents=True, exist_ok=True)
    spec, motion = w.spec, w.motion
    origin = np.array(spec.origin) * files.METRES_PER_UNIT[spec.unit]
    coarse = np.arange(0.0, motion.duration_s, 0.02)
    fine = np.arange(0.01, motion.duration_s, 0.02)
    fine = fine[motion.phase(fine) == "dig"]
    t = np.concatenate([coarse, fine, [shot.time_ns / 1e9 for shot in shots(w)]])
    time_ns = np.unique(np.round(t * 1e9).astype(np.int64))
    points = np.round(truth.edge_points(spec, w.truth, motion, time_ns / 1e9) + origin, 5)
    n = len(time_ns)
    table.write(
        folder / "cutting_edge.parquet",
        {
            "time_ns": np.repeat(time_ns + spec.start_utc_ns, 3),
            "point": np.tile(np.array(truth.POINTS, object), n),
            **{name: points[..., i].reshape(-1) for i, name in enumerate("enh")},
            "phase": np.repeat(motion.phase(time_ns / 1e9), 3),
        },
    )
    floor = truth.dug_floor(spec, w.truth, motion, CELL_M)
    table.write(folder / "stations.parquet", truth.station_truth(spec, floor, STATION_STEP_M))
    rows, columns = np.nonzero(np.isfinite(floor.z))
    table.write(
        folder / "as_built.parquet",
        {
            "station": np.round(floor.station[rows], 4),
            "offset": np.round(-floor.offset[columns], 4),  # right positive, as surveyors have it
            "h": np.round(floor.z[rows, columns] + origin[2], 5),
        },
    )
    statics = truth.statics_truth(spec, w.truth, w.files, w.sigma)
    statics["control_point_grid"] = (w.motion.control_point + origin).tolist()
    statics["control_stop_ns"] = [round(s * 1e9) + spec.start_utc_ns for s in motion.control_stop_s]
    (folder / "statics.json").write_text(json.dumps(statics, indent=1) + "\n", encoding="utf-8")
