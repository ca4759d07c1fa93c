"""How it was done and what it rests on: the method in words, files, versions, fingerprints."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from typing import Any

from pipeline.config.quantities import calibrated_in
from pipeline.report import numbers
from pipeline.report.facts import deviation_text
from pipeline.report.inputs import FileSource, ReportInputs
from pipeline.report.numbers import column
from pipeline.report.units import Units
from pipeline.report.words import Words


def method(inputs: ReportInputs, units: Units, words: Words) -> list[str]:
    """The method of this run, one sentence or two per paragraph."""
    site = inputs.site
    tolerance = site.tolerance
    cell = deviation_text(site.survey.cell_m, units, signed=False)
    k = f"{tolerance.coverage_factor:g}"
    low, high = (
        deviation_text(tolerance.low_mm / 1000, units, False, fine=True),
        deviation_text(tolerance.high_mm / 1000, units, False, fine=True),
    )
    # What this run did, in the words of the stage that did it; else what the settings say.
    rules = inputs.survey.get("rules") or {}
    surface = rules.get("surface") or words(f"method.{site.survey.surface}", cell=cell)
    return [
        words("method.sign"),
        words("method.rule", low=low, high=high),
        *([rules["sides"]] if rules.get("sides") else []),
        words("method.sigma", k=k),
        surface,
        *([rules["floor"]] if rules.get("floor") else []),
        words("method.cells", cell=cell),
        words("method.network"),
        words("method.check"),
        words("method.units", units=units.describe()),
    ]


def provenance(inputs: ReportInputs, words: Words) -> dict[str, Any]:
    """Tables of files, calibrations, stages and versions."""
    files: list[tuple[str, FileSource]] = [
        ("log", inputs.log),
        ("machine", inputs.machine_file),
        ("site", inputs.site_file),
    ]
    files += [(kind, source) for kind, source in inputs.named_files.items()]
    file_columns = [
        column("what", words("columns.what")),
        column("name", words("columns.name"), kind="id"),
        column("origin", words("columns.origin")),
        column("sha256", words("columns.sha256"), kind="code"),
    ]
    stage_columns = [
        column("stage", words("columns.stage")),
        column("version", words("columns.version"), "", 0),
        column("fingerprint", words("columns.fingerprint"), kind="code"),
    ]
    version_columns = [column("name", words("columns.name")), column("version", words("columns.version"))]
    return {
        "files": numbers.table(
            file_columns,
            [
                {
                    "what": words(f"provenance.{kind.partition('.')[0]}"),
                    "name": source.name,
                    "origin": words(f"origins.{source.origin}")
                    if words.has(f"origins.{source.origin}")
                    else source.origin,
                    "sha256": source.sha256,
                }
                for kind, source in files
            ],
        ),
        "calibrations": numbers.table(
            [
                column("what", words("columns.what"), kind="id"),
                column("date", words("columns.date")),
                column("age", words("columns.age"), words("provenance.days"), 0),
                column("by", words("columns.by")),
                column("source", words("columns.calibrated_from"), kind="id"),
                column("beyond", words("provenance.used_beyond")),
                column("sha256", words("columns.sha256"), kind="code"),
            ],
            list(_calibrations(inputs, words)),
        ),
        "stages": numbers.table(
            stage_columns,
            [
                {"stage": stage, "version": m.get("version"), "fingerprint": m.get("fingerprint", "")}
                for stage, m in inputs.manifests.items()
            ],
        ),
        "versions": numbers.table(
            version_columns, [{"name": name, "version": version} for name, version in inputs.versions.items()]
        ),
    }


def _calibrations(inputs: ReportInputs, words: Words) -> Iterator[dict[str, Any]]:
    """A row per quantity of the two files that says when it was told; its age is that on the day of the log."""
    start_ns = inputs.log_facts.get("start_ns")
    day = None if not start_ns else datetime.datetime.fromtimestamp(start_ns / 1e9, datetime.UTC).date()
    beyond = {
        f"sensors.{name}.curve": words("provenance.beyond", n=found["beyond"], all=found["readings"])
        for name, found in (inputs.solution.get("beyond_stroke") or {}).items()
    }
    for key, told in [*calibrated_in(inputs.machine), *calibrated_in(inputs.site)]:
        yield {
            "what": key,
            "date": told.date.isoformat(),
            "age": None if day is None else (day - told.date).days,
            "by": told.by,
            "source": told.source,
            "beyond": beyond.get(key, ""),
            "sha256": told.sha256,
        }
