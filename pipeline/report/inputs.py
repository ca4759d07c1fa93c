"""What a page is made of: the artefacts of one run, read whole, and why some of them are not there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.config import Machine, Site
from pipeline.report.moments import Moment
from pipeline.surface.alignment import Alignment
from pipeline.surface.design import Design
from pipeline.surface.utilities import Buried

Table = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class FileSource:
    """A file the run rests on."""

    name: str
    origin: str
    """Where it came from: a path as the user wrote it, or ``attachment of the log``."""
    sha256: str


@dataclass(frozen=True)
class View:
    """What one camera saw when the floor of one of the worst stations was made."""

    stations: tuple[float, ...]
    """Metres; several where one frame is the nearest to the moments of several."""
    camera: str
    time_ns: int
    """Capture stamp of the frame; the moment itself where there is none."""
    width: int = 0
    """Pixels of the camera's own picture, in which corners are given."""
    height: int = 0
    jpeg: bytes = b""
    """The picture, shrunk; empty where `why` tells why."""
    why: str = ""
    tags: Table = field(default_factory=dict)
    """One row per tag found in the frame: tag, marker, status (all text), uv and predicted (n, 4, 2) px, normalised
    (n,) the largest of its corners, and weight (n,) the least; NaN in the last three where the adjustment has none."""


@dataclass(frozen=True)
class ReportInputs:
    """One run's artefacts. Tables are column name -> array, in metres, radians and nanoseconds."""

    machine: Machine
    site: Site
    log: FileSource
    machine_file: FileSource
    site_file: FileSource
    named_files: Mapping[str, FileSource] = field(default_factory=dict)
    """Files that site.toml names: ``design``, ``checks``, ``utilities.<name>``."""
    alignment: Alignment | None = None
    """The line that stations run along, grid metres."""
    design: Design | None = None
    """The design, to draw it beside what was dug."""
    utilities: tuple[Buried, ...] = ()
    """What is buried, to draw it."""
    tables: Mapping[str, Table] = field(default_factory=dict)
    """By table name: frames, sensors, residuals, statics, cutting_edge, as_built, stations, station_budgets, sides,
    volumes, checks, utilities."""
    detections: Mapping[str, Table] = field(default_factory=dict)
    """By camera; columns time_ns, tag_id and status."""
    moments: Sequence[Moment] = ()
    """When the floor of the worst stations was made."""
    views: Sequence[View] = ()
    """Pictures of those moments."""
    log_facts: Mapping[str, Any] = field(default_factory=dict)
    """log.json."""
    detection: Mapping[str, Any] = field(default_factory=dict)
    """detection.json."""
    solution: Mapping[str, Any] = field(default_factory=dict)
    """solution.json."""
    survey: Mapping[str, Any] = field(default_factory=dict)
    """survey.json."""
    manifests: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """By stage, in the order of the stages."""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Artefact -> why it is not there, one sentence."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """gradetrace, python and libraries -> version."""

    def table(self, name: str) -> Table | None:
        """A table with at least one row, or None."""
        found = self.tables.get(name)
        return found if found is not None and rows_of(found) else None

    def why_missing(self, name: str) -> str:
        """One sentence for the page where an artefact has nothing to show."""
        if name in self.missing:
            return self.missing[name]
        return (
            f"the table {name} has no rows" if name in self.tables else f"{name} was not written by this run"
        )


def rows_of(table: Table) -> int:
    """Rows of a table."""
    return len(next(iter(table.values()))) if table else 0
