"""Frames of the log for the page: what the cameras saw when the floor of the worst stations was made.

The log's index leads to each frame; nothing else of it is read. What cannot be shown is said in a sentence: the page
stands without its pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config.prints import described_tags
from pipeline.detection.acceptance import ACCEPTED
from pipeline.detection.decode import decode_grey
from pipeline.detection.preview import preview_jpeg
from pipeline.errors import ArtefactError, DetectionError, LogError
from pipeline.logs.container import Contents, indexed_contents, read_contents
from pipeline.logs.reader import read_log
from pipeline.report import View
from pipeline.report.moments import Moment
from pipeline.stages.job import Job

MAX_CAMERAS = 2
"""Per station: those that found the most tags."""
NEAREST_NS = 1_000_000_000
"""A frame further from the moment than this shows another one."""
MAX_WALKED_BYTES = 1_000_000_000
"""A log without an index is walked from its beginning for these pictures if it is no larger."""
CORNERS = [f"{axis}{corner}" for corner in range(4) for axis in "uv"]
FOUND = ["time_ns", "family", "tag_id", *CORNERS, "status"]
ADJUSTED = [
    "camera",
    "time_ns",
    "marker",
    "tag_id",
    "corner",
    "residual_u",
    "residual_v",
    "normalised",
    "weight",
]


@dataclass(frozen=True)
class _Shot:
    """A frame as the tables know it."""

    camera: str
    time_ns: int
    log_time_ns: int


def views_of(job: Job, moments: Sequence[Moment]) -> tuple[View, ...]:
    """Pictures of some moments, of at most two cameras each, with the tags in them."""
    shots = _nearest(job, moments)
    times = np.unique([shot.time_ns for near in shots for shot in near.values()]).astype(np.int64)
    tags = _tags(job, times)
    views: dict[tuple[str, int], View] = {}
    wanted: dict[tuple[str, int], _Shot] = {}
    for moment, near in zip(moments, shots):
        for camera in _cameras(job, near, tags):
            shot = near.get(camera)
            key = (camera, shot.time_ns if shot else moment.time_ns)
            if key in views:
                views[key] = replace(views[key], stations=(*views[key].stations, moment.station))
                continue
            why = "" if shot else f"camera '{camera}' took no picture within a second of it"
            views[key] = View((moment.station,), *key, why=why, tags=tags.get(key, {}))
            if shot:
                wanted[key] = shot
    return tuple({**views, **_with_pictures(job, wanted, views)}.values())


def _nearest(job: Job, moments: Sequence[Moment]) -> list[dict[str, _Shot]]:
    """For each moment: camera -> the frame nearest to it."""
    frames = job.read_table("frames", ["camera", "time_ns", "log_time_ns"])
    found: list[dict[str, _Shot]] = [{} for _ in moments]
    for camera in job.machine.cameras:
        own = np.flatnonzero(frames["camera"] == camera)
        time_ns = frames["time_ns"][own]
        for near, moment in zip(found, moments):
            if not len(own):
                continue
            away = np.abs(time_ns - moment.time_ns)
            row = int(np.argmin(away))
            if away[row] <= NEAREST_NS:
                near[camera] = _Shot(camera, int(time_ns[row]), int(frames["log_time_ns"][own[row]]))
    return found


def _cameras(job: Job, near: Mapping[str, _Shot], tags: Mapping[tuple[str, int], dict]) -> list[str]:
    """At most two cameras of a moment in the machine's order: those that found the most tags then."""

    def count(camera: str) -> int:
        if camera not in near:
            return -1
        return len(tags.get((camera, near[camera].time_ns), {}).get("tag", ()))

    cameras = list(job.machine.cameras)
    most = sorted(cameras, key=lambda camera: -count(camera))[:MAX_CAMERAS]
    return [camera for camera in cameras if camera in most]


