"""ingest: the log's frames and sensor readings as tables, and what is known of the log itself."""

from __future__ import annotations

from array import array
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

import numpy as np

from pipeline.config.machine import Camera, Machine
from pipeline.detection.decode import picture_size
from pipeline.errors import DetectionError, LogError
from pipeline.logs.channels import CALIBRATION, Channel
from pipeline.logs.clock import EARLIEST_NS, Stamps, in_order
from pipeline.logs.messages import Calibration, cannot_read
from pipeline.logs.reader import Frame, LogReader, read_log
from pipeline.stages.job import Counts, Job
from pipeline.stages.runner import Progress

SILENT_S = 5.0
"""A source that ends this much before the last frame has stopped, and a person should know."""
GAP_S = 2.0
"""A pause between frames of one camera from which it counts as a gap."""
APART_S = 600.0
"""Clocks of two sources this far apart are not of one recording."""
MAX_UNSTAMPED = 0.1
"""Part of a source's messages that may come without a capture stamp (drivers starting up)."""

Columns = dict[str, array]


def run(job: Job, progress: Progress) -> Counts:
    """Write `frames`, `sensors` and `log.json`. Raises LogError, DetectionError."""
    with read_log(job.log) as reader:
        calibrations = reader.calibrations()
        used = chosen_calibrations(job.machine, calibrations, reader.channels, job.log.name)
        machine = job.machine.with_calibrations(used, job.machine_source.name)
        cameras, sizes = _read_frames(reader, machine, progress)
        sensors = _read_samples(reader, job.machine, progress)
        _check_clocks(cameras | sensors, job.log.name, progress)
        frames, frame_stamps = _frame_table(cameras)
        readings, sensor_stamps = _sensor_table(sensors)
        if not len(frames["time_ns"]):
            raise LogError(f"{job.log}: not one frame of the machine's cameras can be used")
        start_ns, end_ns = _span(frames, readings)
        _warn_of_silence(frames, readings, job.machine, end_ns, progress)
        _warn_of_stamps(frame_stamps, sensor_stamps, progress)
        recovery = reader.recovery
        if not recovery.complete:
            progress.warn(recovery.sentence)
        for (topic, reason), count in sorted(reader.faults.items()):
            progress.warn(f"{count} messages on topic '{topic}' could not be read: {reason}")
        job.write_table("frames", frames)
        job.write_table("sensors", readings)
        job.write_json(
            "log.json",
            {
                "recovery": asdict(recovery),
                "start_ns": start_ns,
                "end_ns": end_ns,
                "profile": reader.contents.profile,
                "library": reader.contents.library,
                "bytes": reader.contents.size,
                "channels": [{**asdict(channel), "carries": channel.carries} for channel in reader.channels],
                "cameras": {
                    name: {"topic": camera.topic, "width": sizes[name][0], "height": sizes[name][1]}
                    for name, camera in machine.cameras.items()
                },
                "clock": {
                    name: _stamp_facts(stamps) for name, stamps in {**frame_stamps, **sensor_stamps}.items()
                },
                "calibrations": used,
                "calibration_topics": sorted(calibrations),
                "attachments": {
                    name: {"bytes": size, "sha256": digest}
                    for name, (size, digest) in sorted(reader.attachment_hashes().items())
                },
                "unreadable": [
                    {"topic": topic, "reason": reason, "count": count}
                    for (topic, reason), count in sorted(reader.faults.items())
                ],
            },
        )
    stamps = [*frame_stamps.values(), *sensor_stamps.values()]
    return {
        "frames": _per_source(frames["camera"], machine.cameras),
        "readings": _per_source(readings["sensor"], machine.sensors),
        "rejected messages": _counted(
            {
                "without stamp": sum(s.zero for s in stamps),
                "stamp used twice": sum(s.repeated for s in stamps),
                "unreadable": sum(reader.faults.values()),
            }
        ),
        "sorted messages": sum(s.backwards for s in stamps),
        "damaged chunks": recovery.damaged_chunks,
    }


def _per_source(names: np.ndarray, known: Any) -> dict[str, int]:
    return {name: int(np.sum(names == name)) for name in known}


