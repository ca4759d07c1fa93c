"""Recording what `calibration_sites` describes: log, machine.toml, site.toml, surveyed corners, and the truth."""

from __future__ import annotations

import datetime
import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from pipeline.geometry import se3
from pipeline.logs.writer import LogWriter
from pipeline.synthetic import files, recording, survey
from pipeline.synthetic.calibration_sites import (
    BUCKET_BOARD,
    CalibrationRenderer,
    CalibrationSite,
    calibration_site,
)
from pipeline.synthetic.draws import Uncertainty
from pipeline.synthetic.excavator import Mounts, board
from pipeline.synthetic.specification import Specification

SLICE_FRAMES = 12
CORNER_NAMES = ("TL", "TR", "BR", "BL")
SIGMA_CORNER_MM = 1.0
PIN_SHOTS_S, HALF_PIN_M = 3.0, 0.35


def record_calibration(
    name: str,
    seed: int,
    folder: Path,
    jobs: int,
    progress: Callable[[int, int], None] = lambda done, of: None,
    machine: str | None = None,
) -> Path:
    """Write a calibration log and all files beside it; the same bytes for any number of jobs.

    Parameters
    ----------
    name, seed
        As for `calibration_site`.
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
    site = calibration_site(name, seed)
    folder.mkdir(parents=True, exist_ok=True)
    site_text = site_toml(site)
    if machine is None:
        machine = machine_text(site.spec, site.files, site.sigma, bucket_board=site.bucket_marker is not None)
        (folder / "machine.toml").write_text(machine, encoding="utf-8", newline="\n")
    for file, text in (
        ("site.toml", site_text),
        ("design.csv", survey.design_csv(site.spec)),
        ("corners.csv", corner_shots(site)),
    ):
        (folder / file).write_text(text, encoding="utf-8", newline="\n")
    if site.bucket_marker is not None:
        (folder / "pins.csv").write_text(pin_shots(site), encoding="utf-8", newline="\n")
    (folder / "truth").mkdir(exist_ok=True)
    (folder / "truth" / "statics.json").write_text(
        json.dumps(truth_of(site), indent=1) + "\n", encoding="utf-8"
    )
    path = folder / f"{name}.mcap"
    _write_log(site, name, path, {"machine.toml": machine, "site.toml": site_text}, jobs, progress)
    return path


def machine_text(spec: Specification, said: Mounts, sigma: Uncertainty, bucket_board: bool) -> str:
    """Text of machine.toml; the board on the bucket, where there is one, hangs where nobody has measured."""
    text = files.machine_toml(spec, said, sigma)
    if not bucket_board:
        return text
    made = board(BUCKET_BOARD, spec.family)
    lines = [
        "",
        "# Held to the bucket by magnets while its axis is calibrated; nobody has measured where.",
        f"[markers.{BUCKET_BOARD.name}]",
        'body = "bucket"',
        f'family = "{spec.family}"',
        "tags = [",
        *[
            f"  {{ id = {tag}, size_m = {made.tag_m}, x_m = {x:.4f}, y_m = {y:.4f} }},"
            for tag, (x, y) in zip(made.ids, made.centres, strict=True)
        ],
        "]",
    ]
    return text + "\n".join(lines) + "\n"


def site_toml(site: CalibrationSite) -> str:
    """Text of site.toml: there are no check shots in the yard."""
    before, _, rest = files.site_toml(site.spec, site.files).partition("[checks]")
    return before + "[report]" + rest.partition("[report]")[2]


def corner_shots(site: CalibrationSite) -> str:
    """The outer corners of every board, shot with the total station: PNEZD with ids such as wall-1-TL, grid unit."""
    rng = np.random.default_rng([site.seed, 32])
    unit = files.METRES_PER_UNIT[site.spec.unit]
    lines = []
    for plan in site.spec.benchmarks:
        corners = board(plan.board, site.spec.family).corners().reshape(-1, 3)
        signs = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
        outer = np.array([corners[np.argmax(corners[:, :2] @ s)] for s in signs])
        p = se3.transform(site.truth.benchmarks[plan.board.name], outer)
        p = p + rng.normal(size=p.shape) * SIGMA_CORNER_MM / 1000
        for name, (e, n, h) in zip(CORNER_NAMES, np.array(site.spec.origin) + p / unit, strict=True):
            lines.append(f"{plan.board.name}-{name},{n:.4f},{e:.4f},{h:.4f},tag corner")
    return "\n".join(lines) + "\n"


def pin_shots(site: CalibrationSite) -> str:
    """Both ends of the bucket's pin, shot while the machine stands: PNEZD with headings and times, grid unit."""
    rng = np.random.default_rng([site.seed, 33])
    unit = files.METRES_PER_UNIT[site.spec.unit]
    t = PIN_SHOTS_S * np.ones(2)
    ends = np.array([[0.0, 0.0, -HALF_PIN_M], [0.0, 0.0, HALF_PIN_M]])
    p = se3.transform(site.motion.poses(t).stick(site.spec) @ site.truth.axis, ends)
    p = p + rng.normal(size=p.shape) * SIGMA_CORNER_MM / 1000
    stamp = datetime.datetime.fromtimestamp(site.spec.start_utc_ns / 1e9 + PIN_SHOTS_S, datetime.UTC)
    lines = ["point,northing,easting,elevation,time,sigma_mm"]
    for name, (e, n, h) in zip("LR", np.array(site.spec.origin) + p / unit, strict=True):
        lines.append(f"bucket-{name},{n:.4f},{e:.4f},{h:.4f},{stamp:%Y-%m-%dT%H:%M:%SZ},{SIGMA_CORNER_MM:g}")
    return "\n".join(lines) + "\n"


