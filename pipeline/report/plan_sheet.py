"""The sheet of a plan: can the tolerance be met, where, what limits it, and what would help."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.planning.changes import LOST_M
from pipeline.planning.edge import EdgePlan
from pipeline.planning.outcome import CANDIDATES, Map, Plan
from pipeline.planning.single_pose import DISTANCES_M, by_distance
from pipeline.report.numbers import column, number, table
from pipeline.report.plan_figures import distance_figure, line_figure, map_figure, scale_of_ellipses
from pipeline.report.sheet import GOOD, POOR, Part, Picture, Sheet
from pipeline.report.words import Words


@dataclass(frozen=True)
class LogComparison:
    """A plan with the poses of a log, beside what that log's report says; metres."""

    run: str
    predicted: float
    reported: float
    own: float
    reported_own: float


def plan_sheet(
    plan: Plan,
    subject: str,
    remarks: Sequence[str],
    origin: Mapping[str, str],
    compared: LogComparison | None = None,
    at: tuple[str, EdgePlan] | None = None,
    language: str = "en",
) -> Sheet:
    """A plan as a sheet; ``at`` is one posture with its name."""
    words = Words(language)
    state, sentence = verdict(plan, words)
    parts = [_along(plan, words), _budget(plan.edge, words), _maps(plan, words), _seen(plan, words)]
    if alone := _alone(plan, words):
        parts.append(alone)
    if plan.gains:
        parts.append(_gains(plan, words))
    if at is not None:
        parts.insert(0, _at(*at, words))
    if compared is not None:
        c = compared
        said = words(
            "planning.log_sentence",
            run=c.run,
            predicted=1e3 * c.predicted,
            reported=1e3 * c.reported,
            percent=100 * (c.predicted / c.reported - 1),
            own=1e3 * c.own,
            reported_own=1e3 * c.reported_own,
        )
        parts.append(Part(words("planning.log"), [said]))
    return Sheet(
        words("planning.title"), subject, state, sentence, _numbers(plan, words), remarks, parts, origin
    )


def verdict(plan: Plan, words: Words) -> tuple[str, str]:
    """Whether the tolerance can be met, and the sentence that says so."""
    line, k = plan.line, plan.coverage_factor
    half, n, everything = 1e3 * plan.half_tolerance_m, int(line.capable.sum()), len(line.station)
    u = 1e3 * k * plan.sigma_h
    if not np.isfinite(line.sigma_h).any():
        return POOR, words("planning.unseen")
    if n == everything:
        u = 1e3 * k * float(np.max(line.sigma_h))
        return GOOD, words("planning.capable", k=k, u=u, half=half)
    if n == 0:
        return POOR, words("planning.nowhere", k=k, u=u, half=half)
    return POOR, words("planning.partly", n=n, all=everything, k=k, half=half)


def _mm(value: float):
    return number(1e3 * value, "mm", 1)


def _numbers(plan: Plan, words: Words):
    line, k = plan.line, plan.coverage_factor
    seen = np.isfinite(line.sigma_h)

    def median(values) -> float:
        return float(np.median(values[seen])) if seen.any() else float("nan")

    largest = np.sqrt(np.linalg.eigvalsh(np.nan_to_num(plan.edge.total))[:, -1])
    largest = largest[np.isfinite(plan.edge.sigma_h())]
    worst = float(np.median(largest)) if len(largest) else float("nan")
    half = 1e3 * plan.half_tolerance_m
    return [
        (words("planning.sigma"), _mm(plan.sigma_h), words("planning.sigma_note")),
        (words("planning.u", k=k), _mm(k * plan.sigma_h), words("planning.u_note", half=half)),
        (words("planning.own"), _mm(median(line.own)), words("planning.own_note")),
        (words("planning.common"), _mm(median(line.common)), words("planning.common_note")),
        (
            words("planning.stations"),
            number(int(line.capable.sum())),
            words("planning.stations_note", all=len(line.station)),
        ),
        (words("planning.worst"), _mm(worst), words("planning.worst_note")),
    ]


