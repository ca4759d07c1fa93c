"""detect: tags found and followed through all frames; `detections/<camera>`."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from pipeline import tables
from pipeline.config.prints import described_tags
from pipeline.config.quantities import FAMILIES, dictionary_of, smallest_family
from pipeline.detection.acceptance import ACCEPTED, BIT_ERRORS, LOW_MARGIN, UNKNOWN_ID, KnownTags
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.boards import Board
from pipeline.detection.decode import decode_grey
from pipeline.detection.found import Found, sides_px
from pipeline.detection.prints import SURE_BITS, spare_bits
from pipeline.detection.slices import CORRUPT, LOST, SEARCHED, Search, given_up, read_piece
from pipeline.detection.spans import Slice, frames_of, slices_of
from pipeline.detection.stillness import Tag, warnings
from pipeline.detection.tally import Tally
from pipeline.detection.workers import search_slices
from pipeline.errors import DetectionError
from pipeline.logs.reader import read_log
from pipeline.stages.job import Counts, Job
from pipeline.stages.runner import Progress

NEARLY_ALL = 0.9
"""Part of a camera's frames that must be corrupt before the job is given up."""
PORTION_ROWS = 65_536
LOOKS = 12
"""Frames in which other families are looked for, when nothing at all was seen."""
OFTEN = 3
"""Sightings from which a tag that nothing describes is told of beside those that were never used."""
CERTAIN_MARGIN = 50.0
"""Decision margin that patterns of soil do not reach."""


def run(job: Job, progress: Progress) -> Counts:
    """Write `detections` of every camera. Raises DetectionError, LogError."""
    known = known_tags(job)
    cameras = job.read_json("log.json")["cameras"]
    topics = {name: camera["topic"] for name, camera in cameras.items()}
    sizes = {name: (camera["width"], camera["height"]) for name, camera in cameras.items()}
    slices = slices_of(job.read_table("frames"), topics, sizes, job.scratch)
    with read_log(job.log) as reader:
        contents = reader.contents
    intrinsics = {
        name: tuple(camera.intrinsics.vector().tolist())
        for name, camera in job.calibrated_machine().cameras.items()
        if camera.intrinsics is not None
    }
    search = Search(
        job.log, contents, tuple(sorted(known)), known, sizes, job.site.detection, intrinsics, boards(job)
    )
    in_all = sum(len(part.frame) for part in slices)
    search_slices(
        search,
        slices,
        job.workers,
        lambda part: progress.advance(len(part.frame)),
        # What compiling takes is no measure of the time that remains.
        lambda: progress.total(in_all, "frames"),
    )

    for part in given_up(slices):
        start, end = (datetime.fromtimestamp(int(t) / 1e9, UTC) for t in (part.time_ns[0], part.time_ns[-1]))
        progress.warn(
            f"camera '{part.camera}': its {len(part.frame)} frames from {start:%Y-%m-%d %H:%M:%S} to "
            f"{end:%H:%M:%S} UTC ended the process that searched them, twice, and were skipped"
        )

    tallies: dict[str, Tally] = {}
    frames: Counter[str] = Counter()
    status: Counter[str] = Counter()
    seen: Counter[tuple[str, int]] = Counter()
    for camera in topics:
        tally = tallies[camera] = _join(job, camera, [part for part in slices if part.camera == camera])
        _judge_pictures(camera, tally.frames, progress)
        frames.update(tally.frames)
        status.update(tally.status)
        seen.update(tally.unknown)
    if not status[ACCEPTED]:
        # What is followed as a covered tag may be a tag of a family that nobody described.
        others = _other_families(search, slices) if not seen else Counter()
        _refuse_without_markers(job, frames, status, seen + others, known)
    for camera, tally in tallies.items():
        if not tally.status[ACCEPTED]:
            progress.warn(f"camera '{camera}': not one marker was accepted in its frames")
        for sentence in warnings(camera, tally.stillness):
            progress.warn(sentence)
    _warn_of_ids(job, set().union(*(tally.accepted for tally in tallies.values())), seen, progress)
    job.write_json("detection.json", {"cameras": {name: tally.facts() for name, tally in tallies.items()}})
    return {
        "frames": dict(frames.most_common()),
        "tags accepted": {camera: tally.status[ACCEPTED] for camera, tally in tallies.items()},
        "tags rejected": {name: count for name, count in status.most_common() if name != ACCEPTED},
        "tags at rest": {camera: tally.stillness.at_rest for camera, tally in tallies.items()},
    }


