"""survey: the cutting edge -> as-built surface, verdict per station, total-station checks, buried utilities.

`survey.json`::

    {
        "verdict": "PASS",
        "reason": sentence,
        "counts": {"PASS": 12, "FAIL": 0, "CANNOT TELL": 1, "NOT REACHED": 3},
        "design_name": ...,
        "design_kind": ...,
        "alignment": {"name", "length", "start_station", "end_station"},
        "rules": {"surface": sentence, "floor": sentence, "decision": sentence},
        "tolerance": {"high", "low", "coverage_factor"},
        "deviation": {"mean", "worst", "worst_station", "median_expanded_uncertainty"},
        "reach": {"first", "last", "dug", "gaps": [[from, to], ...], "sigma"},
        "volumes": [{"kind", "m3", "sigma_own", "sigma_common", "area"}, ...],
        "left_where_not_cut": m3,
        "uncut_floor": m2,
        "side_tolerance": {"wide", "narrow"} or null,
        "wanted_shots": {"shots": [{"station", "settles"}, ...], "open", "partly", "best_alone", "sigma_shot"},
        "surface": {
            "cell",
            "cells_floor",
            "cells_cut",
            "cells_passed_over",
            "cells_never_touched",
            "median_sigma_own",
            "median_sigma_common",
            "lowest_pass_correction",
            "excess",
            "excess_share",
        },
        "checks": {
            "n",
            "bias",
            "rmse",
            "worst",
            "worst_point",
            "reduced_chi_square",
            "horizontal_rmse",
            "indicative_only",
            "shots",
            "outside_the_cut",
            "outside_the_alignment",
            "used_in_calibration",
            "results": {result: shots},
            "kinds": {"floor": {the statistics above, "shots", "global_test"}, "edge": ..., "control": ...},
            "diagnosis": {
                "state": "none", "named", "cannot tell" or "unexplained",
                "named": candidate or null,
                "rivals": [candidate],
                "telling_shot": fields of `surface.telling_shot.TellingShot` or null,
                "global_test": {"statistic", "components", "p_value"},
                "critical",
                "common_factors": whether the adjustment gave the common errors,
                "candidates": [fields of `surface.shot_errors.Cause` and `surface.diagnosis.Candidate`],
            }
            or null,
        }
        or null,
        "utilities": {"reach", "lines": [see `surface.utilities.facts_of`]} or null,
    }

The statistics that stand in `checks` itself are those of the floor. All lengths are metres; what there is nothing of
is null.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from pipeline.config.site import Tolerance
from pipeline.estimation.table import sensitivities_from_columns
from pipeline.stages import check_shots
from pipeline.stages.job import Counts, Job, Progress
from pipeline.surface import table
from pipeline.surface.as_built import AsBuilt, Reach, SurfaceRule, as_built, reach_of
from pipeline.surface.decision import (
    CANNOT_TELL,
    FAIL,
    NOT_REACHED,
    PASS,
    SideVerdicts,
    Stations,
    ToleranceBand,
    job_verdict,
    judge,
    judge_sides,
    side_sentence,
    stations_along,
    with_sides,
)
from pipeline.surface.design import TinDesign, floor_sentence, read_design
from pipeline.surface.ground import read_ground
from pipeline.surface.sides import sides
from pipeline.surface.station_budget import station_budget
from pipeline.surface.sweep import path_along
from pipeline.surface.utilities import REACH_M, VERDICTS, facts_of, find_approaches, read_utilities
from pipeline.surface.volumes import Volume, volumes
from pipeline.surface.wanted_shots import wanted_shots
from pipeline.tables import NULL_INT, empty_columns
from pipeline.tracks.table import EDGE_COLUMNS, cutting_edge_from_columns

SIGMA_SHOT_M = 0.002
"""Of a total-station shot, where site.toml states none: what its [checks] default to."""


def run(job: Job, progress: Progress) -> Counts:
    """Write `as_built`, `stations`, `station_budgets`, `sides`, `volumes`, `checks`, `utilities` and `survey.json`.

    Raises SurfaceError for a design, an alignment, check shots or utilities that cannot be used.
    """
    site = job.site
    scale = site.grid.metres_per_unit
    progress.total(4, "steps")
    # What a person can get wrong is read before anything is computed.
    design, alignment = read_design(job.files["design"].path, site)
    ground_file = job.files.get("ground")
    ground = read_ground(ground_file.path if ground_file else None, site, alignment)
    shots = check_shots.shots_of(site, job.files, design, alignment)
    buried = read_utilities(site, {key: file.path for key, file in job.files.items()})
    progress.advance()

    edge = cutting_edge_from_columns(job.read_table("cutting_edge", EDGE_COLUMNS))
    rule = SurfaceRule(surface=site.survey.surface)
    path = path_along(edge, alignment, rule.sweep)
    built = as_built(edge, alignment, design, site.survey.cell_m, rule, path)
    progress.advance()

    band = ToleranceBand(
        site.tolerance.high_mm / 1000, site.tolerance.low_mm / 1000, site.tolerance.coverage_factor
    )
    step_m = site.station_step_m
    where = stations_along(design, alignment.start_station, alignment.end_station, step_m)
    stations = levels = judge(built, design, where, step_m, band)
    both_sides = sides(path, built, design, where, step_m, rule.sweep)
    judged: SideVerdicts | None = None
    across = _side_band(site.tolerance)
    if across is not None:
        judged = judge_sides(both_sides, across)
        stations = with_sides(levels, judged)
    verdict = job_verdict(stations)
    soil = volumes(built, design, ground, both_sides.rows, where, step_m)
    sigma_shot_m = site.checks.sigma_mm / 1000 if site.checks else SIGMA_SHOT_M
    sides_pass = None if judged is None else np.all(judged.verdict == PASS, axis=1)
    wanted = wanted_shots(levels, band, sigma_shot_m, only=sides_pass)
    progress.advance()

    job.write_table("as_built", table.columns_of_as_built(built, NULL_INT))
    job.write_table("stations", table.columns_of_stations(stations))
    answer = sensitivities_from_columns(job.read_table("sensitivities"))
    budget = station_budget(built, answer, where, step_m)
    job.write_table("station_budgets", table.columns_of_station_budgets(budget))
    job.write_table("sides", table.columns_of_sides(both_sides, judged))
    job.write_table("volumes", table.columns_of_volumes(soil))
    checks: dict[str, Any] | None = None
    if shots is not None and shots.mended:
        progress.warn(
            f"{job.files['checks'].name}: in {len(shots.mended)} lines (the first is line {shots.mended[0]}) the "
            "separator after the point's name is missing; they were read as if it were there"
        )
    if shots is not None and site.checks is not None and (len(shots) or site.checks.control):
        shots, comparison, checks = check_shots.compared(job, shots, edge, built, alignment)
        job.write_table("checks", table.columns_of_checks(shots, comparison))
        if not checks["n"]:
            progress.warn(
                f"none of the {len(shots)} check shots of {site.checks.file} lies on ground that was cut: "
                "there is no independent check of this report"
            )
    else:
        job.write_table("checks", empty_columns("checks"))
        if shots is not None:
            progress.warn(
                f"{job.files['checks'].name} holds no check shots: there is no independent check of this report"
            )
    found = find_approaches(edge, buried)
    job.write_table("utilities", table.columns_of_utilities(found, alignment))
    job.write_json(
        "survey.json",
        {
            "verdict": verdict.verdict,
            "reason": verdict.sentence,
            "counts": verdict.counts,
            "design_name": design.name,
            "design_kind": site.design.kind,
            "alignment": {
                "name": alignment.name,
                "length": alignment.length,
                "start_station": alignment.start_station,
                "end_station": alignment.end_station,
            },
            "rules": {
                "surface": rule.sentence(),
                "floor": floor_sentence(design),
                "decision": band.sentence(),
                "sides": None if across is None else side_sentence(across),
            },
            "tolerance": {
                "high": band.high_m,
                "low": band.low_m,
                "coverage_factor": band.coverage_factor,
            },
            "deviation": _deviation_facts(stations),
            "reach": _reach_facts(reach_of(built)),
            "volumes": [_volume_facts(volume) for volume in soil.job],
            "left_where_not_cut": _or_null(soil.not_reached_m3),
            "uncut_floor": soil.uncut_m2,
            "side_tolerance": None if across is None else {"wide": across.high_m, "narrow": across.low_m},
            "wanted_shots": {
                "shots": [asdict(shot) for shot in wanted.shots],
                "open": wanted.open,
                "partly": wanted.partly,
                "best_alone": wanted.best_alone,
                "sigma_shot": sigma_shot_m,
            },
            "surface": _surface_facts(built),
            "checks": checks,
            "utilities": {"reach": REACH_M, "lines": [facts_of(finding, alignment) for finding in found]}
            if found
            else None,
        },
    )
    progress.advance()
    if soil.groundless_m2 > 0:
        progress.warn(
            f"the ground of site.toml does not reach over {soil.groundless_m2:.1f} m² of what was dug or was to be: "
            "the volumes leave that out; give a ground that covers the trench"
        )
    if isinstance(design, TinDesign) and design.floor_is_whole:
        progress.warn(
            f"the design surface '{design.name}' has no flat faces under the alignment: "
            "the whole surface counts as floor"
        )
    if verdict.counts[NOT_REACHED] == len(stations.station):
        lowest = np.nanmin(built.h_lowest - design.floor_level(built.grid.station)[:, None], initial=np.inf)
        progress.warn(
            "no station was reached: over the alignment the cutting edge came no lower than "
            f"{lowest / scale:.2f} ({site.grid.unit}) above the design"
            if lowest > rule.contact_m
            else "no station was reached: too few cells of the floor were cut"
        )
    counted: Counts = {
        "stations": {
            v: verdict.counts[v] for v in (PASS, FAIL, CANNOT_TELL, NOT_REACHED) if verdict.counts[v]
        },
        "cells cut": int(np.count_nonzero(built.cut & built.floor)),
    }
    if checks is not None:
        counted["check shots"] = checks["shots"]
        counted["of these compared"] = sum(kind["n"] for kind in checks["kinds"].values())
    if found:
        words = [finding.verdict for finding in found]
        counted["utilities"] = {word: words.count(word) for word in VERDICTS if word in words}
    return counted


def _side_band(tolerance: Tolerance) -> ToleranceBand | None:
    """The tolerance of the sides, + wide, where site.toml gives one."""
    if tolerance.wide_mm is None or tolerance.narrow_mm is None:
        return None
    return ToleranceBand(tolerance.wide_mm / 1000, tolerance.narrow_mm / 1000, tolerance.coverage_factor)


def _deviation_facts(stations: Stations) -> dict[str, float | None]:
    known = np.flatnonzero(np.isfinite(stations.deviation))
    if not len(known):
        return {"mean": None, "worst": None, "worst_station": None, "median_expanded_uncertainty": None}
    deviation = stations.deviation[known]
    worst = int(np.argmax(np.abs(deviation)))
    return {
        "mean": float(deviation.mean()),
        "worst": float(deviation[worst]),
        "worst_station": float(stations.station[known[worst]]),
        "median_expanded_uncertainty": float(np.median(stations.expanded_uncertainty[known])),
    }


def _reach_facts(reach: Reach) -> dict[str, Any]:
    return {
        "first": _or_null(reach.first),
        "last": _or_null(reach.last),
        "dug": reach.dug,
        "gaps": [list(gap) for gap in reach.gaps],
        "sigma": reach.sigma,
    }


def _volume_facts(volume: Volume) -> dict[str, Any]:
    return {
        "kind": volume.kind,
        "m3": _or_null(volume.m3),
        "sigma_own": _or_null(volume.sigma_own_m3),
        "sigma_common": _or_null(volume.sigma_common_m3),
        "area": volume.area_m2,
    }


def _or_null(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _surface_facts(built: AsBuilt) -> dict[str, Any]:
    floor = built.floor & np.isfinite(built.design_h)
    cut = floor & built.cut
    some = bool(cut.any())
    return {
        "cell": built.grid.cell_m,
        "cells_floor": int(np.count_nonzero(floor)),
        "cells_cut": int(np.count_nonzero(cut)),
        "cells_passed_over": int(np.count_nonzero(floor & (built.state == 1))),
        "cells_never_touched": int(np.count_nonzero(floor & (built.state == 0))),
        "median_sigma_own": float(np.median(built.sigma_own[cut])) if some else None,
        "median_sigma_common": float(np.median(built.sigma_common[cut])) if some else None,
        "lowest_pass_correction": float(np.mean((built.h - built.h_lowest)[cut])) if some else None,
        "excess": built.excess_m,
        "excess_share": built.excess_share,
    }