def _along(plan: Plan, words: Words) -> Part:
    line, k = plan.line, plan.coverage_factor
    columns = [
        column("station", "station", "m", 1),
        column("u", words("planning.u", k=k), "mm", 1),
        column("own", words("planning.own"), "mm", 1),
        column("common", words("planning.common"), "mm", 1),
    ]
    rows = [
        {"station": s, "u": 1e3 * k * a, "own": 1e3 * b, "common": 1e3 * c}
        for s, a, b, c in zip(line.station, line.sigma_h, line.own, line.common, strict=True)
    ]
    picture = Picture(
        "plan-line",
        words("planning.line_title"),
        words("planning.line_good"),
        words("planning.line_description"),
        lambda: line_figure(plan, words),
        table(columns, rows),
    )
    said = words("planning.along_sentence", reach=plan.habits.reach_m, sweep=plan.habits.sweep_m)
    return Part(words("planning.along"), [said], (), [picture])


def budget_rows(edge: EdgePlan, words: Words) -> list[dict]:
    """Median standard deviations of the elevation by source, mm, and their shares of the variance, percent."""
    variances = {"own": edge.own[:, 2, 2], **edge.by_source}
    medians = {name: float(np.nanmedian(v)) for name, v in variances.items()}
    whole = sum(medians.values())
    return [
        {"source": words(f"planning.from.{name}"), "value": 1e3 * np.sqrt(v), "share": 100 * v / whole}
        for name, v in medians.items()
    ]


def _budget_table(edge: EdgePlan, words: Words):
    columns = [
        column("source", words("planning.source")),
        column("value", words("planning.value"), "mm", 2),
        column("share", words("planning.squared"), "%", 0),
    ]
    rows = budget_rows(edge, words) if np.isfinite(edge.sigma_h()).any() else []
    return table(columns, rows)


def _budget(edge: EdgePlan, words: Words) -> Part:
    return Part(
        words("planning.budget"), (), [(words("planning.budget_caption"), _budget_table(edge, words))]
    )


def _at(what: str, edge: EdgePlan, words: Words) -> Part:
    columns = [column("what", words("planning.source")), column("value", words("planning.value"), "mm", 1)]
    parts = ("total", "own", "common", "one_look")
    rows = [
        {"what": words(f"planning.{part}"), "value": 1e3 * float(edge.sigma_h(part)[0])} for part in parts
    ]
    return Part(
        words("planning.at"),
        (),
        [
            (words("planning.at_caption", what=what), table(columns, rows)),
            (words("planning.budget_caption"), _budget_table(edge, words)),
        ],
    )


def _map_table(drawn: Map, x_label: str, y_label: str, words: Words):
    columns = [
        column("x", x_label, "", 1),
        column("y", y_label, "", 1),
        column("sigma", words("planning.worst"), "mm", 1),
    ]
    rows = [
        {"x": x, "y": y, "sigma": 1e3 * float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))}
        for x, y, cov in drawn.ellipses
    ]
    return table(columns, rows)


def _maps(plan: Plan, words: Words) -> Part:
    pictures = []
    times = scale_of_ellipses(plan.arm_map)
    labels = {"arm": ("reach", "height"), "plan": ("reach", "leftward")}
    for name, drawn in (("arm", plan.arm_map), ("plan", plan.plan_map)):
        x, y = (words(f"planning.{label}") for label in labels[name])
        pictures.append(
            Picture(
                f"plan-{name}",
                words(f"planning.{name}_title"),
                words(f"planning.{name}_good"),
                words(f"planning.{name}_description"),
                partial(
                    map_figure, drawn, x, y, words, times, 1e3 * plan.half_tolerance_m / plan.coverage_factor
                ),
                _map_table(drawn, x, y, words),
            )
        )
    said = words("planning.maps_sentence", station=plan.stand_station, times=times)
    return Part(words("planning.maps"), [said], (), pictures)


