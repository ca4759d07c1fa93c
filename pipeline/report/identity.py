"""What tells whether two reports can be compared, and what differs: the job and its settings, for `gradetrace diff`.

Not printed: the page says the same in its head and its provenance, in words that change with the language.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.report.inputs import FileSource, ReportInputs
from pipeline.report.numbers import plain
from pipeline.report.units import Units


def identity(inputs: ReportInputs, units: Units) -> dict[str, Any]:
    """Site, unit, design, axis and step of the stations, and every file by its hash; lengths in the page's unit."""
    line = inputs.alignment
    alignment = None
    if line is not None:
        ends = line.points(np.array([line.start_station, line.end_station]), 0.0)
        alignment = {
            "start_station": _length(line.start_station, units),
            "end_station": _length(line.end_station, units),
            "start": [_length(x, units) for x in ends[0]],
            "end": [_length(x, units) for x in ends[1]],
        }
    return {
        "site": inputs.site.site.id,
        "machine": inputs.machine.machine.id,
        "grid_unit": inputs.site.grid.unit,
        "station_step": _length(inputs.site.station_step_m, units),
        "alignment": alignment,
        "files": {
            "log": _file(inputs.log),
            "machine.toml": _file(inputs.machine_file),
            "site.toml": _file(inputs.site_file),
            **{key: _file(source) for key, source in inputs.named_files.items()},
        },
        "versions": dict(inputs.versions),
        "stages": {name: manifest.get("version") for name, manifest in inputs.manifests.items()},
    }


def settings(inputs: ReportInputs) -> dict[str, Any]:
    """Both configuration files as they were understood, defaults included."""
    return {
        "machine": inputs.machine.model_dump(mode="json"),
        "site": inputs.site.model_dump(mode="json"),
    }


def _length(metres: float, units: Units) -> float | int | None:
    return plain(float(units.to_length(metres)), units.length_digits)


def _file(source: FileSource) -> dict[str, str]:
    return {"name": source.name, "sha256": source.sha256}
