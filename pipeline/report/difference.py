"""Two reports of one job held against each other, station by station: another day, or the same log calibrated anew.

Difference = B minus A. Its sigma is known between two bounds only. Of two logs the own parts are independent and add
up as squares. The common parts (benchmarks, mounts, lenses, sensor curve) are the same errors as far as the two runs
used the same of each, and how far that is a report cannot tell: wholly the same leaves only their difference, nothing
in common adds them as squares too. Two reports of one log saw the same pictures, so the same goes for their own parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.errors import ArtefactError
from pipeline.report.report_file import StationReport
from pipeline.report.units import text_of

COVERAGE = 2.0
"""Differences are held against this many sigmas, as deviations are."""
YES, NO, OPEN, UNKNOWN = "yes", "no", "open", ""
SHOWN_CHANGES = 30
DIGITS = 6
"""report.json keeps no more; stations are matched at this many digits."""


@dataclass(frozen=True)
class Difference:
    """B against A; arrays (n,) over the stations of either, by ascending station, in the unit of their deviations."""

    a: StationReport
    b: StationReport
    station: np.ndarray
    deviation_a: np.ndarray
    """nan where not reached; so are all below that hang on it."""
    deviation_b: np.ndarray
    difference: np.ndarray
    """B minus A."""
    sigma_shared: np.ndarray
    """Of the difference, if what can be shared is shared wholly: the lower bound."""
    sigma_apart: np.ndarray
    """If nothing is shared: the upper bound."""
    verdict_a: np.ndarray
    verdict_b: np.ndarray
    moved: np.ndarray
    """`yes` beyond `COVERAGE` sigmas whatever is shared, `no` within them, `open` where it hangs on what is shared."""

    @property
    def same_log(self) -> bool:
        """Whether both rest on the same recording."""
        return self.a.files.get("log", ("", "a"))[1] == self.b.files.get("log", ("", "b"))[1]


def compare_reports(a: StationReport, b: StationReport) -> Difference:
    """The difference of two reports of one job.

    Raises
    ------
    ArtefactError
        They are not of one job: says everything that keeps them apart.
    """
    if why := _why_not(a, b):
        raise ArtefactError(
            f"{a.source} and {b.source} cannot be compared station by station: {'; '.join(why)}"
        )
    number_a, number_b = (np.round(report.station, DIGITS) for report in (a, b))
    station = np.union1d(number_a, number_b)

    def placed(report: StationReport, number: np.ndarray, values: np.ndarray, missing: Any) -> np.ndarray:
        full = np.full(len(station), missing, dtype=values.dtype)
        full[np.searchsorted(station, number)] = values
        return full

    dev_a, own_a, common_a = (
        placed(a, number_a, v, np.nan) for v in (a.deviation, a.sigma_own, a.sigma_common)
    )
    dev_b, own_b, common_b = (
        placed(b, number_b, v, np.nan) for v in (b.deviation, b.sigma_own, b.sigma_common)
    )
    difference = dev_b - dev_a
    same = a.files.get("log", ("", "a"))[1] == b.files.get("log", ("", "b"))[1]
    own_least = own_b - own_a if same else np.hypot(own_a, own_b)
    shared = np.hypot(own_least, common_b - common_a)
    apart = np.sqrt(own_a**2 + own_b**2 + common_a**2 + common_b**2)
    size = np.abs(difference)
    moved = np.where(size > COVERAGE * apart, YES, np.where(size <= COVERAGE * shared, NO, OPEN))
    return Difference(
        a=a,
        b=b,
        station=station,
        deviation_a=dev_a,
        deviation_b=dev_b,
        difference=difference,
        sigma_shared=shared,
        sigma_apart=apart,
        verdict_a=placed(a, number_a, a.verdicts, ""),
        verdict_b=placed(b, number_b, b.verdicts, ""),
        moved=np.where(np.isfinite(difference) & np.isfinite(apart), moved, UNKNOWN).astype(object),
    )


def _why_not(a: StationReport, b: StationReport) -> list[str]:
    why = []
    if a.site != b.site:
        why.append(f"they are of two sites ('{a.site}' and '{b.site}')")
    if a.grid_unit != b.grid_unit or a.deviation_unit != b.deviation_unit:
        why.append(f"their grids are in two units ({a.grid_unit} and {b.grid_unit})")
    elif a.alignment != b.alignment:
        why.append("their stations run along two alignments")
    elif a.station_step != b.station_step:
        why.append(f"their stations are {a.station_step:g} and {b.station_step:g} {a.length} apart")
    (name_a, sha_a), (name_b, sha_b) = (report.files.get("design", ("none", "")) for report in (a, b))
    if sha_a != sha_b:
        why.append(
            f"their deviations are from two designs ({name_a}, sha256 {sha_a[:12] or 'none'}, and {name_b}, "
            f"{sha_b[:12] or 'none'}): run both with one design file"
        )
    return why


def statistics(found: Difference) -> dict[str, Any]:
    """n, mean, RMS and worst of the differences, and how many stations changed in which way."""
    both = np.flatnonzero(np.isfinite(found.difference))
    d = found.difference[both]
    worst = both[int(np.argmax(np.abs(d)))] if len(both) else None
    reached_a, reached_b = np.isfinite(found.deviation_a), np.isfinite(found.deviation_b)
    told = (found.verdict_a != "") & (found.verdict_b != "")
    return {
        "n": len(both),
        "mean": _plain(d.mean()) if len(both) else None,
        "rms": _plain(np.sqrt(np.mean(d**2))) if len(both) else None,
        "worst": None if worst is None else _plain(found.difference[worst]),
        "worst_station": None if worst is None else _plain(found.station[worst]),
        "only_a": int(np.count_nonzero(reached_a & ~reached_b)),
        "only_b": int(np.count_nonzero(reached_b & ~reached_a)),
        "moved": {word: int(np.count_nonzero(found.moved == word)) for word in (YES, OPEN, NO)},
        "verdicts_changed": int(np.count_nonzero(told & (found.verdict_a != found.verdict_b))),
    }


def changes(found: Difference) -> list[dict[str, str]]:
    """What is different in what the two reports rest on: files, versions, settings; the same is not listed."""
    a, b = found.a, found.b
    rows = []
    for key in dict.fromkeys([*a.files, *b.files]):
        (name_a, sha_a), (name_b, sha_b) = a.files.get(key, ("none", "")), b.files.get(key, ("none", ""))
        if sha_a != sha_b:
            rows.append((key, f"{name_a} {sha_a[:12]}".strip(), f"{name_b} {sha_b[:12]}".strip()))
    for kind, of_a, of_b in (("version", a.versions, b.versions), ("setting", a.settings, b.settings)):
        for key in sorted({*of_a, *of_b}):
            if of_a.get(key) != of_b.get(key):
                rows.append((f"{kind} {key}", of_a.get(key, "not there"), of_b.get(key, "not there")))
    return [{"what": what, "a": left, "b": right} for what, left, right in rows]


def sigma_sentence(found: Difference) -> str:
    """What the two sigmas of a difference are, in words for this pair."""
    if found.same_log:
        return (
            "Sigma of the difference: both reports rest on one log, so their errors are largely the same and how far "
            "cannot be told; from all of them shared to none."
        )
    return (
        "Sigma of the difference: the own parts are independent; the common parts (benchmarks, mounts, lenses, sensor "
        "curve) are shared as far as the two runs used the same, which cannot be told; from wholly shared to not at "
        "all. A difference may also be ground that was dug in between."
    )


def as_dict(found: Difference) -> dict[str, Any]:
    """Everything, for machines; lengths and deviations in the units that it names."""
    rows = zip(
        found.station, found.deviation_a, found.deviation_b, found.difference, found.sigma_shared,
        found.sigma_apart, found.moved, found.verdict_a, found.verdict_b, strict=True,
    )  # fmt: skip
    keys = ("station", "deviation_a", "deviation_b", "difference", "sigma_shared", "sigma_apart")
    return {
        "format": "gradetrace/difference/1",
        "a": {"source": found.a.source, "verdict": found.a.verdict},
        "b": {"source": found.b.source, "verdict": found.b.verdict},
        "units": {"length": found.a.length, "deviation": found.a.deviation_unit},
        "same_log": found.same_log,
        "sigma": sigma_sentence(found),
        "coverage_factor": COVERAGE,
        "statistics": statistics(found),
        "changes": changes(found),
        "stations": [
            {key: _plain(value) for key, value in zip(keys, row[:6])}
            | {"moved": row[6], "verdict_a": row[7], "verdict_b": row[8]}
            for row in rows
        ],
    }


def table_of(found: Difference) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Head and rows for people: every station that one of the two reached."""
    a = found.a
    fall, fine = a.deviation_unit, a.fine_digits
    head = (
        f"station {a.length}", f"A {fall}", f"B {fall}", f"B - A {fall}", f"sigma {fall}",
        f"beyond {COVERAGE:g} sigma", "verdict",
    )  # fmt: skip
    rows = []
    for i in np.flatnonzero(np.isfinite(found.deviation_a) | np.isfinite(found.deviation_b)):
        values = (found.deviation_a[i], found.deviation_b[i], found.difference[i])
        least, most = (text_of(float(s[i]), fine) for s in (found.sigma_shared, found.sigma_apart))
        old, new = str(found.verdict_a[i]), str(found.verdict_b[i])
        rows.append(
            (
                text_of(float(found.station[i]), 2),
                *(text_of(float(value), fine, signed=True) for value in values),
                f"{least} to {most}" if found.moved[i] else least,
                str(found.moved[i]),
                new if old == new else f"{old or 'no station'} -> {new or 'no station'}",
            )
        )
    # Numbers stand under each other by their last digit.
    width = [max(len(row[k]) for row in [head, *rows]) for k in range(4)]
    return head, [(*(cell.rjust(width[k]) for k, cell in enumerate(row[:4])), *row[4:]) for row in rows]