def _seen(plan: Plan, words: Words) -> Part:
    columns = [
        column("camera", words("planning.camera"), kind="id"),
        column("marker", words("planning.marker"), kind="id"),
        column("share", words("planning.share"), "%", 0),
        column("tags", words("planning.tags"), "", 1),
        column("side", words("planning.side"), "px", 0),
        column("why", words("planning.why")),
    ]
    rows = [
        {
            "camera": s.camera,
            "marker": s.marker,
            "share": 100 * s.share,
            "tags": s.tags,
            "side": s.side_px,
            "why": s.why_not,
        }
        for s in plan.seen
    ]
    return Part(words("planning.seen"), (), [(words("planning.seen_caption"), table(columns, rows))])


def _alone(plan: Plan, words: Words) -> Part | None:
    """Each camera and marker that meet, as if nothing else were there: Figs. 7 to 9 of the paper for this job."""
    net, noise = plan.setup.network, plan.setup.looking.noise
    rows, series = [], []
    for pair in plan.seen:
        if pair.share == 0:
            continue
        camera = next(c for c in net.cameras if c.name == pair.camera)
        k = next(k for k, m in enumerate(net.markers) if m.name == pair.marker)
        corners, lens = net.tag_corners[net.tag_marker == k], net.statics[camera.intrinsics].value
        sigmas, side, off = by_distance(corners, lens, noise.sigma)
        longer, _, _ = by_distance(corners, lens, noise.sigma, factor=1.5)
        one, _, _ = by_distance(corners[:1], lens, noise.sigma)
        name = f"{pair.camera}, {pair.marker}"
        series.append((name, 1e3 * sigmas[:, 2]))
        rows += [
            {
                "pair": name,
                "z": z,
                "side": side[i],
                "large": 1e3 * sigmas[i, 2],
                "small": 1e3 * sigmas[i, 0],
                "off": off[i],
                "one": 1e3 * one[i, 2],
                "lens": 1e3 * longer[i, 2],
            }
            for i, z in enumerate(DISTANCES_M)
        ]
    if not series:
        return None
    columns = [
        column("pair", words("planning.pair"), kind="id"),
        column("z", words("planning.distance"), "m", 0),
        column("side", words("planning.side"), "px", 0),
        column("large", words("planning.largest"), "mm", 2),
        column("small", words("planning.smallest"), "mm", 2),
        column("off", words("planning.off"), "deg", 1),
        column("one", words("planning.one_tag"), "mm", 2),
        column("lens", words("planning.longer"), "mm", 2),
    ]
    picture = Picture(
        "plan-alone",
        words("planning.alone_title"),
        words("planning.alone_good"),
        words("planning.alone_description"),
        partial(distance_figure, np.array(DISTANCES_M), series, words),
        table(columns, rows),
    )
    return Part(words("planning.alone"), [words("planning.alone_sentence")], (), [picture])


def _gains(plan: Plan, words: Words) -> Part:
    columns = [
        column("change", words("planning.change_heading")),
        column("sigma", words("planning.value"), "mm", 2),
        column("seen", words("planning.share"), "%", 0),
        column("score", words("planning.score"), "mm", 1),
    ]
    shown = [*plan.gains] + ([plan.place.gain] if plan.place is not None else [])
    rows = []
    for gain in shown:
        name, _, camera = gain.name.partition(":")
        said = words(f"planning.change.{name}", camera=camera) if camera else words(f"planning.change.{name}")
        rows.append(
            {
                "change": said,
                "sigma": 1e3 * gain.sigma_m,
                "seen": 100 * gain.seen,
                "score": 1e3 * gain.score_m,
            }
        )
    sentences = [words("planning.gains_sentence", lost=1e3 * LOST_M)]
    if plan.place is not None and plan.place_station is not None:
        station, offset = plan.place_station
        sentences.append(
            words(
                "planning.place_sentence",
                tried=CANDIDATES[0] * (CANDIDATES[1] // 2) * 2,
                like=plan.place.like,
                station=station,
                offset=abs(offset),
                side=words("planning.left" if offset > 0 else "planning.right"),
                seen=100 * plan.place.gain.seen,
                before=100 * plan.gains[0].seen,
            )
        )
    caption = words("planning.gains_caption", n=plan.postures_tried)
    return Part(words("planning.gains"), sentences, [(caption, table(columns, rows))])
