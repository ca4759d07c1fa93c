"""What a calibration leaves: values in machine.toml or site.toml, the old file beside it, and a sheet.

All of it or nothing: the new text is loaded and validated before anything is written, the old file is kept before it is
replaced, and the sheet comes first, so that no value stands in a file without the page that tells how good it is.
"""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pipeline.config import load_machine, load_site
from pipeline.config.document import decode, read_file
from pipeline.config.rewriting import with_values
from pipeline.report.sheet import Sheet, render_sheet
from pipeline.runs import atomic_write, json_bytes

LOADERS: dict[str, Callable[[str, str], Any]] = {"machine": load_machine, "site": load_site}


def provenance(
    date: datetime.date, by: str, source: Path | None, sha256: str = "", **more: Any
) -> dict[str, Any]:
    """A `calibrated` table (`config.quantities.Calibrated`): what told the value, and when it was recorded."""
    if source is not None and not sha256:
        sha256 = hashlib.sha256(source.read_bytes()).hexdigest() if source.is_file() else ""
    named = "" if source is None else source.name
    return {"date": date, "by": by, "source": named, "sha256": sha256, **more}


def put_into(file: Path, kind: str, values: Mapping[str, Any]) -> Path:
    """Set values in a machine.toml or site.toml; where the old one is kept.

    Parameters
    ----------
    file : Path
        The file.
    kind : str
        `machine` or `site`.
    values : mapping
        Dotted key -> value, as `config.rewriting.with_values` takes them.

    Returns
    -------
    Path
        ``machine.before-<date>-<n>.toml`` beside it; dated as it was last changed.

    Raises
    ------
    ConfigError
        The file is wrong, or would be with these values; nothing is written then.
    ArtefactError
        It cannot be written.
    """
    old = read_file(file)
    text = with_values(decode(old, str(file)), str(file), values)
    LOADERS[kind](text, str(file))
    changed = datetime.datetime.fromtimestamp(file.stat().st_mtime, datetime.UTC).date().isoformat()
    number = 1
    while (kept := file.with_name(f"{file.stem}.before-{changed}-{number}{file.suffix}")).exists():
        number += 1
    atomic_write(kept, old)
    atomic_write(file, text.encode("utf-8"))
    return kept


def put_sheet(sheet: Sheet, file: Path, language: str = "en") -> None:
    """Write a sheet as HTML, and as JSON beside it."""
    html, content = render_sheet(sheet, language)
    atomic_write(file.with_suffix(".json"), json_bytes(content))
    atomic_write(file, html.encode("utf-8"))