def _counted(reasons: dict[str, int]) -> dict[str, int]:
    return {reason: count for reason, count in reasons.items() if count}


def chosen_calibrations(
    machine: Machine, found: dict[str, Calibration], channels: list[Channel], log_name: str
) -> dict[str, dict[str, Any]]:
    """Calibration from the log for each camera that has none in the machine file and one in the log.

    Without `calibration_topic`, the calibration whose topic shares the longest path with the camera's images is
    taken, as drivers publish them side by side (``/cab/image``, ``/cab/camera_info``).

    Raises
    ------
    LogError
        The topic named holds no calibration that can be used.
    """
    chosen = {}
    for name, camera in machine.cameras.items():
        if camera.intrinsics is not None:
            continue
        topic = camera.calibration_topic or _beside(camera, found)
        if topic is None:
            continue
        if topic not in found:
            here = [channel for channel in channels if channel.topic == topic]
            unreadable = here and here[0].carries != CALIBRATION
            reason = (
                cannot_read(here[0], CALIBRATION)
                if unreadable
                else f"topic '{topic}' is not in the log or holds no message"
            )
            others = f"; calibrations are on: {', '.join(sorted(found))}" if found else ""
            raise LogError(
                f"{log_name}: camera '{name}' takes its calibration from the log, but {reason}{others}; "
                f"correct cameras.{name}.calibration_topic, or add [cameras.{name}.intrinsics]"
            )
        calibration = found[topic]
        if calibration.problem:
            raise LogError(
                f"{log_name}: the calibration of camera '{name}' on topic '{topic}' cannot be used: "
                f"{calibration.problem}; add [cameras.{name}.intrinsics] to machine.toml"
            )
        fx, fy, cx, cy, *distortion = calibration.intrinsics.tolist()
        size = {"width": calibration.width, "height": calibration.height}
        chosen[name] = {
            "topic": topic, **size, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": distortion
        }  # fmt: skip
    return chosen


def _beside(camera: Camera, found: dict[str, Calibration]) -> str | None:
    def shared(topic: str) -> int:
        ours, theirs = camera.topic.strip("/").split("/"), topic.strip("/").split("/")
        count = 0
        while count < min(len(ours), len(theirs)) and ours[count] == theirs[count]:
            count += 1
        return count

    ranked = sorted(found, key=lambda topic: (-shared(topic), topic))
    if not ranked:
        return None
    # Two that are equally near: guessing would give one camera the lens of another.
    tied = len(ranked) > 1 and shared(ranked[0]) == shared(ranked[1])
    return None if tied or (shared(ranked[0]) == 0 and len(ranked) > 1) else ranked[0]


ENCODINGS = ("jpeg", "png", "raw")


def _read_frames(
    reader: LogReader, machine: Machine, progress: Progress
) -> tuple[dict[str, Columns], dict[str, tuple[int, int]]]:
    topics = {name: camera.topic for name, camera in machine.cameras.items()}
    shared = [topic for topic in topics.values() if list(topics.values()).count(topic) > 1]
    if shared:
        raise LogError(f"two cameras of machine.toml read topic '{shared[0]}'; give each its own")
    counts = {channel.topic: channel.message_count for channel in reader.channels}
    progress.total(sum(counts.get(topic, 0) for topic in topics.values()), "frames")
    columns: dict[str, Columns] = {
        name: {key: array("q") for key in ("time_ns", "log_time_ns", "bytes", "encoding")} for name in topics
    }
    sizes: dict[str, tuple[int, int]] = {}
    for frame in reader.frames(topics):
        rows = columns[frame.camera]
        rows["time_ns"].append(frame.time_ns)
        rows["log_time_ns"].append(frame.log_time_ns)
        rows["bytes"].append(len(frame.data))
        rows["encoding"].append(ENCODINGS.index(frame.encoding))
        if frame.camera not in sizes and (size := _size_of(frame)):
            sizes[frame.camera] = size
            _check_size(frame.camera, size, machine, reader.path.name)
        progress.advance()
    for name, topic in topics.items():
        if columns[name]["time_ns"] and name not in sizes:
            count = len(columns[name]["time_ns"])
            raise DetectionError(
                f"{reader.path}: every one of the {count} pictures of camera '{name}' is corrupt; "
                "look at the recording with another viewer: the camera, its driver or the disk is at fault"
            )
        if not columns[name]["time_ns"]:
            reasons = [reason for (where, reason), _ in reader.faults.most_common() if where == topic]
            raise LogError(
                f"{reader.path}: no picture on topic '{topic}' of camera '{name}' can be read: "
                f"{reasons[0] if reasons else 'its chunks are damaged'}"
            )
    return columns, sizes


