"""report.json read back, as far as a comparison needs it. The file may come from anywhere: bounded and checked."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import ArtefactError
from pipeline.report.units import UNIT_NAMES

FORMAT = "gradetrace/report/1"
MAX_BYTES = 100_000_000
"""A shift's report.json has 1 MB."""
MAX_STATIONS = 200_000
MAX_TEXT = 300
MAX_SETTINGS = 100_000
VERDICTS = ("PASS", "FAIL", "CANNOT TELL", "NOT REACHED")


@dataclass(frozen=True)
class StationReport:
    """What one report says station by station, in its own units; arrays (n,), by ascending station."""

    source: str
    """The file as the user named it."""
    verdict: str
    """Of the job."""
    length: str
    """Unit of stations."""
    deviation_unit: str
    deviation_digits: int
    fine_digits: int
    site: str
    grid_unit: str
    station_step: float
    alignment: dict[str, Any] | None
    station: np.ndarray
    deviation: np.ndarray
    """nan where not reached, as in the three below."""
    sigma_own: np.ndarray
    sigma_common: np.ndarray
    verdicts: np.ndarray
    files: dict[str, tuple[str, str]]
    """Log, machine.toml, site.toml, design, checks -> name and sha256."""
    versions: dict[str, str]
    """Of the program, its libraries and its stages."""
    settings: dict[str, str]
    """Dotted key -> value as JSON text."""


def read_report(path: Path) -> StationReport:
    """The report of a run folder or of a report.json.

    Raises
    ------
    ArtefactError
        No such file, no report, or one that lacks what a comparison needs; one sentence.
    """
    file = path / "report.json" if path.is_dir() else path
    content = _load(file)
    reader = _Reader(str(file))
    if reader.text(content, "format") != FORMAT:
        raise ArtefactError(f"{file}: is no report.json of gradetrace ('{FORMAT}' is expected as its format)")
    if "identity" not in content:
        raise ArtefactError(
            f"{file}: was written by a version that kept too little for a comparison; run 'gradetrace report' again"
        )
    units, job = reader.group(content, "units"), reader.group(content, "identity")
    length, fall = reader.one_of(units, "length", UNIT_NAMES), reader.one_of(units, "deviation", UNIT_NAMES)
    columns, rows = _stations(reader, content)
    files = {
        key: (reader.text(entry, "name"), reader.text(entry, "sha256"))
        for key, entry in reader.groups(job, "files").items()
    }
    return StationReport(
        source=str(path),
        verdict=reader.one_of(reader.group(content, "verdict"), "word", VERDICTS),
        length=length,
        deviation_unit=fall,
        deviation_digits=_digits(columns, "deviation"),
        fine_digits=_digits(columns, "sigma_own"),
        site=reader.text(job, "site"),
        grid_unit=reader.text(job, "grid_unit"),
        station_step=reader.number(job, "station_step"),
        alignment=_alignment(reader, job),
        files=files,
        versions=_versions(reader, job),
        settings=_flat(reader, content.get("settings") or {}),
        **rows,
    )


def _versions(reader: _Reader, job: dict[str, Any]) -> dict[str, str]:
    stages = {f"of stage {name}": version for name, version in reader.group(job, "stages").items()}
    return {reader.clean(k): reader.clean(v) for k, v in (reader.group(job, "versions") | stages).items()}


