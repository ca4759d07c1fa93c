"""`gradetrace calibrate history`: dated machine files beside each other."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Sequence
from pathlib import Path

from pipeline.calibration.drift import Change, history
from pipeline.config import load_machine
from pipeline.config.document import decode, read_file
from pipeline.errors import CalibrationError
from pipeline.report.history_sheet import history_sheet
from pipeline.stages.calibrated import put_sheet

MOVED_SIGMAS = 3.0
OLD_DAYS = 180


def run(
    files: Sequence[Path],
    today: datetime.date,
    distance_m: float,
    old_days: int = OLD_DAYS,
    page: Path | None = None,
) -> tuple[list[tuple[str, ...]], list[str]]:
    """Rows of a table (quantity, date, by, sigmas, mm at the edge, age) and sentences about what needs attention.

    The sheet goes to `page`, where one is named.

    Raises
    ------
    PipelineError
        A file cannot be read, or they are of different machines.
    """
    ordered = _oldest_first(files)
    texts = [read_file(file) for file in ordered]
    machines = [
        load_machine(decode(text, str(file)), str(file)) for text, file in zip(texts, ordered, strict=True)
    ]
    if len({m.machine.id for m in machines}) > 1:
        raise CalibrationError(
            "the files are of different machines: " + ", ".join(sorted({m.machine.id for m in machines}))
        )
    found = history(machines, today, distance_m)
    dates = [c.date for changes in found.values() for c in changes if c.date is not None]
    if dates and today < max(dates):
        raise CalibrationError(
            f"on {today.isoformat()}, against which ages are to be counted, the latest calibration "
            f"({max(dates).isoformat()}) was not made yet; give --today a later day"
        )
    rows = [_row(change) for changes in found.values() for change in changes]
    sentences = []
    if len(set(texts)) == 1:
        sentences.append("there is one file only, so nothing can be told to have moved: name older ones too")
    for key, changes in found.items():
        for change in changes[1:]:
            if change.sigmas is not None and change.sigmas > MOVED_SIGMAS:
                edge = "" if change.edge_mm is None else f", {change.edge_mm:.1f} mm at the cutting edge"
                sentences.append(
                    f"{key} moved by {change.sigmas:.1f} sigma{edge} until {_day(change.date)}: it was knocked, or one "
                    "of the two calibrations is wrong; calibrate it again before the next job"
                )
        last = changes[-1]
        if last.age_days is not None and last.age_days > old_days:
            sentences.append(
                f"{key} was calibrated {last.age_days} days ago (limit {old_days}): calibrate it again"
            )
    undated = [key for key, changes in found.items() if changes[-1].date is None]
    if undated:
        sentences.append(f"of {', '.join(undated)} the file does not say when it was calibrated")
    if page is not None:
        origin = {
            f.name: f"sha256 {hashlib.sha256(text).hexdigest()[:12]}"
            for f, text in zip(ordered, texts, strict=True)
        }
        machine = machines[-1].machine
        put_sheet(
            history_sheet(found, sentences, distance_m, today, machine.name or machine.id, origin), page
        )
    return rows, sentences


def _oldest_first(files: Sequence[Path]) -> list[Path]:
    """Files as they followed each other: machine.before-DAY-N.toml by day and number, the one in use last."""

    def key(file: Path) -> tuple[int, str, int, str]:
        _, before, rest = file.stem.partition(".before-")
        if not before:
            return 1, "", 0, file.name
        day, _, number = rest.rpartition("-")
        return 0, day, int(number) if number.isdigit() else 0, file.name

    return sorted(files, key=key)


def _row(change: Change) -> tuple[str, ...]:
    return (
        change.key,
        _day(change.date),
        change.by or "-",
        "-" if change.sigmas is None else f"{change.sigmas:.1f}",
        "-" if change.edge_mm is None else f"{change.edge_mm:.1f}",
        "-" if change.age_days is None else str(change.age_days),
    )


def _day(date: datetime.date | None) -> str:
    return "no date" if date is None else date.isoformat()
