"""The head of the page: verdict, what was surveyed, and six numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.report import numbers
from pipeline.report.inputs import ReportInputs, Table
from pipeline.report.palette import verdict_style
from pipeline.report.units import MISSING, Units, text_of
from pipeline.report.words import Words


def deviation_text(metres: float | None, units: Units, signed: bool = True, fine: bool = False) -> str:
    """A deviation with its unit, for a sentence; `fine` where a limit of 25.4 mm must not be printed as 25."""
    value = None if metres is None else float(units.to_deviation(metres))
    whole = value is None or abs(value - round(value, units.deviation_digits)) < 1e-6
    digits = units.fine_digits if fine and not whole else units.deviation_digits
    return f"{text_of(value, digits, signed)} {units.deviation}"


def station_text(metres: float, units: Units) -> str:
    """A station with its unit, for a sentence."""
    return f"{text_of(float(units.to_length(metres)), units.station_digits)} {units.length}"


def deviation_number(metres: Any, units: Units, signed: bool = True, fine: bool = False) -> numbers.Number:
    """A deviation or an uncertainty in its printed unit."""
    digits = units.fine_digits if fine else units.deviation_digits
    value = None if metres is None else units.to_deviation(metres)
    return numbers.number(value, units.deviation, digits, signed)


def verdict_of(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    """The job's verdict, its symbol and why."""
    found = inputs.survey.get("verdict")
    if isinstance(found, dict):
        word, reason = str(found.get("verdict") or found.get("word") or ""), str(found.get("reason") or "")
    else:
        word, reason = str(found or ""), str(inputs.survey.get("reason") or "")
    if not word:
        reason = words("page.not_available", why=inputs.why_missing("survey.json"))
    style = verdict_style(word)
    if not reason and words.has(f"verdicts.{style.word}"):
        reason = words(f"verdicts.{style.word}")
    return {"word": style.word, "symbol": style.symbol, "style": style.slug, "reason": reason}


def span_ns(inputs: ReportInputs) -> tuple[int, int] | None:
    """First and last instant of the log."""
    start, end = inputs.log_facts.get("start_ns"), inputs.log_facts.get("end_ns")
    if start is not None and end is not None:
        return int(start), int(end)
    frames = inputs.table("frames")
    return None if frames is None else (int(frames["time_ns"].min()), int(frames["time_ns"].max()))


def edge_gaps(inputs: ReportInputs, edge: Table, span: tuple[int, int]) -> np.ndarray:
    """(g, 2) spans of the log in which the cutting edge was not observed, nanoseconds."""
    middle = edge["point"] == "middle"
    longest_s = 2 * inputs.site.estimation.max_gap_s
    return gaps_of(edge["time_ns"][middle], edge["seen"][middle], span, longest_s)


def gaps_of(time_ns: np.ndarray, seen: np.ndarray, span: tuple[int, int], longest_s: float) -> np.ndarray:
    """Spans between observed instants in which the edge was bridged, or in which there is nothing at all.

    Parameters
    ----------
    time_ns, seen : (n,) arrays
        Epochs of the cutting edge.
    span : tuple of int
        First and last instant of the log: what lies before the first epoch and after the last one counts too.
    longest_s : float
        Epochs further apart than this leave a gap even where both are observed.

    Returns
    -------
    (g, 2) int array
        Nanoseconds.
    """
    order = np.argsort(time_ns, kind="stable")
    time_ns, seen = np.asarray(time_ns)[order], np.asarray(seen)[order].astype(bool)
    knots = np.concatenate([[span[0]], time_ns[seen], [span[1]]]).astype(np.int64)
    unseen = np.searchsorted(time_ns[~seen], knots)
    gap = (np.diff(knots) > longest_s * 1e9) | (np.diff(unseen) > 0)
    return np.stack([knots[:-1][gap], knots[1:][gap]], axis=1).reshape(-1, 2)


def surveyed(inputs: ReportInputs, units: Units, words: Words) -> list[dict[str, str]]:
    """Label and text of what was surveyed, in the order of the page's head."""
    site, machine = inputs.site, inputs.machine.machine
    rows = [("site", _named(site.site.name, site.site.id)), ("machine", _named(machine.name, machine.id))]
    rows.append(("log", inputs.log.name))
    if (span := span_ns(inputs)) is None:
        rows.append(("span_utc", words("page.not_available", why=inputs.why_missing("frames"))))
    else:
        length = numbers.duration_text((span[1] - span[0]) / 1e9)
        rows.append(("span_utc", f"{_span(*map(numbers.utc_text, span))} ({length})"))
        zone = site.report.time_zone
        local = [numbers.local_text(t, zone) for t in span] if zone else []
        if all(local) and local:
            rows.append(("span_local", f"{_span(str(local[0]), str(local[1]))}, {zone}"))
        else:
            rows.append(
                ("span_local", words("surveyed.unknown_zone" if zone else "surveyed.no_local", zone=zone))
            )
    tolerance = site.tolerance
    rows += [
        ("grid", f"{site.grid.name or words('page.unknown')}; {units.describe()}"),
        ("design", str(inputs.survey.get("design_name") or site.design.file)),
        (
            "tolerance",
            words(
                "surveyed.tolerance_text",
                high=deviation_text(tolerance.high_mm / 1000, units, fine=True),
                low=deviation_text(-tolerance.low_mm / 1000, units, fine=True),
                k=f"{tolerance.coverage_factor:g}",
            ),
        ),
    ]
    return [{"key": key, "label": words(f"surveyed.{key}"), "text": text} for key, text in rows]


