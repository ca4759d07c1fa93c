"""The check shots of a job, for the survey stage: read, compared, and what they say of causes as plain numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from pipeline.config.checks import Checks
from pipeline.config.site import Site
from pipeline.estimation.sensitivities import Sensitivities
from pipeline.estimation.table import sensitivities_from_columns
from pipeline.stages.job import Job, NamedFile
from pipeline.surface.alignment import Alignment
from pipeline.surface.as_built import AsBuilt
from pipeline.surface.checks import (
    OUTSIDE_ALIGNMENT,
    OUTSIDE_CUT,
    USED,
    Comparison,
    compare,
    summarise,
    without_used,
)
from pipeline.surface.design import Design
from pipeline.surface.diagnosis import NAMED, UNSURE, Candidate, diagnose, global_test
from pipeline.surface.parked import KnownPoint, compare_parked, with_known_points
from pipeline.surface.rests import rests_of
from pipeline.surface.shot_cells import KINDS
from pipeline.surface.shot_errors import Differences, differences_of
from pipeline.surface.shots import Shots, check_order, read_shots
from pipeline.surface.telling_shot import telling_shot
from pipeline.tracks.poses import CuttingEdge


def shots_of(
    site: Site, files: Mapping[str, NamedFile], design: Design, alignment: Alignment
) -> Shots | None:
    """The check shots, if the site has any; their order is checked against where the trench is. Raises SurfaceError."""
    checks = site.checks
    if checks is None:
        return None
    scale, zone = site.grid.metres_per_unit, site.report.time_zone
    shots = read_shots(files["checks"].path, checks.order, scale, zone, checks.codes)
    first, last = design.station_range()
    stretch = alignment.points(np.linspace(first, last, 200), 0.0)
    check_order(shots, stretch.min(axis=0), stretch.max(axis=0), checks.order, files["checks"].name)
    return shots


def compared(
    job: Job, shots: Shots, edge: CuttingEdge, built: AsBuilt, alignment: Alignment
) -> tuple[Shots, Comparison, dict[str, Any]]:
    """The shots with a row for every visit of a known point, what came of each, and the facts for survey.json."""
    checks = job.site.checks
    assert checks is not None
    rests = rests_of(edge) if checks.control or np.any(shots.kind != "floor") else None
    if rests is not None:
        shots = with_known_points(shots, _known_points(job, checks), edge, rests, checks.control_radius_m)
    lasting = job.read_json("solution.json").get("correlation_time_s") or {}
    comparison = compare(shots, built, alignment, checks.sigma_mm / 1000)
    if rests is not None:
        comparison = compare_parked(
            comparison,
            shots,
            edge,
            rests,
            checks.control_radius_m,
            checks.time_tolerance_s,
            lasting.get("parked", lasting.get("median")),
        )
    comparison = without_used(shots, comparison, checks.used_in_calibration)
    answer = sensitivities_from_columns(job.read_table("sensitivities"))
    tau_s = lasting.get("digging", lasting.get("median"))
    differences = differences_of(shots, comparison, alignment, edge, answer, tau_s)
    summary = {name.removesuffix("_m"): value for name, value in asdict(summarise(shots, comparison)).items()}
    count = Counter(comparison.result.tolist())
    facts = {
        **summary,
        "shots": len(shots),
        "outside_the_cut": count[OUTSIDE_CUT],
        "outside_the_alignment": count[OUTSIDE_ALIGNMENT],
        "used_in_calibration": count[USED],
        "results": dict(sorted(count.items())),
        "kinds": {
            kind: _kind_facts(shots, comparison, differences, kind) for kind in KINDS if kind in shots.kind
        },
        "diagnosis": _diagnosis_facts(differences, built, alignment, edge, answer, checks.sigma_mm / 1000),
    }
    return shots, comparison, facts


def _known_points(job: Job, checks: Checks) -> dict[str, KnownPoint]:
    scale = job.site.grid.metres_per_unit
    return {
        name: KnownPoint(np.array(point.enh) * scale, point.sigma_mm / 1000)
        for name, point in checks.control.items()
    }


def _kind_facts(shots: Shots, comparison: Comparison, differences: Differences, kind: str) -> dict[str, Any]:
    """Statistics of one kind, and its global test with the errors that its shots share."""
    summary = asdict(summarise(shots, comparison, kind))
    statistic, components, p_value = global_test(differences, shots.kind[differences.shot] == kind)
    return {
        **{name.removesuffix("_m"): value for name, value in summary.items()},
        "shots": int(np.count_nonzero(shots.kind == kind)),
        "global_test": {"statistic": statistic, "components": components, "p_value": p_value},
    }


def _diagnosis_facts(
    differences: Differences,
    built: AsBuilt,
    alignment: Alignment,
    edge: CuttingEdge,
    answer: Sensitivities | None,
    sigma_ts_m: float,
) -> dict[str, Any] | None:
    found = diagnose(differences)
    if found is None:
        return None
    telling = None
    if found.state == UNSURE:
        pair = found.candidates[0], found.candidates[found.rivals[0]]
        shot = telling_shot(*pair, built, alignment, edge, answer, sigma_ts_m)
        telling = None if shot is None else asdict(shot)
    return {
        "state": found.state,
        "named": _candidate_facts(found.candidates[0]) if found.state == NAMED else None,
        "rivals": [_candidate_facts(found.candidates[i]) for i in found.rivals],
        "telling_shot": telling,
        "global_test": {
            "statistic": found.statistic,
            "components": found.components,
            "p_value": found.p_value,
        },
        "critical": found.critical,
        "common_factors": answer is not None,
        "candidates": [_candidate_facts(candidate) for candidate in found.candidates],
    }


def _candidate_facts(candidate: Candidate) -> dict[str, Any]:
    own = {name: getattr(candidate, name) for name in Candidate.__dataclass_fields__ if name != "cause"}
    return {**asdict(candidate.cause), **own}