def _load(file: Path) -> dict[str, Any]:
    try:
        size = file.stat().st_size
        if size > MAX_BYTES:
            raise ArtefactError(
                f"{file}: {size / 1e6:.0f} MB, at most {MAX_BYTES / 1e6:.0f} MB are read; name a report.json"
            )
        with file.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
        content = json.loads(data.decode("utf-8"), parse_constant=_refuse)
    except FileNotFoundError:
        raise ArtefactError(
            f"{file}: no such file; name a run folder (runs/LOG) or its report.json, made by 'gradetrace report'"
        ) from None
    except OSError as error:
        raise ArtefactError(f"{file}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise ArtefactError(f"{file}: is no JSON; name a run folder or its report.json") from None
    if not isinstance(content, dict):
        raise ArtefactError(f"{file}: is no report.json of gradetrace")
    return content


def _refuse(word: str) -> float:
    raise ValueError(word)


class _Reader:
    """Takes fields out of JSON with a sentence for each that is not what it must be."""

    def __init__(self, source: str):
        self.source = source

    def text(self, entry: dict[str, Any], key: str) -> str:
        value = entry.get(key)
        if not isinstance(value, str):
            raise self.wrong(key, "a text", value)
        return self.clean(value)

    def one_of(self, entry: dict[str, Any], key: str, allowed: Any) -> str:
        value = self.text(entry, key)
        if value not in allowed:
            raise self.wrong(key, " or ".join(allowed), value)
        return value

    def number(self, entry: dict[str, Any], key: str) -> float:
        value = entry.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
            raise self.wrong(key, "a number", value)
        return float(value)

    def group(self, entry: dict[str, Any], key: str) -> dict[str, Any]:
        value = entry.get(key)
        if not isinstance(value, dict):
            raise self.wrong(key, "an object", value)
        return value

    def groups(self, entry: dict[str, Any], key: str) -> dict[str, dict[str, Any]]:
        found = self.group(entry, key)
        return {self.clean(name): self.group(found, name) for name in found}

    def items(self, entry: dict[str, Any], key: str, most: int) -> list[dict[str, Any]]:
        value = entry.get(key)
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.wrong(key, "a list of objects", value)
        if len(value) > most:
            raise ArtefactError(f"{self.source}: {len(value)} entries under '{key}', at most {most} are read")
        return value

    def clean(self, value: Any) -> str:
        """Text for a terminal: no control characters, and no more of it than anybody reads."""
        return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in str(value)[:MAX_TEXT])

    def wrong(self, key: str, expected: str, value: Any) -> ArtefactError:
        """The sentence for a field that is not what it must be."""
        found = self.clean(json.dumps(value))[:60]
        return ArtefactError(
            f"{self.source}: {key}: expected {expected}, found {found}; run 'gradetrace report' again to make it"
        )


def _stations(reader: _Reader, content: dict[str, Any]) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    main = reader.group(content, "stations")
    columns, rows = reader.items(main, "columns", 100), reader.items(main, "rows", MAX_STATIONS)
    if content.get("stations_beyond") is not None:
        rows = rows + reader.items(reader.group(content, "stations_beyond"), "rows", MAX_STATIONS)
    station = np.array([reader.number(row, "station") for row in rows])
    order = np.argsort(station, kind="stable")
    if len(station) != len(np.unique(station)):
        raise ArtefactError(
            f"{reader.source}: a station stands there twice; run 'gradetrace report' again to make it"
        )
    values = {
        key: np.array([math.nan if row.get(key) is None else reader.number(row, key) for row in rows])[order]
        for key in ("deviation", "sigma_own", "sigma_common")
    }
    if any(np.any(values[key] < 0) for key in ("sigma_own", "sigma_common")):
        raise ArtefactError(f"{reader.source}: a negative sigma; run 'gradetrace report' again to make it")
    verdicts = np.array([reader.one_of(row, "verdict", VERDICTS) for row in rows], dtype=object)[order]
    return columns, {"station": station[order], "verdicts": verdicts, **values}


def _digits(columns: list[dict[str, Any]], key: str) -> int:
    for column in columns:
        if column.get("key") == key and isinstance(column.get("digits"), int):
            return min(max(int(column["digits"]), 0), 9)
    return 1


def _alignment(reader: _Reader, job: dict[str, Any]) -> dict[str, Any] | None:
    if job.get("alignment") is None:
        return None
    found = reader.group(job, "alignment")
    ends = {key: reader.number(found, key) for key in ("start_station", "end_station")}
    for key in ("start", "end"):
        place = found.get(key)
        if not isinstance(place, list) or len(place) != 2:
            raise reader.wrong(key, "two numbers", place)
        ends |= {f"{key}_{i}": reader.number({"x": x}, "x") for i, x in enumerate(place)}
    return ends


def _flat(reader: _Reader, tree: Any) -> dict[str, str]:
    """Dotted key -> value as JSON text; lists of plain values stay whole."""
    found: dict[str, str] = {}
    # Our own stack: the depth of the file is not ours.
    waiting: list[tuple[str, Any]] = [("", tree)]
    while waiting:
        key, value = waiting.pop()
        if isinstance(value, dict):
            waiting += [(f"{key}.{name}" if key else str(name), item) for name, item in value.items()]
        elif isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
            waiting += [(f"{key}[{i}]", item) for i, item in enumerate(value)]
        else:
            found[reader.clean(key)] = reader.clean(json.dumps(value, ensure_ascii=False))
        if len(found) + len(waiting) > MAX_SETTINGS:
            raise ArtefactError(
                f"{reader.source}: more than {MAX_SETTINGS} settings; this is no sound report.json"
            )
    return found
