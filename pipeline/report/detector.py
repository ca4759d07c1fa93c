"""What the detector rejected, and the scatter of corners while nothing moved, as tables and remarks."""

from __future__ import annotations

from collections import Counter
from typing import Any

from pipeline.report import numbers
from pipeline.report.inputs import ReportInputs
from pipeline.report.numbers import column
from pipeline.report.units import text_of
from pipeline.report.words import Words

RATIO_LOW, RATIO_HIGH = 0.5, 1.5
"""Scatter over prediction: beyond these, and by more than chance, it is said."""
PIXEL_DIGITS = 3
SCATTER = ("frames", "scatter_px", "predicted_px", "ratio", "ratio_low", "ratio_high", "lag1", "shake_px")
"""Fields of detection.json that both tables of scatter print as they are."""


def rejected(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    """Rejected tags: a row per reason with what it means, a column per camera; the most frequent first."""
    counts: dict[str, Counter[str]] = {}
    for camera in inputs.machine.cameras:
        found = inputs.detections.get(camera)
        counts[camera] = Counter(found["status"].tolist() if found else ())
        del counts[camera]["accepted"]
    whole: Counter[str] = sum(counts.values(), Counter())
    columns = [
        column("reason", words("columns.status")),
        *(column(f"count_{i}", camera, "", 0) for i, camera in enumerate(counts)),
        column("meaning", words("columns.meaning"), kind="why"),
    ]
    rows = []
    for reason in sorted(whole, key=lambda name: (-whole[name], name)):
        row: dict[str, Any] = {f"count_{i}": own[reason] for i, own in enumerate(counts.values())}
        known = words.has(f"reasons.{reason}")
        rows.append({"reason": reason, "meaning": words(f"reasons.{reason}") if known else "", **row})
    return numbers.table(columns, rows)


def scatter(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    """The scatter by camera and size class, and by tag; each None where nothing stood still long enough."""
    sizes, tags = [], []
    for camera, found in _pixel_noise(inputs):
        for one in found["sizes"]:
            shown = {name: one[name] for name in SCATTER}
            judged = words(f"detector.{judgement(one)}")
            row = {"camera": camera, "size": size_text(one, words), "tags": one["tags"], "judged": judged}
            sizes.append({**row, **shown})
        for one in found["tags"]:
            shown = {name: one[name] for name in (*SCATTER, "side_px")}
            tags.append({"camera": camera, "tag": f"{one['family']} {one['tag_id']}", **shown})
    frames = column("frames", words("columns.frames"), "", 0)
    last = column("shake_px", words("columns.shake"), "px", PIXEL_DIGITS)
    measured = [
        column("scatter_px", words("columns.scatter"), "px", PIXEL_DIGITS),
        column("predicted_px", words("columns.predicted"), "px", PIXEL_DIGITS),
        column("ratio", words("columns.ratio"), "", 2),
        column("ratio_low", words("columns.ratio_low"), "", 2),
        column("ratio_high", words("columns.ratio_high"), "", 2),
        column("lag1", words("columns.lag1"), "", 2),
    ]
    name = column("camera", words("columns.camera"))
    by_size = [
        name,
        column("size", words("columns.size")),
        frames,
        column("tags", words("columns.tags"), "", 0),
        *measured,
        column("judged", words("columns.judgement")),
        last,
    ]
    side = column("side_px", words("columns.side"), "px", 0)
    by_tag = [name, column("tag", words("columns.tag")), side, frames, *measured, last]
    return {
        "noise": numbers.table(by_size, sizes) if sizes else None,
        "tags": numbers.table(by_tag, tags) if tags else None,
    }


def points(inputs: ReportInputs) -> dict[str, list[tuple[float, float, float]]]:
    """Camera -> side, scatter and prediction of each of its tags, px; cameras without one are left out."""
    return {
        camera: [(one["side_px"], one["scatter_px"], one["predicted_px"]) for one in found["tags"]]
        for camera, found in _pixel_noise(inputs)
        if found["tags"]
    }


def judgement(found: dict[str, Any]) -> str:
    """``larger`` or ``smaller`` than predicted where that is sure, else ``near``."""
    if found["ratio_low"] > RATIO_HIGH:
        return "larger"
    return "smaller" if found["ratio_high"] < RATIO_LOW else "near"


def size_text(found: dict[str, Any], words: Words) -> str:
    """A size class in words."""
    low, high = f"{found['low_px']:g}", "" if found["high_px"] is None else f"{found['high_px']:g}"
    key = "size_above" if not high else "size_between" if found["low_px"] else "size_below"
    return words(f"detector.{key}", low=low, high=high)


def shaken(inputs: ReportInputs, words: Words) -> list[str]:
    """A sentence for each camera that shakes against tags which cannot move against it."""
    said = []
    for camera, found in _pixel_noise(inputs):
        rigid = _rigid(inputs, camera)
        own = [
            one
            for one in found["tags"]
            if (one["family"], one["tag_id"]) in rigid and one["shake_low"] > RATIO_HIGH
        ]
        if own:
            worst = max(own, key=lambda one: one["shake_ratio"])
            said.append(
                words(
                    "attention.shaken",
                    camera=camera,
                    tag=f"{worst['family']} {worst['tag_id']}",
                    shake=text_of(worst["shake_px"], PIXEL_DIGITS),
                    ratio=text_of(worst["shake_ratio"], 1),
                )
            )
    return said


def overstated(inputs: ReportInputs, words: Words) -> list[str]:
    """A sentence for each camera whose corners surely scatter less than half of what was predicted."""
    said = []
    for camera, found in _pixel_noise(inputs):
        low = [one for one in found["sizes"] if judgement(one) == "smaller"]
        if low:
            sizes = ", ".join(
                words("attention.size_ratio", size=size_text(one, words), ratio=text_of(one["ratio"], 2))
                for one in low
            )
            said.append(words("attention.overstated", camera=camera, sizes=sizes))
    return said


def _pixel_noise(inputs: ReportInputs) -> list[tuple[str, dict[str, Any]]]:
    cameras = inputs.detection.get("cameras") or {}
    return [(name, cameras[name]["pixel_noise"]) for name in inputs.machine.cameras if name in cameras]


def _rigid(inputs: ReportInputs, camera: str) -> set[tuple[str, int]]:
    """Tags that cannot move against a camera: on its own body, or both it and they on the ground."""
    machine = inputs.machine
    ground = {"world", *(name for name, body in machine.bodies.items() if body.kind == "static")}
    body = machine.cameras[camera].body
    mounted = [(marker.body, marker.family, marker.tags) for marker in machine.markers.values()]
    mounted += [("world", mark.family, mark.tags) for mark in inputs.site.benchmarks.values()]
    return {
        (family, tag.id)
        for where, family, tags in mounted
        if where == body or {where, body} <= ground
        for tag in tags
    }
