"""What the answer rests on, as tables: error budget, coverage over time, residuals, calibrated quantities."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.report import numbers
from pipeline.report.facts import edge_gaps, span_ns
from pipeline.report.idle import idle_spans
from pipeline.report.inputs import ReportInputs, Table
from pipeline.report.numbers import column, number
from pipeline.report.units import Units
from pipeline.report.words import Words

MAX_BINS = 240
MAX_TABLE_BINS = 40
MAX_GAPS = 20
STATICS_SHOWN = 10
MOVED_SIGMAS = 3.0
"""A static that the log moved further than this, in its own prior sigmas, is worth a look."""
FAR = 3.0
"""Length of a whitened corner residual, of two components, that 1 in 90 corners passes by chance."""
HISTOGRAM_EDGES = np.arange(0.0, 5.01, 0.25)


@dataclass(frozen=True)
class Timeline:
    """Tags seen and gaps over the log."""

    edges_s: np.ndarray
    """(n + 1,) seconds from the start of the log."""
    frames: dict[str, np.ndarray]
    """Camera -> (n,) frames per bin."""
    accepted: dict[str, np.ndarray]
    """Camera -> (n,) accepted tags per bin."""
    gaps_ns: np.ndarray
    """(g, 2) spans in which the cutting edge was not observed."""
    idle_ns: np.ndarray
    """(s, 2) spans in which it stood still."""
    start_ns: int

    @property
    def bridged_s(self) -> float:
        """Seconds of all gaps."""
        return float((self.gaps_ns[:, 1] - self.gaps_ns[:, 0]).sum() / 1e9)

    @property
    def idle_s(self) -> float:
        """Seconds of all spans in which it stood still."""
        return float((self.idle_ns[:, 1] - self.idle_ns[:, 0]).sum() / 1e9)


def timeline_of(inputs: ReportInputs, bins: int = MAX_BINS) -> Timeline | None:
    """The timeline in at most `bins` equal bins of at least a second, or None without frames."""
    frames, span = inputs.table("frames"), span_ns(inputs)
    if frames is None or span is None:
        return None
    start, end = span
    seconds = max((end - start) / 1e9, 1e-3)
    edges = np.linspace(0.0, seconds, max(1, min(bins, int(seconds))) + 1)
    seen_frames, accepted = {}, {}
    for camera in inputs.machine.cameras:
        own = frames["camera"] == camera
        seen_frames[camera] = _count((frames["time_ns"][own] - start) / 1e9, edges)
        found = inputs.detections.get(camera)
        times = found["time_ns"][found["status"] == "accepted"] if found else np.zeros(0, np.int64)
        accepted[camera] = _count((times - start) / 1e9, edges)
    edge = inputs.table("cutting_edge")
    gaps = idle = np.zeros((0, 2), np.int64)
    if edge is not None:
        gaps, idle = edge_gaps(inputs, edge, span), idle_spans(edge, start)
    return Timeline(edges, seen_frames, accepted, gaps, idle, start)


def _count(seconds: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.histogram(np.clip(seconds, edges[0], edges[-1]), edges)[0]


def coverage(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    """Tables of the coverage section: by camera, gaps, over time."""
    per_camera = []
    frames = inputs.table("frames")
    for camera in inputs.machine.cameras:
        count = 0 if frames is None else int((frames["camera"] == camera).sum())
        found = inputs.detections.get(camera)
        status = found["status"] if found else np.zeros(0, object)
        good = status == "accepted"
        with_tag = len(np.unique(found["time_ns"][good])) if found else 0
        per_camera.append(
            {
                "camera": camera,
                "frames": count,
                "frames_with": with_tag,
                "share": 100.0 * with_tag / count if count else None,
                "accepted": int(good.sum()),
                "rejected": int((~good).sum()),
            }
        )
    cameras = [
        column("camera", words("columns.camera")),
        column("frames", words("columns.frames"), "", 0),
        column("frames_with", words("columns.frames_with"), "", 0),
        column("share", words("columns.frames_with"), "%", 1),
        column("accepted", words("columns.accepted"), "", 0),
        column("rejected", words("columns.rejected"), "", 0),
    ]
    return {
        "cameras": numbers.table(cameras, per_camera),
        **_gaps_and_time(inputs, words),
    }


def _gaps_and_time(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    coarse = timeline_of(inputs, MAX_TABLE_BINS)
    if coarse is None:
        names = ("gaps", "gap_count", "bridged", "idle", "idle_count", "idle_total", "time")
        return dict.fromkeys(names)
    columns = [column("start", words("columns.start"))]
    rows: list[dict[str, Any]] = [
        {"start": numbers.utc_text(coarse.start_ns + int(t * 1e9))[11:-4]} for t in coarse.edges_s[:-1]
    ]
    for i, camera in enumerate(coarse.frames):
        columns.append(column(f"frames_{i}", f"{camera}: {words('columns.frames')}", "", 0))
        columns.append(column(f"tags_{i}", f"{camera}: {words('columns.tags_per_frame')}", "", 2))
        for row, count, tags in zip(rows, coarse.frames[camera], coarse.accepted[camera]):
            row[f"frames_{i}"] = int(count)
            row[f"tags_{i}"] = tags / count if count else None
    return {
        "gaps": _longest(coarse.gaps_ns, words),
        "gap_count": number(len(coarse.gaps_ns)),
        "bridged": number(coarse.bridged_s, "s", 1),
        "idle": _longest(coarse.idle_ns, words),
        "idle_count": number(len(coarse.idle_ns)),
        "idle_total": number(coarse.idle_s, "s", 1),
        "time": numbers.table(columns, rows),
    }


def _longest(spans_ns: np.ndarray, words: Words) -> dict[str, Any]:
    """The longest spans in the order of time."""
    longest = sorted(spans_ns.tolist(), key=lambda span: span[0] - span[1])[:MAX_GAPS]
    rows = [
        {
            "start": numbers.utc_text(start, 1)[11:-4],
            "end": numbers.utc_text(end, 1)[11:-4],
            "seconds": (end - start) / 1e9,
        }
        for start, end in sorted(longest)
    ]
    columns = [
        column("start", words("columns.start")),
        column("end", words("columns.end")),
        column("seconds", words("columns.seconds"), "s", 1),
    ]
    return numbers.table(columns, rows)


def residual_histogram(inputs: ReportInputs) -> tuple[np.ndarray, np.ndarray] | None:
    """Observed and expected share per bin of HISTOGRAM_EDGES (the last bin takes all beyond), in per cent.

    The length of a whitened residual with two components is Rayleigh distributed: P(> r) = exp(-r²/2).
    """
    residuals = inputs.table("residuals")
    if residuals is None:
        return None
    found = np.histogram(np.minimum(residuals["normalised"], HISTOGRAM_EDGES[-1] - 1e-9), HISTOGRAM_EDGES)[0]
    survival = np.exp(-0.5 * HISTOGRAM_EDGES**2)
    survival[-1] = 0.0
    return 100.0 * found / found.sum(), -100.0 * np.diff(survival)


def quality(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    """Figures of the internal consistency: a few numbers, a table by marker, the histogram's data."""
    residuals = inputs.table("residuals")
    figures: list[tuple[str, numbers.Number]] = []
    test = inputs.solution.get("global_test") or {}
    figures += [
        ("sigma0_squared", number(test.get("sigma0_squared"), "", 2)),
        ("redundancy", number(test.get("redundancy"), "", 0)),
        ("iterations", number(inputs.solution.get("iterations"), "", 0)),
    ]
    if residuals is None:
        return {"numbers": _labelled(figures, words), "test": "", "markers": None, "histogram": None}
    length, weight = residuals["normalised"], residuals["weight"]
    figures += [
        ("corners", number(len(length))),
        ("rms", number(_root_mean_square(length[weight > 0]), "", 2)),
        ("beyond", number(100.0 * float(np.mean(length > FAR)), "%", 1)),
        ("downweighted", number(100.0 * float(np.mean(weight < 0.5)), "%", 1)),
    ]
    columns = [
        column("marker", words("columns.marker")),
        column("camera", words("columns.camera")),
        column("corners", words("columns.corners"), "", 0),
        column("rms_px", words("columns.rms_px"), "px", 3),
        column("mean_square", words("columns.mean_square"), "", 2),
        column("beyond", words("columns.beyond"), "%", 1),
        column("downweighted", words("columns.downweighted"), "%", 1),
    ]
    rows = []
    # A shift has ten million corners: comparing with each of a few names is ten times faster than sorting strings.
    camera_rows = {name: residuals["camera"] == name for name in sorted(set(residuals["camera"].tolist()))}
    for marker in sorted(set(residuals["marker"].tolist())):
        of_marker = residuals["marker"] == marker
        for camera, of_camera in camera_rows.items():
            own = of_marker & of_camera
            if own.any():
                rows.append(_marker_row(residuals, own, marker, camera))
    observed, expected = residual_histogram(inputs) or (np.zeros(0), np.zeros(0))
    bins = [
        column("bin", words("columns.bin")),
        column("observed", words("columns.observed"), "%", 1),
        column("expected", words("columns.expected"), "%", 1),
    ]
    last = len(observed) - 1
    names = [
        f"{low:.2f} to {high:.2f}" if i < last else f"{low:.2f} and more"
        for i, (low, high) in enumerate(pairwise(HISTOGRAM_EDGES))
    ]
    histogram = numbers.records({"bin": names, "observed": observed, "expected": expected})
    return {
        "numbers": _labelled(figures, words),
        "test": _global_test(inputs, words),
        "markers": numbers.table(columns, rows),
        "histogram": numbers.table(bins, histogram),
    }