def _size_of(frame: Frame) -> tuple[int, int] | None:
    try:
        return picture_size(frame.data, frame.encoding, frame.width, frame.height)
    except DetectionError:  # the next one will tell; corrupt pictures are counted by detect
        return None


def _check_size(camera: str, size: tuple[int, int], machine: Machine, log_name: str) -> None:
    intrinsics = machine.cameras[camera].intrinsics
    assert intrinsics is not None
    if size != (intrinsics.width, intrinsics.height):
        raise LogError(
            f"{log_name}: camera '{camera}' recorded {size[0]} x {size[1]} pixels, but its intrinsics are for "
            f"{intrinsics.width} x {intrinsics.height}; record in the size it was calibrated in, or calibrate it "
            "in this one (a scaled calibration is right only if the driver scaled, and wrong if it cropped)"
        )


def _read_samples(reader: LogReader, machine: Machine, progress: Progress) -> dict[str, Columns]:
    columns: dict[str, Columns] = {}
    wanted = {}
    for name, sensor in machine.sensors.items():
        columns[name] = {"time_ns": array("q"), "log_time_ns": array("q"), "raw": array("d")}
        if any(channel.topic == sensor.topic and channel.message_count for channel in reader.channels):
            wanted[name] = (sensor.topic, sensor.field)
        else:
            progress.warn(
                f"sensor '{name}': topic '{sensor.topic}' is not in the log or holds no message; "
                f"joint '{sensor.joint}' has no reading"
            )
    if wanted:
        for sample in reader.samples(wanted):
            rows = columns[sample.sensor]
            rows["time_ns"].append(sample.time_ns)
            rows["log_time_ns"].append(sample.log_time_ns)
            rows["raw"].append(sample.raw)
    for name, (topic, field) in wanted.items():
        if not columns[name]["time_ns"]:
            progress.warn(
                f"sensor '{name}': no message on topic '{topic}' has field or joint '{field}' with a number; "
                f"joint '{machine.sensors[name].joint}' has no reading"
            )
    return columns


def _check_clocks(sources: dict[str, Columns], log_name: str, progress: Progress) -> None:
    """Refuse stamps of zero and clocks that were never set; warn of clocks that are far apart. Raises LogError."""
    middles = {}
    for name, rows in sources.items():
        time_ns = np.array(rows["time_ns"], np.int64)
        if not len(time_ns):
            continue
        unset = np.mean(time_ns <= 0)
        if unset > MAX_UNSTAMPED:
            raise LogError(
                f"{log_name}: {np.sum(time_ns <= 0)} of {len(time_ns)} messages of '{name}' carry no capture time "
                "(their stamp is zero), and the time of receipt is no substitute; "
                "let the driver fill in the message's timestamp"
            )
        middles[name] = int(np.median(time_ns[time_ns > 0]))
        if middles[name] < EARLIEST_NS:
            progress.warn(
                f"the clock of '{name}' was never set: its stamps say {_date(middles[name])}; "
                "dates are wrong, and of several tooth wears the latest is taken"
            )
    if middles:
        low, high = min(middles, key=middles.__getitem__), max(middles, key=middles.__getitem__)
        apart_s = (middles[high] - middles[low]) * 1e-9
        if apart_s > APART_S:
            progress.warn(
                f"the clocks of '{low}' and '{high}' are {apart_s:,.0f} s apart in the middle of the log; "
                "their data cannot be used together unless this is mended: set both clocks, or give time_offset_s"
            )


