"""Is this log fit for a report? A look of a few seconds, before a run of an hour.

Reads the two descriptions, the files they name, the log's summary, and some frames and readings spread over the log.
What it does not see it cannot vouch for: a tag that shows in one frame of a thousand may be called unseen here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config import Machine, Site
from pipeline.errors import DetectionError, LogError, PipelineError, UsageError
from pipeline.preflight.files import file_findings
from pipeline.preflight.finding import Finding, Level
from pipeline.stages.job import Source, check_log_file, describe

if TYPE_CHECKING:
    from pipeline.logs.reader import Frame, LogReader, Sample

PLACES = 16
"""Places in the log that are looked at; at each, one frame per camera is searched for tags."""
MESSAGES_PER_PLACE = 5
CLOCKS_APART_S = 1.0
"""Two sources whose stamps differ by more against the recorder's clock are not on one clock."""


@dataclass
class Seen:
    """What the look at the log has gathered."""

    frames: dict[str, list[Frame]] = field(default_factory=dict)
    """Camera -> frames, in the order of the file."""
    samples: dict[str, list[Sample]] = field(default_factory=dict)
    places: dict[str, set[int]] = field(default_factory=dict)
    """Sensor -> at which places it had readings."""
    tags: list[tuple[str, str, int, np.ndarray, np.ndarray, int]] = field(default_factory=list)
    """camera, family, id, uv (4, 2), cov (4, 2, 2), time_ns of each accepted tag, described or not."""
    refused: Counter[tuple[str, int, str]] = field(default_factory=Counter)
    """Family, id and status of the others."""
    looked_at: dict[str, int] = field(default_factory=dict)
    """Camera -> frames searched."""


def examine(log: Path, machine: Path | None = None, site: Path | None = None) -> list[Finding]:
    """Everything found, in the order in which a run would stumble over it; a fault of the input is a finding.

    Raises UsageError when an option names no file.
    """
    findings: list[Finding] = []
    try:
        for finding in _look(log, machine, site):
            findings.append(finding)
    except UsageError:
        raise
    except PipelineError as error:
        findings += [Finding("error", line) for line in str(error).splitlines()]
    return findings


def _look(log: Path, machine_file: Path | None, site_file: Path | None) -> Iterator[Finding]:
    """Findings one by one; raises PipelineError where nothing more can be looked at."""
    from pipeline.logs.reader import read_log

    check_log_file(log)
    with read_log(log) as reader:
        yield from _log_findings(reader)
        machine, machine_source, site, site_source = describe(
            log, machine_file, site_file, reader.attachments()
        )
        for source in (machine_source, site_source):
            yield Finding("ok", f"{source.name}: read ({source.origin})")
        yield from file_findings(site, site_source)
        seen = Seen()
        yield from _topic_findings(reader, machine, seen)
        if seen.frames:
            machine = _with_calibrations(reader, machine, machine_source, log)
            yield from _frame_findings(machine, site, seen)
            yield from _sensor_findings(machine, seen)
            yield from _clock_findings(machine, seen)
            yield from _tag_findings(machine, site, seen)
            yield from _tie_findings(machine, site, seen)
        for (topic, reason), count in sorted(reader.faults.items()):
            yield Finding("warning", f"{count} messages on topic '{topic}' cannot be read: {reason}")


def _log_findings(reader: LogReader) -> Iterator[Finding]:
    span = reader.log_time_range
    if span is None:
        raise LogError(f"{reader.path}: no message can be read; the log is empty or damaged from its start")
    length_s = (span[1] - span[0]) * 1e-9
    megabytes = reader.contents.size / 1e6
    yield Finding("ok", f"{reader.path.name}: {length_s:,.1f} s, {megabytes:,.1f} MB")
    if not reader.recovery.complete:
        yield Finding("warning", f"{reader.recovery.sentence}; a report is made of what is there")