def sentences(found: Difference) -> list[str]:
    """The statistics and what differs, a line each."""
    told, fall, fine = statistics(found), found.a.deviation_unit, found.a.fine_digits
    lines = []
    if told["n"]:
        mean, rms, worst = (text_of(told[key], fine, key != "rms") for key in ("mean", "rms", "worst"))
        lines.append(
            f"B - A over {told['n']} stations that both reached: mean {mean} {fall}, RMS {rms} {fall}, worst {worst} "
            f"{fall} at station {text_of(told['worst_station'], 2)}"
        )
        moved = told["moved"]
        lines.append(
            f"beyond {COVERAGE:g} sigma: {moved[YES]} stations whatever is shared, {moved[OPEN]} only if enough is "
            f"shared (open), {moved[NO]} not"
        )
    else:
        lines.append("no station was reached by both: there is nothing to compare")
    lines.append(f"reached by A alone: {told['only_a']}, by B alone: {told['only_b']}")
    lines.append(
        f"verdicts that changed: {told['verdicts_changed']}; of the job: {found.a.verdict} -> {found.b.verdict}"
    )
    lines.append(sigma_sentence(found))
    different = changes(found)
    lines += [f"different: {row['what']}: {row['a']} -> {row['b']}" for row in different[:SHOWN_CHANGES]]
    if len(different) > SHOWN_CHANGES:
        lines.append(f"different: {len(different) - SHOWN_CHANGES} more; --json lists them all")
    if not different:
        lines.append("different: nothing; the two rest on the same files, versions and settings")
    return lines


def _plain(value: float) -> float | None:
    return round(float(value), DIGITS) + 0.0 if np.isfinite(value) else None