def _marker_row(residuals: Table, own: np.ndarray, marker: str, camera: str) -> dict[str, Any]:
    used = (
        residuals["weight"][own] > 0
    )  # what was rejected as gross is counted, and tells nothing about the rest
    length = residuals["normalised"][own]
    pixels = np.hypot(residuals["residual_u"][own], residuals["residual_v"][own])
    return {
        "marker": marker,
        "camera": camera,
        "corners": int(own.sum()),
        "rms_px": _root_mean_square(pixels[used]),
        "mean_square": _root_mean_square(length[used]),
        "beyond": 100.0 * float(np.mean(length > FAR)),
        "downweighted": 100.0 * float(np.mean(residuals["weight"][own] < 0.5)),
    }


def _root_mean_square(length: np.ndarray) -> float:
    """Per component of two, of lengths; nan where there are none."""
    return float(np.sqrt(np.mean(length**2) / 2)) if len(length) else float("nan")


def _global_test(inputs: ReportInputs, words: Words) -> str:
    """The global test in words, or an empty string where the adjustment made none."""
    test = inputs.solution.get("global_test") or {}
    if test.get("passed") is None or not test.get("bounds_95"):
        return ""
    low, high = (f"{bound:.3f}" for bound in test["bounds_95"])
    side = "yes" if test["passed"] else "low" if test["sigma0_squared"] < test["bounds_95"][0] else "high"
    return words(f"quality.passed_{side}", low=low, high=high)


