"""What detection costs and finds: `make bench-detection`.

Sequences of 1280x960 pictures at 10 Hz with three and nine tags in view (`_moving_tags`: the camera stands and swings,
tags that come, go and are covered) go through a log and the work of the stage in two processes, and the same frames
are read and decoded alone in two more; the ratio is of CPU time. Beside it OpenCV's and AprilTag's searches of whole
frames. Then: rows that a full search of every frame has and following has not; corner errors; false markers
in frames without tags; a log of twenty minutes, its time and memory, and what a shift would cost.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks._moving_tags import PERIOD, RATE_HZ, Shot, sequence, texture
from benchmarks._results import keep_result
from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import ACCEPTED, judge
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.decode import decode_grey
from pipeline.detection.refine import Refiner
from pipeline.detection.seen import search
from pipeline.detection.slices import Finders, Search, read_piece, search_slice, write_piece
from pipeline.detection.spans import Slice, frames_of, slices_of
from pipeline.detection.workers import search_slices, warm_up
from pipeline.logs.reader import LogReader, read_log
from pipeline.logs.writer import LogWriter

RATIO_BARS = {3: 2.0, 9: 3.0}
START_NS = 1_700_000_000_000_000_000
CAMERAS = ("left", "right")
SAME_PX = 1.0
FURTHEST = 5.0
SHIFT_FRAMES = 8 * 3600 * 2 * 10
PASSES = 10
SLOPE_BAR = 1.0
"""MB a minute; a shift of eight hours would add 0.5 GB."""


@dataclass(frozen=True)
class Cost:
    """One way to work at a sequence."""

    tags: int
    way: str
    ms: float
    """CPU time per frame."""
    ratio: float
    """To decoding."""
    bar: float = np.nan


@dataclass(frozen=True)
class Recall:
    """A sequence followed, against a full search of every frame of it."""

    tags: int
    frames: int
    full: int
    """Accepted by the full search."""
    missed: int
    """Of them, not accepted within 1 px by following."""
    followed: int
    """Accepted by following."""
    beyond: int
    """More rows than the full search has."""
    rms_px: float
    """Corner error of following, per axis."""
    full_rms_px: float
    wrong: int
    """Accepted more than 1 px from any such tag."""
    normalised: float
    """RMS of following's corner errors over their own sigma, per axis."""
    furthest: float
    """Largest Mahalanobis distance of a corner, in sigmas."""
    over: int
    """Rows with a corner beyond 5 sigmas."""


@dataclass(frozen=True)
class Long:
    """A log of some length through the stage's processes."""

    minutes: float
    frames: int
    seconds: float
    peak_mb: float
    """Of the largest process."""
    slope_mb_per_minute: float
    """Of log."""