def _date(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _frame_table(cameras: dict[str, Columns]) -> tuple[dict[str, np.ndarray], dict[str, Stamps]]:
    parts, stamps = [], {}
    for name, rows in cameras.items():
        arrays = {key: np.array(values, np.int64) for key, values in rows.items()}
        stamps[name] = in_order(arrays["time_ns"], arrays["log_time_ns"])
        order = stamps[name].order
        parts.append(
            {
                "camera": np.full(len(order), name, object),
                "frame": np.arange(len(order), dtype=np.int32),
                "time_ns": arrays["time_ns"][order],
                "log_time_ns": arrays["log_time_ns"][order],
                "bytes": arrays["bytes"][order].astype(np.int32),
                "encoding": np.array(ENCODINGS, object)[arrays["encoding"][order]],
            }
        )
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}, stamps


def _sensor_table(sensors: dict[str, Columns]) -> tuple[dict[str, np.ndarray], dict[str, Stamps]]:
    names, times, raws, stamps = [np.zeros(0, object)], [np.zeros(0, np.int64)], [np.zeros(0)], {}
    for name, rows in sensors.items():
        time_ns = np.array(rows["time_ns"], np.int64)
        stamps[name] = in_order(time_ns, np.array(rows["log_time_ns"], np.int64))
        order = stamps[name].order
        names.append(np.full(len(order), name, object))
        times.append(time_ns[order])
        raws.append(np.array(rows["raw"], float)[order])
    columns = {"sensor": np.concatenate(names), "time_ns": np.concatenate(times), "raw": np.concatenate(raws)}
    return columns, stamps


def _span(frames: dict[str, np.ndarray], readings: dict[str, np.ndarray]) -> tuple[int, int]:
    """[start, end) of the capture stamps."""
    times = np.concatenate([frames["time_ns"], readings["time_ns"]])
    return int(times.min()), int(times.max()) + 1


def _warn_of_silence(
    frames: dict[str, np.ndarray],
    readings: dict[str, np.ndarray],
    machine: Machine,
    end_ns: int,
    progress: Progress,
) -> None:
    """Warn of cameras and sensors that end early, begin late or pause."""
    sources = [(f"camera '{name}'", frames["time_ns"][frames["camera"] == name]) for name in machine.cameras]
    sources += [
        (f"sensor '{name}'", readings["time_ns"][readings["sensor"] == name]) for name in machine.sensors
    ]
    start_ns = min((int(times[0]) for _, times in sources if len(times)), default=end_ns)
    for what, times in sources:
        if not len(times):
            continue
        before_s, after_s = (int(times[0]) - start_ns) * 1e-9, (end_ns - int(times[-1])) * 1e-9
        if after_s > SILENT_S:
            progress.warn(
                f"{what} stops {after_s:.1f} s before the end of the log, at {_date(int(times[-1]))}"
            )
        if before_s > SILENT_S:
            progress.warn(f"{what} begins {before_s:.1f} s after the start of the log")
        steps_s = np.diff(times) * 1e-9
        limit_s = max(GAP_S, 5 * float(np.median(steps_s))) if len(steps_s) else GAP_S
        if len(gaps := steps_s[steps_s > limit_s]):
            progress.warn(
                f"{what} pauses {len(gaps)} times, {gaps.sum():.1f} s in all, {gaps.max():.1f} s at most"
            )


def _warn_of_stamps(cameras: dict[str, Stamps], sensors: dict[str, Stamps], progress: Progress) -> None:
    for kind, sources in (("camera", cameras), ("sensor", sensors)):
        for name, stamps in sources.items():
            if stamps.zero:
                progress.warn(
                    f"{stamps.zero} messages of {kind} '{name}' carry no capture time and were left out"
                )
            if stamps.backwards:
                progress.warn(
                    f"the time stamps of {kind} '{name}' run backwards {stamps.backwards} times; they were sorted"
                )
            if stamps.repeated:
                progress.warn(
                    f"{stamps.repeated} messages of {kind} '{name}' repeat the stamp of another and were left out"
                )


def _stamp_facts(stamps: Stamps) -> dict[str, float]:
    return {
        "used": len(stamps.order),
        "backwards": stamps.backwards,
        "repeated": stamps.repeated,
        "zero": stamps.zero,
        "delay_s": stamps.delay_s,
        "spread_s": stamps.spread_s,
    }