def _labelled(figures: list[tuple[str, numbers.Number]], words: Words) -> list[dict[str, Any]]:
    return [{"key": key, "label": words(f"quality.{key}"), "number": value} for key, value in figures]


def error_budget(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Standard deviation of the cutting edge's elevation by source, the largest first, and their whole."""
    parts = budget_parts(inputs, words)
    if not parts:
        return None
    total = sum(sigma**2 for _, sigma in parts)
    columns = [
        column("source", words("columns.source")),
        column("sigma", words("columns.sigma"), units.deviation, units.fine_digits),
        column("share", words("columns.share"), "%", 0),
    ]
    rows = [
        {
            "source": source,
            "sigma": units.to_deviation(sigma),
            "share": 100 * sigma**2 / total if total else None,
        }
        for source, sigma in parts
    ]
    return numbers.table(columns, rows)


def budget_by_station(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Each station's common error in elevation by source: where a better survey or calibration would help there."""
    found = inputs.table("station_budgets")
    if found is None or len(found["station"]) == 0:
        return None
    sources = list(dict.fromkeys(found["source"].tolist()))
    sigma = found["sigma"].reshape(-1, len(sources))
    shown = [k for k in range(len(sources)) if np.any(sigma[:, k] > 0)]
    columns = [
        column("station", words("columns.station"), units.length, units.station_digits),
        *(
            column(
                sources[k],
                words(f"sources.{sources[k]}") if words.has(f"sources.{sources[k]}") else sources[k],
                units.deviation,
                units.fine_digits,
            )
            for k in shown
        ),
    ]
    rows = [
        {"station": units.to_length(station)} | {sources[k]: units.to_deviation(sigma[i, k]) for k in shown}
        for i, station in enumerate(found["station"][:: len(sources)])
    ]
    return numbers.table(columns, rows)


def budget_by_class(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """The same by what the machine was doing: a row per class of epochs with its sigma and that of each source.

    The last column is the time over which the own part stays the same error.
    """
    found = inputs.solution.get("error_budget_by_class") or {}
    if not found:
        return None
    lasting = inputs.solution.get("correlation_time_s") or {}
    sources = [s for s in next(iter(found.values())) if s not in ("epochs", "sigma")]
    columns = [
        column("class", words("columns.class")),
        column("epochs", words("columns.epochs"), "", 0),
        column("sigma", words("columns.sigma"), units.deviation, units.fine_digits),
        *(
            column(
                s,
                words(f"sources.{s}") if words.has(f"sources.{s}") else s,
                units.deviation,
                units.fine_digits,
            )
            for s in sources
        ),
        column("lasts", words("columns.lasts"), "s", 2),
    ]
    rows = [
        {
            "class": words(f"classes.{name}"),
            "epochs": parts["epochs"],
            "sigma": units.to_deviation(parts["sigma"]),
            "lasts": lasting.get(name),
        }
        | {s: units.to_deviation(parts[s]) for s in sources}
        for name, parts in found.items()
    ]
    return numbers.table(columns, rows)


def budget_parts(inputs: ReportInputs, words: Words) -> list[tuple[str, float]]:
    """Source and sigma in metres, the largest first."""
    found = inputs.solution.get("error_budget") or {}
    parts = [
        (words(f"sources.{source}") if words.has(f"sources.{source}") else str(source), float(sigma))
        for source, sigma in found.items()
        if isinstance(sigma, (int, float))
    ]
    return sorted(parts, key=lambda part: (-part[1], part[0]))


def statics(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    """All statics, the most moved first, in the unit that the table states; ten in sight, the rest folded away."""
    found = inputs.table("statics")
    if found is None:
        return {"statics": None, "statics_rest": None}
    columns = [
        column("quantity", words("columns.quantity"), kind="id"),
        column("component", words("columns.component")),
        column("source", words("columns.source")),
        column("file_value", words("columns.file_value"), "", 6, signed=False),
        column("value", words("columns.value"), "", 6),
        column("unit", words("columns.unit")),
        column("prior_sigma", words("columns.prior_sigma"), "", 6),
        column("sigma", words("columns.sigma"), "", 6),
        column("shift", words("columns.shift"), "", 2, signed=True),
    ]
    order = np.argsort(-np.abs(np.nan_to_num(found["shift_sigmas"])), kind="stable")
    names = ("quantity", "component", "source", "file_value", "value", "unit", "prior_sigma", "sigma")
    shown = {name: found[name][order] for name in names} | {"shift": found["shift_sigmas"][order]}
    rows = numbers.records(shown)
    rest = numbers.table(columns, rows[STATICS_SHOWN:]) if len(rows) > STATICS_SHOWN else None
    return {"statics": numbers.table(columns, rows[:STATICS_SHOWN]), "statics_rest": rest}