def write_log(path: Path, shots: Sequence[Shot], frames: int) -> None:
    """The pictures of a period again and again, by two cameras half a period apart."""
    with LogWriter(path) as log:
        for k in range(frames):
            t = START_NS + k * 1_000_000_000 // RATE_HZ
            for number, camera in enumerate(CAMERAS):
                shot = shots[(k + number * PERIOD // 2) % PERIOD]
                log.image(f"/{camera}", t + number * 50_000_000, camera, shot.jpeg, log_time_ns=t + number)


def search_of(log: Path, size: tuple[int, int], frames: int, folder: Path) -> tuple[Search, list[Slice]]:
    with read_log(log) as reader:
        contents = reader.contents
    known = {"tag36h11": frozenset(range(100))}
    sizes = dict.fromkeys(CAMERAS, size)
    what = Search(log, contents, ("tag36h11",), known, sizes, DetectionSettings())
    k = np.tile(np.arange(frames), 2)
    number = np.repeat([0, 1], frames)
    table = {
        "camera": np.repeat(np.array(CAMERAS, object), frames),
        "frame": k,
        "time_ns": START_NS + k * (1_000_000_000 // RATE_HZ) + number * 50_000_000,
        "log_time_ns": START_NS + k * (1_000_000_000 // RATE_HZ) + number,
    }
    return what, slices_of(table, {name: f"/{name}" for name in CAMERAS}, sizes, folder)


_here: tuple[Search, LogReader, Finders] | None = None


def _begin(what: Search) -> None:
    global _here
    cv2.setNumThreads(1)
    warm_up(what)
    _here = what, read_log(what.log, what.contents).__enter__(), Finders(what)


def _cpu_s(way: str, part: Slice) -> float:
    """CPU seconds that one slice takes."""
    assert _here is not None
    what, reader, finders = _here
    begun = time.process_time()
    if way == "decode":
        for _, frame in frames_of(part, reader):
            decode_grey(frame.data, frame.encoding)
    else:
        part.piece.parent.mkdir(parents=True, exist_ok=True)
        write_piece(part, search_slice(part, what, reader, finders))
    return time.process_time() - begun


def costs(what: Search, slices: list[Slice], tags: int, shots: Sequence[Shot], every: int) -> list[Cost]:
    """CPU time per frame of the ways to work at a log, in two processes each; of the full searches, alone.

    The two ways in turn, and of each slice the best of `PASSES`: what a process does once (0.9 s of loading) belongs to
    the long log's time, and on a shared machine single slices took half as long again.
    """
    frames = sum(len(part.frame) for part in slices)
    seconds = {way: np.full(len(slices), np.inf) for way in ("decode", "follow")}
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), _begin, (what,)) as pool:
        for _ in range(PASSES):
            for way, best in seconds.items():
                best[:] = np.minimum(best, list(pool.map(_cpu_s, [way] * len(slices), slices)))
    ms = {way: 1e3 * float(best.sum()) / frames for way, best in seconds.items()}
    greys = [decode_grey(shot.jpeg, "jpeg") for shot in shots[::every]]
    finder = TagFinder(what.families)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    for name, look in (
        ("pyapriltags, whole", finder.find),
        ("OpenCV ArucoDetector, whole", detector.detectMarkers),
    ):
        begun = time.process_time()
        for grey in greys:
            look(grey)
        ms[name] = 1e3 * (time.process_time() - begun) / len(greys) + ms["decode"]
    return [
        Cost(tags, way, value, value / ms["decode"], RATIO_BARS[tags] if way == "follow" else np.nan)
        for way, value in ms.items()
    ]


def recall_of(what: Search, slices: list[Slice], tags: int, shots: Sequence[Shot]) -> Recall:
    """Rows of the kept pieces against a full search of every picture."""
    finder, refiner = TagFinder(what.families, what.settings), Refiner()
    full: list[dict[int, np.ndarray]] = []
    errors, full_errors, distances_2 = [], [], []
    for shot in shots:
        grey = decode_grey(shot.jpeg, "jpeg")
        seen = search(grey, finder, refiner)
        rows = judge(seen, what.known, what.settings) == ACCEPTED
        full.append(dict(zip(seen.tag_id[rows].tolist(), seen.uv[rows])))
        full_errors += [
            uv - at for number, uv in full[-1].items() if (at := _truth(shot, number)) is not None
        ]
    found = missed = rows_full = frames = wrong = 0
    for part in slices:
        shift = CAMERAS.index(part.camera) * PERIOD // 2
        columns = read_piece(part).columns
        uv = np.stack([columns[f"{axis}{k}"] for k in range(4) for axis in "uv"], axis=1).reshape(-1, 4, 2)
        cov = np.stack([columns[f"cov{k}_{e}"] for k in range(4) for e in ("uu", "uv", "uv", "vv")], axis=1)
        cov = cov.reshape(-1, 4, 2, 2)
        good = columns["status"] == ACCEPTED
        for frame in part.frame.tolist():
            index = (frame + shift) % PERIOD
            mine = np.flatnonzero(good & (columns["frame"] == frame))
            seen_here = {int(columns["tag_id"][row]): uv[row] for row in mine}
            cov_here = {int(columns["tag_id"][row]): cov[row] for row in mine}
            frames += 1
            found += len(mine)
            rows_full += len(full[index])
            for number, at in full[index].items():
                here = seen_here.get(number)
                missed += here is None or bool(np.abs(here - at).max() > SAME_PX)
            for number, here in seen_here.items():
                at = _truth(shots[index], number)
                if at is not None and np.abs(here - at).max() < SAME_PX:
                    errors.append(here - at)
                    whitened = np.linalg.solve(cov_here[number], (here - at)[..., None])[..., 0]
                    distances_2.append(np.sum((here - at) * whitened, axis=-1))
                # A tag whose rim alone is cut off has its corners in the picture, and no truth kept.
                elif at is not None or np.all((here > 2) & (here < np.array(what.sizes[part.camera]) - 3)):
                    wrong += 1
    rms, full_rms = (float(np.sqrt(np.mean(np.square(e)))) for e in (errors, full_errors))
    distance = np.sqrt(distances_2)
    return Recall(
        tags, frames, rows_full, missed, found, found - rows_full, rms, full_rms, wrong,
        normalised=float(np.sqrt(np.mean(distance**2) / 2)),
        furthest=float(distance.max()),
        over=int(np.sum(distance.max(axis=1) > FURTHEST)),
    )  # fmt: skip


def _truth(shot: Shot, number: int) -> np.ndarray | None:
    rows = np.flatnonzero(shot.tag_id == number)
    return shot.uv[rows[0]] if len(rows) else None


def false_markers(frames: int, seed: int = 5) -> tuple[int, int]:
    """Accepted markers in frames without any, searched whole, every id described; and what was decoded at all."""
    what = {"tag36h11": frozenset(range(587))}
    settings, finder, refiner = DetectionSettings(), TagFinder(["tag36h11"]), Refiner()
    accepted = decoded = 0
    rng = np.random.default_rng(seed)
    for k in range(frames):
        if k % 20 == 0:
            ground = texture(rng, 1400, 1100)
        turn, scale = rng.uniform(0, 360), rng.uniform(0.6, 1.6)
        M = cv2.getRotationMatrix2D((700, 550), turn, scale)
        M[:, 2] += rng.uniform(-150, 150, 2) - (380, 310)
        light = cv2.warpAffine(ground, M, (640, 480), borderMode=cv2.BORDER_REFLECT_101)
        light = (light - 105) * rng.uniform(0.5, 1.6) + 105 + rng.normal(0, rng.uniform(1, 6), (480, 640))
        grey = np.clip(np.rint(light), 0, 255).astype(np.uint8)
        seen = search(grey, finder, refiner)
        decoded += len(seen)
        accepted += int(np.sum(judge(seen, what, settings) == ACCEPTED))
    return accepted, decoded


def long_log(folder: Path, minutes: float) -> Long:
    """A long log of 640x480 pictures, two cameras at 10 Hz, in two processes; memory of each read as it goes."""
    size = (640, 480)
    shots = sequence(3, size, seed=3)
    frames = int(minutes * 60 * RATE_HZ)
    log = folder / "long.mcap"
    write_log(log, shots, frames)
    what, slices = search_of(log, size, frames, folder / "long")
    done, samples = [0], []
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(0.25):
            samples.append((done[0], max(_rss_mb())))

    watcher = threading.Thread(target=watch)
    watcher.start()
    begun = time.monotonic()

    def count(part: Slice) -> None:
        done[0] += len(part.frame)

    try:
        search_slices(what, slices, 2, count)
    finally:
        stop.set()
        watcher.join()
    seconds = time.monotonic() - begun
    table = np.array(samples)
    late = table[table[:, 0] >= 0.25 * 2 * frames]
    slope = float(np.polyfit(late[:, 0] / (2 * 60 * RATE_HZ), late[:, 1], 1)[0])
    log.unlink()
    return Long(minutes, 2 * frames, seconds, float(table[:, 1].max()), slope)


def _rss_mb() -> list[float]:
    """Memory of this process's children, and of itself."""
    found = []
    me = os.getpid()
    children = Path(f"/proc/{me}/task/{me}/children").read_text().split()
    for pid in [str(me), *children]:
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        except OSError:
            continue  # it ended meanwhile
        found.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=960, help="per camera and sequence (default 960)")
    parser.add_argument(
        "--every", type=int, default=16, help="one in so many frames for the full searches' time"
    )
    parser.add_argument("--textures", type=int, default=5000, help="frames without tags (default 5000)")
    parser.add_argument(
        "--minutes", type=float, default=20.0, help="of the long log (default 20; 0 leaves it out)"
    )
    options = parser.parse_args()
    rows: list[Cost | Recall | Long | dict] = []
    failed: list[str] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        print("tags  way                            ms/frame  ratio   bar")
        follow_ms = {}
        recalls = []
        for tags in RATIO_BARS:
            shots = sequence(tags)
            log = folder / f"tags{tags}.mcap"
            write_log(log, shots, options.frames)
            what, slices = search_of(log, (1280, 960), options.frames, folder / f"tags{tags}")
            for cost in costs(what, slices, tags, shots, options.every):
                bar = "" if np.isnan(cost.bar) else f"{cost.bar:.1f}"
                print(f"{tags:4d}  {cost.way:28s}  {cost.ms:8.2f}  {cost.ratio:5.2f}   {bar}", flush=True)
                rows.append(cost)
                if cost.way == "follow":
                    follow_ms[tags] = cost.ms
                    if cost.ratio > cost.bar:
                        failed.append(
                            f"{tags} tags cost {cost.ratio:.2f} times decoding (bar {cost.bar:.1f})"
                        )
            recalls.append(recall_of(what, slices, tags, shots))
            log.unlink()
        print(
            "tags  frames  full search  missed  followed  beyond  RMS px (full)  wrong  normalised  furthest  over 5"
        )
        for recall in recalls:
            rows.append(recall)
            print(
                f"{recall.tags:4d}  {recall.frames:6d}  {recall.full:11d}  {recall.missed:6d}  {recall.followed:8d}  "
                f"{recall.beyond:6d}  {recall.rms_px:.4f} ({recall.full_rms_px:.4f})  {recall.wrong:5d}  "
                f"{recall.normalised:10.2f}  {recall.furthest:8.1f}  {recall.over:6d}",
                flush=True,
            )
            if recall.beyond < 0:
                failed.append(f"{recall.tags} tags: {-recall.beyond} rows fewer than the full search")
            if recall.wrong:
                failed.append(f"{recall.tags} tags: {recall.wrong} rows are no such tag")
        accepted, decoded = false_markers(options.textures)
        rows.append({"textures": options.textures, "decoded": decoded, "false": accepted})
        print(f"{options.textures} frames without tags: {decoded} decoded, {accepted} accepted", flush=True)
        if accepted:
            failed.append(f"{accepted} false markers")
        if options.minutes > 0:
            long = long_log(folder, options.minutes)
            rows.append(long)
            print(
                f"{long.minutes:g} min of 640x480, {long.frames} frames: {long.seconds:.0f} s, "
                f"peak {long.peak_mb:.0f} MB, slope {long.slope_mb_per_minute:+.2f} MB per minute of log"
            )
            if long.slope_mb_per_minute > SLOPE_BAR:
                failed.append(f"memory grows by {long.slope_mb_per_minute:.2f} MB per minute of log")
    hours = {tags: SHIFT_FRAMES * ms / 1e3 / 2 / 3600 for tags, ms in follow_ms.items()}
    shift = "; ".join(f"{tags} tags {value:.2f} h" for tags, value in hours.items())
    print(f"a shift of 8 h, 2 cameras, 10 Hz at 1280x960 on two cores: {shift}")
    ratios = {cost.tags: cost.ratio for cost in rows if isinstance(cost, Cost) and cost.way == "follow"}
    line = (
        "detection: "
        + ", ".join(
            f"{tags} tags {ratio:.2f} times decoding (bar {RATIO_BARS[tags]:.1f})"
            for tags, ratio in ratios.items()
        )
        + f"; missed {sum(r.missed for r in recalls)} of {sum(r.full for r in recalls)} rows of the full search, "
        f"{sum(r.beyond for r in recalls)} rows beyond it; {accepted} false in {options.textures} frames; shift {shift}"
    )
    keep_result("detection", rows, line)
    print(line)
    for what_failed in failed:
        print("missed bar:", what_failed)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