def truth_of(site: CalibrationSite) -> dict[str, object]:
    """What everything really is, for truth/statics.json. No stage may read it."""
    return {
        "cameras": {name: T.tolist() for name, T in site.truth.cameras.items()},
        "intrinsics": {name: v.tolist() for name, v in site.truth.intrinsics.items()},
        "benchmarks": {name: T.tolist() for name, T in site.truth.benchmarks.items()},
        "stick_marker": site.truth.stick_marker.tolist(),
        "axis": site.truth.axis.tolist(),
        "bucket_marker": None if site.bucket_marker is None else site.bucket_marker.tolist(),
    }


def _write_log(
    site: CalibrationSite,
    name: str,
    path: Path,
    attachments: dict[str, str],
    jobs: int,
    progress: Callable[[int, int], None],
) -> None:
    spec, start = site.spec, site.spec.start_utc_ns
    planned = recording.shots(site)  # type: ignore[arg-type]
    samples = [
        (int(stamp), float(raw), plan)
        for plan in spec.sensors
        for stamp, raw in zip(*recording.readings(site, plan), strict=True)  # type: ignore[arg-type]
    ]
    with LogWriter(path) as log:
        for file, text in attachments.items():
            log.add_attachment(file, "application/toml", text.encode(), start)
        for stamp, raw, plan in samples:
            log.sample(
                plan.topic,
                start + stamp,
                raw,
                unit="V",
                message=plan.message,
                name="bucket",
                encoding=plan.encoding,
                log_time_ns=start + stamp + 1_500_000,
            )
        topics = {c.name: c.topic for c in spec.cameras}
        for k, (shot, jpeg) in enumerate(zip(planned, _frames(site, name, planned, jobs), strict=True)):
            log.image(
                topics[shot.camera],
                start + shot.time_ns,
                shot.camera,
                jpeg,
                log_time_ns=start + shot.time_ns + 32_000_000,
            )
            progress(k + 1, len(planned))


def _frames(site: CalibrationSite, name: str, planned: list[recording.Shot], jobs: int) -> Iterator[bytes]:
    """JPEGs of the planned frames, in order."""
    if jobs <= 1:
        yield from _render(CalibrationRenderer(site), planned)
        return
    slices = [planned[i : i + SLICE_FRAMES] for i in range(0, len(planned), SLICE_FRAMES)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=_start, initargs=(name, site.seed)) as pool:
        for jpegs in pool.map(_render_slice, slices):
            yield from jpegs


_renderer: CalibrationRenderer | None = None


def _start(name: str, seed: int) -> None:
    global _renderer
    cv2.setNumThreads(1)
    _renderer = CalibrationRenderer(calibration_site(name, seed))


def _render_slice(piece: list[recording.Shot]) -> list[bytes]:
    assert _renderer is not None
    return list(_render(_renderer, piece))


def _render(renderer: CalibrationRenderer, piece: list[recording.Shot]) -> Iterator[bytes]:
    for shot in piece:
        yield simplejpeg.encode_jpeg(
            renderer.frame(shot.camera, shot.index, shot.time_ns / 1e9)[..., None],
            quality=renderer.spec.jpeg_quality,
            colorspace="GRAY",
        )