def _topic_findings(reader: LogReader, machine: Machine, seen: Seen) -> Iterator[Finding]:
    """Whether each topic of machine.toml is there; fills in what is seen at some places of the log."""
    span = reader.log_time_range
    assert span is not None
    counts = {channel.topic: channel.message_count for channel in reader.channels}
    for name, camera in machine.cameras.items():
        try:
            frames = list(_spread(reader, span, {name: camera.topic}))
        except LogError as error:
            yield Finding("error", str(error))
            continue
        if not frames:
            yield Finding("error", f"camera '{name}': no picture on topic '{camera.topic}' can be read")
            continue
        seen.frames[name] = frames
        count = counts[camera.topic]
        rate = count / max((span[1] - span[0]) * 1e-9, 1e-9)
        yield Finding("ok", f"camera '{name}': {count:,} frames on {camera.topic}, {rate:.1f} per second")
    for name, sensor in machine.sensors.items():
        wanted = {name: (sensor.topic, sensor.field)}
        try:
            places = [
                list(islice(reader.samples(wanted, *window), MESSAGES_PER_PLACE)) for window in _windows(span)
            ]
        except LogError as error:
            yield Finding("warning", f"{error}; joint '{sensor.joint}' would have no reading")
            continue
        seen.samples[name] = [sample for place in places for sample in place]
        seen.places[name] = {number for number, place in enumerate(places) if place}
        if not seen.samples[name]:
            yield Finding(
                "warning",
                f"sensor '{name}': no number in field or joint '{sensor.field}' on topic '{sensor.topic}'; "
                f"joint '{sensor.joint}' would have no reading: mend sensors.{name}.field",
            )
        else:
            yield Finding("ok", f"sensor '{name}': {counts[sensor.topic]:,} readings on {sensor.topic}")