def known_tags(job: Job) -> dict[str, frozenset[int]]:
    """Family -> ids that machine.toml and site.toml describe. Raises ConfigError where one is described twice."""
    ids: dict[str, set[int]] = {}
    for family, number in described_tags(job.machine, job.site):
        ids.setdefault(family, set()).add(number)
    return {family: frozenset(numbers) for family, numbers in sorted(ids.items())}


def boards(job: Job) -> tuple[Board, ...]:
    """The tags that machine.toml and site.toml say are printed together."""
    return tuple(
        Board(
            marker.family,
            tuple(tag.id for tag in marker.tags),
            tuple(tuple((float(x), float(y)) for x, y, _ in tag.corners()) for tag in marker.tags),
        )
        for marker in sorted(
            [*job.machine.markers.values(), *job.site.benchmarks.values()],
            key=lambda marker: (marker.family, [tag.id for tag in marker.tags]),
        )
    )


def _join(job: Job, camera: str, slices: Sequence[Slice]) -> Tally:
    """Put the pieces of a camera together and count what is in them."""
    tally = Tally(job.site.detection)
    kept: list[dict[str, np.ndarray]] = [tables.empty_columns("detections")]
    with job.table_writer("detections", part=camera) as writer:
        for number, part in enumerate(slices):
            piece = read_piece(part)
            kept.append(piece.columns)
            tally.add(piece.columns, piece.frames)
            last = number == len(slices) - 1
            if last or sum(len(columns["frame"]) for columns in kept) >= PORTION_ROWS:
                writer.write({name: np.concatenate([columns[name] for columns in kept]) for name in kept[0]})
                kept = [tables.empty_columns("detections")]
    return tally


def _judge_pictures(camera: str, frames: Counter[str], progress: Progress) -> None:
    total = sum(frames.values())
    for outcome, count in frames.items():
        if outcome in (SEARCHED, LOST) or not count:
            continue
        if count > NEARLY_ALL * total:
            raise DetectionError(
                f"camera '{camera}': {count} of {total} frames cannot be used ({outcome}); "
                "look at the recording with another viewer: the camera, its driver or the disk is at fault"
            )
        what = "are corrupt" if outcome == CORRUPT else f"cannot be used ({outcome})"
        progress.warn(f"camera '{camera}': {count} of {total} frames {what} and were skipped")


