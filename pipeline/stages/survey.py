"""survey: the cutting edge -> as-built surface, verdict per station, total-station checks.

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
            "indicative_only",
            "shots",
            "outside_the_cut",
            "outside_the_alignment",
        }
        or null,
    }

All lengths are metres; what there is nothing of is null.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from pipeline.stages.job import Counts, Job, Progress
from pipeline.surface import table
from pipeline.surface.as_built import AsBuilt, SurfaceRule, as_built
from pipeline.surface.checks import OUTSIDE_ALIGNMENT, OUTSIDE_CUT, Comparison, compare, summarise
from pipeline.surface.decision import (
    CANNOT_TELL,
    FAIL,
    NOT_REACHED,
    PASS,
    Stations,
    ToleranceBand,
    job_verdict,
    judge,
    stations_along,
)
from pipeline.surface.design import Design, TinDesign, floor_sentence, read_design
from pipeline.surface.shots import Shots, check_order, read_shots
from pipeline.tables import NULL_INT, empty_columns
from pipeline.tracks.table import EDGE_COLUMNS, cutting_edge_from_columns


def run(job: Job, progress: Progress) -> Counts:
    """Write `as_built`, `stations`, `checks` and `survey.json`.

    Raises SurfaceError for a design, an alignment or check shots that cannot be used.
    """
    site = job.site
    scale = site.grid.metres_per_unit
    progress.total(4, "steps")
    # What a person can get wrong is read before anything is computed.
    design, alignment = read_design(job.files["design"].path, site)
    shots = _shots(job, design, alignment)
    progress.advance()

    edge = cutting_edge_from_columns(job.read_table("cutting_edge", EDGE_COLUMNS))
    rule = SurfaceRule(surface=site.survey.surface)
    built = as_built(edge, alignment, design, site.survey.cell_m, rule)
    progress.advance()

    band = ToleranceBand(
        site.tolerance.high_mm / 1000, site.tolerance.low_mm / 1000, site.tolerance.coverage_factor
    )
    step_m = site.station_step_m
    where = stations_along(design, alignment.start_station, alignment.end_station, step_m)
    stations = judge(built, design, where, step_m, band)
    verdict = job_verdict(stations)
    progress.advance()

    job.write_table("as_built", table.columns_of_as_built(built, NULL_INT))
    job.write_table("stations", table.columns_of_stations(stations))
    checks: dict[str, Any] | None = None
    if shots is not None and shots.mended:
        progress.warn(
            f"{job.files['checks'].name}: in {len(shots.mended)} lines (the first is line {shots.mended[0]}) the "
            "separator after the point's name is missing; they were read as if it were there"
        )
    if shots is not None and len(shots):
        assert site.checks is not None
        comparison = compare(shots, built, alignment, site.checks.sigma_mm / 1000)
        checks = _check_facts(shots, comparison)
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
            },
            "tolerance": {
                "high": band.high_m,
                "low": band.low_m,
                "coverage_factor": band.coverage_factor,
            },
            "deviation": _deviation_facts(stations),
            "surface": _surface_facts(built),
            "checks": checks,
        },
    )
    progress.advance()
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
        counted["of these compared"] = checks["n"]
    return counted


def _shots(job: Job, design: Design, alignment) -> Shots | None:
    """The check shots, if the site has any; their order is checked against where the trench is."""
    if job.site.checks is None:
        return None
    shots = read_shots(job.files["checks"].path, job.site.checks.order, job.site.grid.metres_per_unit)
    first, last = design.station_range()
    stretch = alignment.points(np.linspace(first, last, 200), 0.0)
    check_order(
        shots,
        stretch.min(axis=0),
        stretch.max(axis=0),
        job.site.checks.order,
        job.files["checks"].name,
    )
    return shots


def _check_facts(shots: Shots, comparison: Comparison) -> dict[str, Any]:
    summary = asdict(summarise(shots, comparison))
    return {
        **{name.removesuffix("_m"): value for name, value in summary.items()},
        "shots": len(shots),
        "outside_the_cut": int(np.count_nonzero(comparison.result == OUTSIDE_CUT)),
        "outside_the_alignment": int(np.count_nonzero(comparison.result == OUTSIDE_ALIGNMENT)),
    }


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
