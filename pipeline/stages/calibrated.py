"""What a calibration leaves: values in machine.toml or site.toml, the old file beside it, and a sheet.

All of it or nothing: the new text is loaded and validated before anything is written, the old file is kept before it is
replaced, and the sheet comes first, so that no value stands in a file without the page that tells how good it is.
"""

from __future__ import annotations

import datetime
import os
import stat
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import Machine, Site, load_machine, load_site
from pipeline.config.document import decode, read_file
from pipeline.config.quantities import calibrated_in
from pipeline.config.rewriting import with_values
from pipeline.errors import ArtefactError, CalibrationError
from pipeline.geometry import so3
from pipeline.report.sheet import Demand, Sheet, render_sheet
from pipeline.runs import atomic_write, json_bytes, sha256_of_file

LOADERS: dict[str, Callable[[str, str], Any]] = {"machine": load_machine, "site": load_site}


@dataclass(frozen=True)
class Written:
    """What a calibration left."""

    sentence: str
    """Whether it is good enough, in one line."""
    remarks: tuple[str, ...]
    sheet: Path
    file: Path | None
    """With the new values; None where there is only the sheet."""
    kept: Path | None
    """The file as it was."""


def demand_of(site: Site, distance_m: float) -> Demand:
    """What a job asks of a calibration whose part of the machine is so far from the cutting edge."""
    tolerance = site.tolerance
    return Demand(min(tolerance.high_mm, tolerance.low_mm) / 1000, tolerance.coverage_factor, distance_m)


def provenance(
    date: datetime.date, by: str, source: Path | None, sha256: str = "", **more: Any
) -> dict[str, Any]:
    """A `calibrated` table (`config.quantities.Calibrated`): what told the value, and when it was recorded."""
    if source is not None and not sha256:
        sha256 = sha256_of_file(source) if source.is_file() else ""
    named = "" if source is None else source.name
    return {"date": date, "by": by, "source": named, "sha256": sha256, **more}


def pose_table(T: np.ndarray, covariance: np.ndarray | None, stamp: Mapping[str, Any]) -> dict[str, Any]:
    """A pose as machine.toml has it; without covariance it is exact: it says where its parent begins."""
    table: dict[str, Any] = {"xyz_m": T[:3, 3], "rpy_deg": so3.to_rpy_deg(T[:3, :3])}
    if covariance is None:
        table |= {"sigma_mm": 0.0, "sigma_deg": 0.0}
    else:
        table["covariance"] = written_covariance(covariance)
    return {**table, "calibrated": dict(stamp)}


def written_covariance(covariance: np.ndarray) -> np.ndarray:
    """A covariance as it goes into a file: symmetric, without what is only rounding."""
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    even = 0.5 * (covariance + covariance.T)
    return np.where(np.abs(even) > 1e-9 * np.outer(sigma, sigma), even, 0.0)


def lens_table(
    size: tuple[int, int], intrinsics: np.ndarray, covariance: np.ndarray, stamp: Mapping[str, Any]
) -> dict[str, Any]:
    """Intrinsics (9,) with their covariance as machine.toml has them."""
    return {
        "width": size[0],
        "height": size[1],
        **dict(zip(("fx", "fy", "cx", "cy"), intrinsics[:4].tolist(), strict=True)),
        "distortion": intrinsics[4:],
        "covariance": covariance,
        "calibrated": stamp,
    }


def refuse_read_only(file: Path) -> None:
    """Raise ArtefactError where values could not be put into a file, before any work is done for them."""
    if file.is_file() and not file.stat().st_mode & 0o222:
        raise ArtefactError(
            f"{file} is read-only, and values would be put into it; make it writable, or name a copy"
        )
    if not os.access(file.parent, os.W_OK):
        raise ArtefactError(
            f"{file.parent} cannot be written to, and {file.name} would be replaced there with the old one beside it; "
            "make the folder writable, or name a copy"
        )


def refuse_twice(machine: Machine, log_sha256: str, anew: Collection[str]) -> None:
    """Raise CalibrationError where a log told something of the file already that now is a prior of the same log.

    Calibrated twice with one log, a bucket's U fell from 4.8 to 3.9 mm by nothing.

    Parameters
    ----------
    machine : Machine
        As loaded.
    log_sha256 : str
        Of the log.
    anew : collection of str
        Keys of what is told without its prior.
    """
    twice = [k for k, told in calibrated_in(machine) if told.sha256 == log_sha256 and k not in anew]
    if twice:
        raise CalibrationError(
            f"{', '.join(twice)} of machine.toml was told by this very log, which would count twice; go on from the "
            "file as it was before (machine.before-*.toml, put back or named with --machine), or record another log"
        )


def put_into(file: Path, kind: str, values: Mapping[str, Any], sheet: Sheet, page: Path) -> Path:
    """Set values in a machine.toml or site.toml, with their sheet; where the old one is kept.

    Parameters
    ----------
    file : Path
        The file.
    kind : str
        `machine` or `site`.
    values : mapping
        Dotted key -> value, as `config.rewriting.with_values` takes them.
    sheet, page : Sheet, Path
        What tells how good they are, and where it goes.

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
    put_sheet(sheet, page)
    before = file.stat()
    changed = datetime.datetime.fromtimestamp(before.st_mtime, datetime.UTC).date().isoformat()
    number = 1
    while (kept := file.with_name(f"{file.stem}.before-{changed}-{number}{file.suffix}")).exists():
        number += 1
    atomic_write(kept, old)
    atomic_write(file, text.encode("utf-8"))
    file.chmod(stat.S_IMODE(before.st_mode))
    return kept


def put_sheet(sheet: Sheet, file: Path, language: str = "en") -> None:
    """Write a sheet as HTML, and as JSON beside it."""
    html, content = render_sheet(sheet, language)
    atomic_write(file.with_suffix(".json"), json_bytes(content))
    atomic_write(file, html.encode("utf-8"))