def _other_families(search: Search, slices: Sequence[Slice]) -> Counter[tuple[str, int]]:
    """Tags of families that nobody described, in a few frames: what a wrong family in the files looks like.

    Of each of ArUco's dictionaries only the largest is searched, which holds the others; the family that is told is
    the smallest that has all the ids seen. One search costs up to 0.1 s, all together some ten seconds.
    """
    largest = {dictionary_of(family): family for family in sorted(FAMILIES, key=FAMILIES.__getitem__)}
    finder = TagFinder(set(largest.values()) - set(search.families), search.settings)
    found: Counter[tuple[str, int]] = Counter()
    looks = 0
    with read_log(search.log, search.contents) as reader:
        for part in slices[:: max(1, -(-len(slices) // LOOKS))]:
            _, frame = next(frames_of(part, reader), (0, None))
            if frame is None:
                continue
            with contextlib.suppress(DetectionError):
                tags = finder.find(decode_grey(frame.data, frame.encoding, frame.width, frame.height))
                looks += 1
                found.update(_believable(tags))
    # Short codes stand in any texture: one quad in sixteen is a tag of DICT_4X4_1000.
    for family, tag_id in list(found):
        if spare_bits(family) < SURE_BITS and found[family, tag_id] < min(2, looks):
            del found[family, tag_id]
    ids: dict[str, list[int]] = {}
    for family, tag_id in found:
        ids.setdefault(family, []).append(tag_id)
    return Counter(
        {(smallest_family(family, ids[family]), tag_id): n for (family, tag_id), n in found.items()}
    )


def _believable(tags: Found) -> set[tuple[str, int]]:
    """Family and id of clean tags of high margin, of each place only the one with the longest code.

    A tag of 6 x 6 bits that is read as if it had 4 x 4 is sometimes a tag too.
    """
    sure = np.flatnonzero((tags.hamming == 0) & (tags.margin >= CERTAIN_MARGIN)).tolist()
    kept: list[int] = []
    for k in sorted(sure, key=lambda row: -spare_bits(str(tags.family[row]))):
        away = np.linalg.norm(tags.uv[kept].mean(axis=1) - tags.uv[k].mean(axis=0), axis=1)
        if np.all(away > sides_px(tags.uv[kept])):
            kept.append(k)
    return {(str(tags.family[k]), int(tags.tag_id[k])) for k in kept}


def _warn_of_ids(job: Job, accepted: set[Tag], unknown: Counter[Tag], progress: Progress) -> None:
    """Say which described tags were never used, where tags were seen that nothing describes: an id may be wrong."""
    seen = [tag for tag, count in sorted(unknown.items()) if count >= OFTEN]
    owner = described_tags(job.machine, job.site)
    lacking = [tag for tag in owner if tag not in accepted]
    if seen and lacking:
        never = ", ".join(f"{tag[1]} of '{owner[tag]}'" for tag in lacking[:12])
        progress.warn(
            f"never used: {_tags(lacking[:12])} ({never}); seen, and described by neither file: {_tags(seen[:12])}; "
            "if a tag of them is the other, correct its id or family"
        )


def _tags(tags: Sequence[Tag]) -> str:
    families: dict[str, list[int]] = {}
    for family, number in tags:
        families.setdefault(family, []).append(number)
    return "; ".join(f"{family} {_ids(sorted(numbers))}" for family, numbers in sorted(families.items()))


def _refuse_without_markers(
    job: Job,
    frames: Counter[str],
    status: Counter[str],
    seen: Counter[tuple[str, int]],
    known: KnownTags,
) -> None:
    expected = "; ".join(f"{family} {_ids(sorted(numbers))}" for family, numbers in known.items())
    where = f"{job.log.name}: in {frames[SEARCHED]} frames"
    if seen:
        found = _tags([tag for tag, _ in seen.most_common(40)])
        raise DetectionError(
            f"{where} only marker ids were seen that nothing describes: {found}; described are {expected}; "
            "correct the ids or the family in machine.toml and site.toml"
        )
    others = {name: count for name, count in status.items() if name not in (ACCEPTED, UNKNOWN_ID)}
    if others:
        reasons = ", ".join(f"{name} {count}" for name, count in sorted(others.items()))
        advice = "use larger or nearer markers"
        if set(others) & {LOW_MARGIN, BIT_ERRORS}:
            advice += ", or loosen detection.min_margin and detection.max_hamming in site.toml"
        else:
            advice += ", and uncover them"
        raise DetectionError(
            f"{where} no marker could be accepted ({reasons}); described are {expected}; {advice}"
        )
    raise DetectionError(
        f"{where} no marker was seen at all; described are {expected}; check the family, that the markers are in "
        "view and at least 16 px wide, light and focus"
    )


def _ids(numbers: Sequence[int]) -> str:
    shown = ", ".join(str(number) for number in numbers[:12])
    return f"id{'s' if len(numbers) > 1 else ''} {shown}{', ...' if len(numbers) > 12 else ''}"