def summary(
    inputs: ReportInputs, units: Units, words: Words, statistics: dict[str, numbers.Number] | None
) -> list[dict[str, Any]]:
    """Six numbers with a label and a note each; a number that is not there says why."""
    entries: list[tuple[str, numbers.Number, str]] = []
    missing = numbers.number(None)
    stations = inputs.table("stations")
    if stations is None:
        why = words("page.not_available", why=inputs.why_missing("stations"))
        entries += [(key, missing, why) for key in ("passed", "worst", "mean", "uncertainty")]
    else:
        entries += _of_stations(stations, inputs, units, words)
    if statistics is None:
        entries.append(("check", missing, words("summary.check_none")))
    else:
        n, bias = statistics["n"]["value"], statistics["bias"]
        note = words(
            "summary.check_note",
            n=n,
            bias=f"{text_of(bias['value'], bias['digits'], True)} {bias['unit']}",
        )
        entries.append(("check", statistics["rmse"], note))
    edge, span = inputs.table("cutting_edge"), span_ns(inputs)
    if edge is None or span is None:
        why = words("page.not_available", why=inputs.why_missing("cutting_edge"))
        entries.append(("tracked", missing, why))
    else:
        note = words("summary.tracked_note", duration=numbers.duration_text((span[1] - span[0]) / 1e9))
        gaps = edge_gaps(inputs, edge, span)
        share = 1 - float((gaps[:, 1] - gaps[:, 0]).sum()) / max(span[1] - span[0], 1)
        entries.append(("tracked", numbers.number(100 * share, "%", 1), note))
    return [
        {"key": key, "label": words(f"summary.{key}"), "number": value, "note": note}
        for key, value, note in entries
    ]


def _of_stations(stations, inputs: ReportInputs, units: Units, words: Words):
    verdict, deviation = stations["verdict"], stations["deviation"]
    dug = np.isfinite(deviation)
    tolerance = inputs.site.tolerance
    passed = numbers.number(int((verdict == "PASS").sum()))
    note = words("summary.passed_note", cut=int(dug.sum()), all=len(verdict))
    entries = [("passed", passed, note)]
    if not dug.any():
        missing = numbers.number(None)
        return entries + [(key, missing, MISSING) for key in ("worst", "mean", "uncertainty")]
    worst = int(np.nanargmax(np.abs(deviation)))
    side = words("summary.high" if deviation[worst] > 0 else "summary.low")
    note = words(
        "summary.worst_note",
        station=station_text(stations["station"][worst], units),
        u=deviation_text(stations["expanded_uncertainty"][worst], units, signed=False),
        side=side,
    )
    entries.append(("worst", deviation_number(deviation[worst], units), note))
    note = words(
        "summary.mean_note",
        n=int(dug.sum()),
        low=deviation_text(deviation[dug].min(), units),
        high=deviation_text(deviation[dug].max(), units),
    )
    entries.append(("mean", deviation_number(deviation[dug].mean(), units, fine=True), note))
    note = words(
        "summary.uncertainty_note",
        k=f"{tolerance.coverage_factor:g}",
        high=deviation_text(tolerance.high_mm / 1000, units, signed=False, fine=True),
        low=deviation_text(tolerance.low_mm / 1000, units, signed=False, fine=True),
    )
    median = float(np.median(stations["expanded_uncertainty"][dug]))
    entries.append(("uncertainty", deviation_number(median, units, signed=False, fine=True), note))
    return entries


def _named(name: str, identity: str) -> str:
    return f"{name} ({identity})" if name and name != identity else identity


def _span(start: str, end: str) -> str:
    """Two clock texts of the same day share their date and zone."""
    day, clock, zone = start.split(" ", 2)
    day_end, clock_end, zone_end = end.split(" ", 2)
    if (day, zone) == (day_end, zone_end):
        return f"{day} {clock} to {clock_end} {zone}"
    return f"{start} to {end}"