def _windows(span: tuple[int, int]) -> list[tuple[int, int]]:
    """Places spread evenly over the log, as half-open spans of log_time that together cover it."""
    # In whole numbers: a float64 of nanoseconds since 1970 is a quarter of a microsecond coarse.
    length = span[1] + 1 - span[0]
    return list(pairwise(span[0] + length * number // PLACES for number in range(PLACES + 1)))


def _spread(reader: LogReader, span: tuple[int, int], topics: dict[str, str]) -> Iterator[Frame]:
    for window in _windows(span):
        yield from islice(reader.frames(topics, *window), MESSAGES_PER_PLACE)


def _with_calibrations(reader: LogReader, machine: Machine, source: Source, log: Path) -> Machine:
    from pipeline.stages.ingest import chosen_calibrations

    used = chosen_calibrations(machine, reader.calibrations(), reader.channels, log.name)
    return machine.with_calibrations(used, source.name)


def _frame_findings(machine: Machine, site: Site, seen: Seen) -> Iterator[Finding]:
    """Sizes of the pictures; searches one frame of each place for tags."""
    from pipeline.config.quantities import FAMILIES
    from pipeline.detection.acceptance import ACCEPTED, judge
    from pipeline.detection.apriltag import TagFinder
    from pipeline.detection.decode import decode_grey
    from pipeline.detection.refine import Refiner
    from pipeline.detection.seen import search

    families = {mark.family for mark in [*machine.markers.values(), *site.benchmarks.values()]}
    finder = TagFinder(families, site.detection)
    # Ids that nobody described are told below; here only whether the tag would be good enough.
    every_id = {family: frozenset(range(FAMILIES[family])) for family in families}
    for name, frames in seen.frames.items():
        intrinsics = machine.cameras[name].intrinsics
        assert intrinsics is not None
        corrupt, sizes = 0, set()
        expected = (intrinsics.width, intrinsics.height)
        refiner = Refiner(intrinsics.vector())
        for frame in frames[::MESSAGES_PER_PLACE]:
            try:
                grey = decode_grey(frame.data, frame.encoding, frame.width, frame.height)
            except DetectionError:
                corrupt += 1
                continue
            sizes.add((grey.shape[1], grey.shape[0]))
            # The lens of another size of picture is unknown.
            tags = search(grey, finder, refiner if grey.shape[::-1] == expected else Refiner())
            status = judge(tags, every_id, site.detection)
            seen.looked_at[name] = seen.looked_at.get(name, 0) + 1
            for k in range(len(tags)):
                family, tag_id = str(tags.family[k]), int(tags.tag_id[k])
                if status[k] == ACCEPTED:
                    cov = np.array([tags.cov[k, i : i + 2, i : i + 2] for i in (0, 2, 4, 6)])
                    seen.tags.append((name, family, tag_id, tags.uv[k], cov, frame.time_ns))
                else:
                    seen.refused[family, tag_id, str(status[k])] += 1
        if corrupt:
            level: Level = "warning" if sizes else "error"
            number = corrupt + seen.looked_at.get(name, 0)
            yield Finding(
                level,
                f"camera '{name}': {corrupt} of {number} pictures looked at are corrupt; "
                "check the cable and the recorder's disk",
            )
        for size in sorted(sizes - {expected}):
            yield Finding(
                "error",
                f"camera '{name}': pictures are {size[0]} x {size[1]}, its intrinsics are for {expected[0]} x "
                f"{expected[1]}; record in the size it was calibrated in, or calibrate it in this one",
            )
        if sizes == {expected}:
            yield Finding(
                "ok", f"camera '{name}': {expected[0]} x {expected[1]} pixels, as its intrinsics say"
            )


def _sensor_findings(machine: Machine, seen: Seen) -> Iterator[Finding]:
    """Readings outside the calibrated range, and sensors that stop."""
    for name, samples in seen.samples.items():
        limits = machine.sensors[name].curve.raw_range
        raw = np.array([sample.raw for sample in samples])
        if limits and len(raw) and (outside := np.mean((raw < limits[0]) | (raw > limits[1]))):
            yield Finding(
                "warning",
                f"sensor '{name}': {100 * outside:.0f} % of the readings looked at are outside its calibrated range "
                f"{limits[0]:g} to {limits[1]:g} ({raw.min():g} to {raw.max():g}); they would be dropped",
            )
        places = seen.places[name]
        if places and max(places) < PLACES - 2:
            part = 100 * (max(places) + 1) / PLACES
            yield Finding(
                "warning",
                f"sensor '{name}' stops after {part:.0f} % of the log; from there joint "
                f"'{machine.sensors[name].joint}' is known only where a camera sees it: check its cable",
            )


def _clock_findings(machine: Machine, seen: Seen) -> Iterator[Finding]:
    """Stamps that run backwards or are missing, and clocks that differ."""
    delays: dict[str, float] = {}
    amiss = False
    for kind, sources in (("camera", seen.frames), ("sensor", seen.samples)):
        for name, messages in sources.items():
            time_ns = np.array([message.time_ns for message in messages], np.int64)
            log_time_ns = np.array([message.log_time_ns for message in messages], np.int64)
            if not len(time_ns):
                continue
            if backwards := int(np.sum(np.diff(time_ns) < 0)):
                amiss = True
                yield Finding(
                    "warning",
                    f"{kind} '{name}': the stamps of {len(time_ns)} messages looked at run backwards {backwards} "
                    "times; they are sorted, but a clock that is set while it records spoils the motion: set it before",
                )
            if (unset := int(np.sum(time_ns <= 0))) > 0:
                amiss = True
                yield Finding(
                    "error" if unset > len(time_ns) / 2 else "warning",
                    f"{kind} '{name}': {unset} of {len(time_ns)} messages looked at carry no capture stamp; "
                    "let the driver fill in the message's timestamp",
                )
            delays[name] = float(np.median(log_time_ns - time_ns)) * 1e-9
    reference = float(np.median([delays[name] for name in seen.frames if name in delays]))
    for name, delay_s in delays.items():
        offset_s = machine.sensors[name].time_offset_s if name in machine.sensors else 0.0
        if abs(delay_s - reference - offset_s) > CLOCKS_APART_S:
            amiss = True
            yield Finding(
                "warning",
                f"the clock of '{name}' is {abs(delay_s - reference):,.1f} s "
                f"{'behind' if delay_s > reference else 'ahead of'} that of the cameras; "
                "set both clocks, or state the difference (sensors: time_offset_s)",
            )
    if not amiss:
        yield Finding("ok", "clocks: stamps ascend and agree with each other")


def _tag_findings(machine: Machine, site: Site, seen: Seen) -> Iterator[Finding]:
    """Tags seen against tags described."""
    owner: dict[tuple[str, int], str] = {}
    for name, mark in [*machine.markers.items(), *site.benchmarks.items()]:
        owner |= {(mark.family, tag.id): name for tag in mark.tags}
    frames = ", ".join(f"{number} of '{name}'" for name, number in seen.looked_at.items())
    known = [tag for tag in seen.tags if tag[1:3] in owner]
    unknown: dict[tuple[str, str, int], int] = {}
    for camera, family, tag_id, *_ in seen.tags:
        if (family, tag_id) not in owner:
            unknown[camera, family, tag_id] = unknown.get((camera, family, tag_id), 0) + 1
    for (camera, family, tag_id), number in sorted(unknown.items()):
        yield Finding(
            "warning",
            f"camera '{camera}' sees tag {tag_id} of {family} ({number} of {seen.looked_at[camera]} frames), which "
            "neither file describes; describe it, or ignore this if it is none of yours",
        )
    if not known:
        reasons: Counter[str] = Counter()
        for (family, tag_id, status), number in seen.refused.items():
            if (family, tag_id) in owner:
                reasons[status] += number
        if reasons:
            what = ", ".join(f"{status} {number}" for status, number in reasons.most_common())
            yield Finding(
                "error",
                f"described tags were found in the frames looked at ({frames}), and not one could be used: {what}; "
                "see docs/detector.md for what helps",
            )
            return
        yield Finding(
            "error",
            f"no described tag was found in the frames looked at ({frames}); check family and ids of the markers, "
            "their size in the picture (at least 20 px), focus and light",
        )
        return
    seen_marks = {owner[tag[1:3]] for tag in known}
    yield Finding(
        "ok", f"{len(known)} known tags in the frames looked at ({frames}): {', '.join(sorted(seen_marks))}"
    )
    for name in site.benchmarks:
        if name not in seen_marks:
            yield Finding(
                "warning",
                f"benchmark '{name}' is not in the frames looked at; check that a camera sees it, its family and ids",
            )
    for name in machine.markers:
        if name not in seen_marks:
            yield Finding(
                "warning",
                f"marker '{name}' on '{machine.markers[name].body}' is not in the frames looked at; "
                "check that a camera sees it, its family and ids",
            )


def _tie_findings(machine: Machine, site: Site, seen: Seen) -> Iterator[Finding]:
    """Whether what was seen ties every moving body to the survey."""
    from pipeline.errors import NetworkError
    from pipeline.network import Observations, Readings, network_of
    from pipeline.network.datum import tie

    network = network_of(machine, site)
    index = network.tag_index([tag[1] for tag in seen.tags], np.array([tag[2] for tag in seen.tags], int))
    rows = [(tag, k) for tag, k in zip(seen.tags, index.tolist(), strict=True) if k >= 0]
    if not rows:
        return
    observations = Observations(
        camera=np.array([network.camera_index(tag[0]) for tag, _ in rows]),
        tag=np.array([k for _, k in rows]),
        time_ns=np.array([tag[5] for tag, _ in rows], np.int64),
        uv=np.array([tag[3] for tag, _ in rows]),
        cov=np.array([tag[4] for tag, _ in rows]),
    )
    readings = {
        name: Readings(np.array([s.time_ns for s in samples], np.int64), np.array([s.raw for s in samples]))
        for name, samples in seen.samples.items()
    }
    try:
        tie(network, observations, readings)
    except NetworkError as error:
        yield Finding("warning", f"in the frames looked at, {error}")
        return
    moving = [name for name, body in machine.bodies.items() if body.kind != "static"]
    yield Finding("ok", f"datum: {', '.join(moving)} are tied to the survey")
    if untold := [static.name for static in network.statics if not static.surveyed]:
        yield Finding("ok", f"places that no file gives, for the log to tell: {', '.join(untold)}")
