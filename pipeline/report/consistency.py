"""How a log agrees with itself: changes in time, benchmarks left out, odd against even frames, classes, worst tags."""

from __future__ import annotations

from typing import Any

from pipeline.report import numbers
from pipeline.report.detector import size_text
from pipeline.report.inputs import ReportInputs
from pipeline.report.numbers import column
from pipeline.report.units import text_of
from pipeline.report.words import Words

Part = dict[str, Any] | None


def consistency(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    """Sentences and tables of solution.json's own checks; a table is None where the adjustment made none."""
    changes = inputs.solution.get("changes") or {}
    found = changes.get("found") or []
    return {
        "changes_sentence": _sentence(changes, words),
        "changes": _changes(found, words) if found else None,
        "halves": _halves(inputs.solution.get("odd_even") or {}, words),
        "left_out": _left_out(inputs.solution.get("left_out") or {}, words),
        "classes": _classes(inputs.solution.get("classes") or [], words),
        "worst": _worst(inputs.solution.get("worst") or [], words),
    }


def _sentence(changes: dict[str, Any], words: Words) -> str:
    if not changes:
        return ""
    if changes.get("why"):
        return words("consistency.changes_why", why=changes["why"])
    if changes["instants"] < changes["needed"]:
        return words("consistency.changes_short")
    key = "changes_found" if changes["found"] else "changes_none"
    return words(f"consistency.{key}", n=len(changes["found"]), tested=len(changes["tested"]))


def _changes(found: list[dict[str, Any]], words: Words) -> Part:
    columns = [
        column("static", words("columns.quantity"), kind="id"),
        column("or", words("consistency.or")),
        column("amount", words("consistency.amount")),
        column("from", words("columns.start")),
        column("to", words("columns.end")),
        column("inflation", words("consistency.inflation"), "", 1),
    ]
    rows = [
        {
            "static": one["static"],
            "or": ", ".join(one["or"]) or "–",
            "amount": ", ".join(amount["text"] for amount in one["amounts"]),
            "from": numbers.utc_text(one["from_ns"], 1)[11:-4],
            "to": numbers.utc_text(one["to_ns"], 1)[11:-4],
            "inflation": one["inflation"],
        }
        for one in found
    ]
    return numbers.table(columns, rows)


def _halves(found: dict[str, Any], words: Words) -> str:
    if not found:
        return ""
    low, high = found["ratio_95"]
    judged = "larger" if found["ratio"] > high else "smaller" if found["ratio"] < low else "near"
    return words(
        f"consistency.halves_{judged}",
        observed=text_of(found["observed_mm"], 1),
        predicted=text_of(found["predicted_mm"], 1),
        low=text_of(low * found["predicted_mm"], 1),
        high=text_of(high * found["predicted_mm"], 1),
    )


def _left_out(found: dict[str, Any], words: Words) -> Part:
    if not found:
        return None
    axes = ("easting", "northing", "elevation")
    columns = [column("benchmark", words("consistency.benchmark"))]
    for axis in axes:
        columns.append(column(axis, words(f"consistency.{axis}"), "mm", 1, signed=True))
        columns.append(column(f"sigma_{axis}", words("columns.sigma"), "mm", 1))
    columns.append(column("normalised", words("consistency.sigmas"), "", 1))
    columns.append(column("why", words("columns.judgement"), kind="why"))
    rows: list[dict[str, Any]] = []
    for name, one in found.items():
        row: dict[str, Any] = {
            "benchmark": name,
            "normalised": one.get("normalised"),
            "why": one.get("why", ""),
        }
        row["why"] = row["why"] or words("consistency.off" if one["off"] else "consistency.fits")
        for i, axis in enumerate(axes):
            row[axis] = one["difference_mm"][i] if "difference_mm" in one else None
            row[f"sigma_{axis}"] = one["sigma_mm"][i] if "sigma_mm" in one else None
        rows.append(row)
    return numbers.table(columns, rows)


def _classes(found: list[dict[str, Any]], words: Words) -> Part:
    if not found:
        return None
    columns = [
        column("source", words("consistency.source")),
        column("size", words("columns.size")),
        column("measurements", words("consistency.measurements"), "", 0),
        column("redundancy", words("consistency.redundancy"), "", 2),
        column("rms_normalised", words("consistency.rms_normalised"), "", 2),
        column("beyond_3_percent", words("columns.beyond"), "%", 2),
        column("down_weighted_percent", words("consistency.below_full"), "%", 1),
    ]
    rows = []
    for one in found:
        size = size_text(one, words) if one["class"] == "corners" else words("consistency.reading")
        rows.append({**{c["key"]: one.get(c["key"]) for c in columns}, "size": size})
    return numbers.table(columns, rows)


def _worst(found: list[dict[str, Any]], words: Words) -> Part:
    if not found:
        return None
    columns = [
        column("time", words("consistency.time")),
        column("camera", words("columns.camera")),
        column("marker", words("columns.marker")),
        column("tag_id", words("columns.tag"), "", 0),
        column("side_px", words("columns.side"), "px", 0),
        column("normalised", words("consistency.normalised"), "", 1),
        column("redundancy", words("consistency.redundancy"), "", 2),
        column("weight", words("consistency.weight"), "", 2),
    ]
    rows = [
        {**{c["key"]: one.get(c["key"]) for c in columns}, "time": numbers.utc_text(one["time_ns"], 1)[11:-4]}
        for one in found
    ]
    return numbers.table(columns, rows)
