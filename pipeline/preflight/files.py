"""Whether the files that site.toml names can be read and belong together."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.config import Site
from pipeline.errors import PipelineError
from pipeline.preflight.finding import Finding
from pipeline.runs import RunFolder
from pipeline.stages.job import Source, named_files

FAR_SHOT_M = 20.0
"""A shot of the floor further above or below the design is none of it."""


def file_findings(site: Site, source: Source) -> Iterator[Finding]:
    """Whether the files that site.toml names are there and can be read."""
    try:
        files = named_files(site, source, RunFolder(Path()))
    except PipelineError as error:
        yield Finding("error", str(error))
        return
    from pipeline.surface.design import read_design

    try:
        design, alignment = read_design(files["design"].path, site)
    except PipelineError as error:
        yield Finding("error", str(error))
        return
    yield Finding("ok", f"{files['design'].name}: the design and its alignment can be read")
    from pipeline.surface.utilities import read_utilities

    try:
        buried = read_utilities(site, {key: file.path for key, file in files.items()})
    except PipelineError as error:
        yield Finding("error", str(error))
        return
    if buried:
        yield Finding(
            "ok", f"{len(buried)} buried utilities: {', '.join(utility.name for utility in buried[:8])}"
        )
    if site.checks is None:
        yield Finding(
            "warning",
            "site.toml names no check shots: the report will have no independent check of its accuracy; "
            "shoot some points of the floor with the total station and name the file in [checks]",
        )
        return
    from pipeline.stages.check_shots import shots_of

    try:
        shots = shots_of(site, files, design, alignment)
    except PipelineError as error:
        yield Finding("error", str(error))
        return
    assert shots is not None
    level = float(np.nanmedian(design.floor_level(np.linspace(*design.station_range(), 50))))
    if len(shots) and np.all(np.abs(shots.p_grid[:, 2] - level) > FAR_SHOT_M):
        yield Finding(
            "warning",
            f"{files['checks'].name}: every shot lies more than {FAR_SHOT_M:.0f} m above or below the design floor; "
            "are its columns in the order that [checks] order says, and in the site's unit?",
        )
    if not len(shots):
        yield Finding(
            "warning",
            f"{files['checks'].name}: there is no shot in it, so the report will have no independent check of its "
            "accuracy; export the shots again",
        )
        return
    yield Finding("ok", f"{files['checks'].name}: {len(shots)} check shots")