def _tags(job: Job, times: np.ndarray) -> dict[tuple[str, int], dict[str, np.ndarray]]:
    """Tags by camera and frame: what was found, and where the solution puts its corners."""
    owner = described_tags(job.machine, job.site)
    try:
        adjusted = job.read_table("residuals", ADJUSTED, at_ns=times)
    except ArtefactError:  # the page says elsewhere that the table is missing
        adjusted = {name: np.zeros(0) for name in ADJUSTED}
    found: dict[tuple[str, int], dict[str, np.ndarray]] = {}
    for camera in job.parts("detections"):
        if camera not in job.machine.cameras:
            continue
        rows = job.read_table("detections", FOUND, part=camera, at_ns=times)
        own = {name: values[adjusted["camera"] == camera] for name, values in adjusted.items()}
        for time_ns in np.unique(rows["time_ns"]):
            here = {name: values[rows["time_ns"] == time_ns] for name, values in rows.items()}
            there = {name: values[own["time_ns"] == time_ns] for name, values in own.items()}
            found[camera, int(time_ns)] = _of_frame(here, there, owner)
    return found


def _of_frame(found: Mapping, adjusted: Mapping, owner: Mapping[tuple[str, int], str]) -> dict:
    """The tags of one frame, in the order of the table, as `View.tags` wants them."""
    count = len(found["tag_id"])
    uv = np.stack([found[name] for name in CORNERS], axis=1).reshape(count, 4, 2)
    marker = [owner.get((family, tag), "") for family, tag in zip(found["family"], found["tag_id"].tolist())]
    predicted = np.full((count, 4, 2), np.nan)
    normalised, weight = np.full(count, np.nan), np.full(count, np.nan)
    for row in np.flatnonzero(found["status"] == ACCEPTED):
        of_tag = (adjusted["marker"] == marker[row]) & (adjusted["tag_id"] == found["tag_id"][row])
        if not np.any(of_tag):
            continue
        corner = adjusted["corner"][of_tag].astype(int)
        residual = np.stack([adjusted["residual_u"][of_tag], adjusted["residual_v"][of_tag]], axis=1)
        predicted[row, corner] = uv[row, corner] - residual  # residual is observed minus predicted
        normalised[row], weight[row] = adjusted["normalised"][of_tag].max(), adjusted["weight"][of_tag].min()
    return {
        "tag": np.array([f"{f} {t}" for f, t in zip(found["family"], found["tag_id"])], object),
        "marker": np.array(marker, object),
        "status": found["status"],
        "uv": uv,
        "predicted": predicted,
        "normalised": normalised,
        "weight": weight,
    }


def _with_pictures(
    job: Job, wanted: Mapping[tuple[str, int], _Shot], views: Mapping[tuple[str, int], View]
) -> dict[tuple[str, int], View]:
    """The views whose frames are in the log, with their pictures or why there is none."""
    try:
        contents = _contents(job)
        if contents is None:
            why = (
                f"{job.log.name} has no index, as after a recording that was cut off, and is too large to be "
                "searched for a picture"
            )
            return {key: replace(views[key], why=why) for key in wanted}
        facts = job.read_json("log.json")["cameras"]
        with read_log(job.log, contents) as reader:
            done = {}
            for key, shot in wanted.items():
                done[key] = replace(views[key], why="its picture cannot be read from the log")
                topics = {shot.camera: facts[shot.camera]["topic"]}
                for frame in reader.frames(topics, shot.log_time_ns, shot.log_time_ns + 1):
                    if frame.time_ns == shot.time_ns:
                        done[key] = _shown(views[key], frame)
                        break
            return done
    except (LogError, OSError) as error:
        # Without the folder: the same job gives the same bytes anywhere.
        why = str(error).replace(str(job.log), job.log.name)
        return {key: replace(views[key], why=why) for key in wanted}


def _contents(job: Job) -> Contents | None:
    """Where the log's messages lie, or None where finding out would take as long as reading all of them."""
    found = indexed_contents(job.log)
    if found is None and job.log.stat().st_size <= MAX_WALKED_BYTES:
        return read_contents(job.log)
    return found


def _shown(view: View, frame) -> View:
    try:
        grey = decode_grey(frame.data, frame.encoding, frame.width, frame.height)
    except DetectionError as error:
        return replace(view, why=str(error))
    height, width = grey.shape
    return replace(view, width=width, height=height, jpeg=preview_jpeg(grey))
