"""Where figures are kept: benchmarks/results/NAME.json, with the date and the class of machine."""

from __future__ import annotations

import dataclasses
import datetime
import json
import math
import os
import platform
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "results"


def machine_class() -> str:
    """Cores, architecture and Python, and nothing that names one machine."""
    return f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"


def keep_result(name: str, rows: list[Any], line: str) -> None:
    """Write the rows (dataclasses or dicts) and the closing line of a benchmark."""
    FOLDER.mkdir(exist_ok=True)
    plain = [
        dataclasses.asdict(row) if dataclasses.is_dataclass(row) and not isinstance(row, type) else row
        for row in rows
    ]
    result = {
        "date": datetime.date.today().isoformat(),
        "machine": machine_class(),
        "line": line,
        "rows": plain,
    }
    (FOLDER / f"{name}.json").write_text(
        json.dumps(_plain(result), indent=1, default=float) + "\n", encoding="utf-8"
    )


def kept_rows(name: str) -> list[dict[str, Any]]:
    """Rows of the last run that was kept; none where there is none."""
    file = FOLDER / f"{name}.json"
    return json.loads(file.read_text(encoding="utf-8"))["rows"] if file.is_file() else []


def _plain(value: Any) -> Any:
    """JSON has no NaN: null where there is no figure."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and math.isnan(value) else value
