"""What needs attention: warnings of all stages and findings of the page itself, the gravest first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.report import detector, utilities
from pipeline.report.causes import cause_text, value_text
from pipeline.report.evidence import MOVED_SIGMAS, Timeline
from pipeline.report.facts import deviation_text, station_text
from pipeline.report.inputs import ReportInputs
from pipeline.report.measured import counted
from pipeline.report.numbers import Number, duration_text
from pipeline.report.units import Units, text_of
from pipeline.report.words import Words

SHOWN = 5
GRAVE, SERIOUS, WORTH = 0, 1, 2
"""Order of the list: the verdict rests on it; part of the answer is missing; worth a look."""
CHECK_OFF_SIGMAS = 3.0
CHI_SQUARE_HIGH = 2.0
BRIDGED_WORTH_S = 5.0

SECTION_OF_STAGE = {
    "ingest": "coverage",
    "detect": "detector",
    "estimate": "quality",
    "track": "coverage",
    "survey": "stations",
}
MOST_OF_ONE_SECTION = 2
"""Among the five: ten sensors that moved must not hide that the trench fails."""


@dataclass(frozen=True)
class Remark:
    """One sentence and the section it is about."""

    grade: int
    sentence: str
    section: str


def attention(
    inputs: ReportInputs,
    units: Units,
    words: Words,
    timeline: Timeline | None,
    statistics: dict[str, Number] | None,
) -> dict[str, Any]:
    """At most five remarks, and the rest, which is folded away but never dropped."""
    remarks = [
        *(Remark(GRAVE, sentence, "utilities") for sentence in utilities.struck(inputs, units, words)),
        *_of_log(inputs, words),
        *_of_stations(inputs, units, words),
        *_of_causes(inputs, units, words),
        *(
            Remark(SERIOUS, sentence, "utilities")
            for tell in (utilities.nearly, utilities.unseen)
            for sentence in tell(inputs, units, words)
        ),
        *_of_checks(inputs, words, statistics),
        *_of_stroke(inputs, words),
        *_of_network(inputs, words),
        *_of_coverage(inputs, words, timeline),
        *(Remark(SERIOUS, sentence, "detector") for sentence in detector.shaken(inputs, words)),
        *(Remark(WORTH, sentence, "detector") for sentence in detector.overstated(inputs, words)),
        *(
            Remark(SERIOUS, words("attention.missing", artefact=k, why=v), "provenance")
            for k, v in inputs.missing.items()
        ),
        *_warnings(inputs),
    ]
    seen: dict[str, Remark] = {}
    for remark in sorted(remarks, key=lambda r: r.grade):  # stable: the order above within a grade
        seen.setdefault(remark.sentence, remark)
    first: list[Remark] = []
    for remark in seen.values():
        if len(first) < SHOWN and sum(r.section == remark.section for r in first) < MOST_OF_ONE_SECTION:
            first.append(remark)
    rest = [remark for remark in seen.values() if remark not in first]
    while len(first) < SHOWN and rest:
        first.append(rest.pop(0))

    def listed(part: list[Remark]) -> list[dict[str, str]]:
        return [
            {"sentence": _tidy(r.sentence), "section": r.section, "heading": words(f"sections.{r.section}")}
            for r in part
        ]

    return {"items": listed(first), "more": listed(rest)}


def _tidy(sentence: str) -> str:
    """A warning of a stage as a sentence of the page."""
    sentence = sentence.strip()
    return sentence[:1].upper() + sentence[1:] + ("" if sentence.endswith((".", "!", "?")) else ".")


def _warnings(inputs: ReportInputs) -> list[Remark]:
    told = (inputs.log_facts.get("recovery") or {}).get(
        "sentence"
    )  # the list has it already, with the seconds
    remarks = []
    for stage, manifest in inputs.manifests.items():
        for sentence in map(str, manifest.get("warnings") or ()):
            section = SECTION_OF_STAGE.get(stage, "provenance")
            if sentence != told:
                remarks.append(Remark(SERIOUS, sentence, _statics_or(section, sentence)))
    for sentence in map(str, inputs.solution.get("warnings") or ()):
        remarks.append(Remark(SERIOUS, sentence, _statics_or("quality", sentence)))
    return remarks


def _statics_or(section: str, sentence: str) -> str:
    return "statics" if section == "quality" and " from its file value" in sentence else section


def _of_log(inputs: ReportInputs, words: Words) -> list[Remark]:
    recovery = inputs.log_facts.get("recovery") or {}
    if recovery.get("complete", True):
        return []
    seconds = recovery.get("lost_seconds")
    said = duration_text(seconds) if seconds is not None else words("page.unknown")
    sentence = str(recovery.get("sentence") or "")
    return [Remark(GRAVE, words("attention.lost", seconds=said, sentence=sentence).strip(), "coverage")]


def _of_stations(inputs: ReportInputs, units: Units, words: Words) -> list[Remark]:
    stations = inputs.table("stations")
    if stations is None:
        return []
    verdict, deviation, u = stations["verdict"], stations["deviation"], stations["expanded_uncertainty"]
    remarks = []
    failed = np.flatnonzero(verdict == "FAIL")
    if len(failed):
        # A station may fail by a side alone: its level is then no reason to give.
        tolerance = inputs.site.tolerance
        high, low = deviation - u > tolerance.high_mm / 1000, deviation + u < -tolerance.low_mm / 1000
        by_level = failed[(high | low)[failed]]
        if len(by_level):
            worst = by_level[np.argmax(np.abs(deviation[by_level]))]
            sentence = words(
                "attention.fail",
                n=len(failed),
                all=len(verdict),
                station=station_text(stations["station"][worst], units),
                deviation=deviation_text(deviation[worst], units),
                u=deviation_text(u[worst], units, signed=False),
                side=words("summary.high" if deviation[worst] > 0 else "summary.low"),
            )
        else:
            sentence = words(
                "attention.fail_side",
                n=len(failed),
                all=len(verdict),
                station=station_text(stations["station"][failed[0]], units),
                reason=stations["reason"][failed[0]],
            )
        remarks.append(Remark(GRAVE, sentence, "stations"))
    # U = k sigma against the wider half of the tolerance's width: beyond it no deviation at all could pass.
    incapable = np.flatnonzero(u > (inputs.site.tolerance.high_mm + inputs.site.tolerance.low_mm) / 2000)
    if len(incapable):
        sentence = words(
            "attention.not_capable",
            n=len(incapable),
            all=len(verdict),
            u=deviation_text(float(np.median(u[incapable])), units, signed=False),
        )
        remarks.append(Remark(GRAVE, sentence, "error_budget"))
    if unsure := int((verdict == "CANNOT TELL").sum()):
        sentence = words("attention.cannot_tell", n=unsure, all=len(verdict))
        if inputs.site.tolerance.wide_mm is not None:
            sentence += " " + words("attention.unsure_side")
        remarks.append(Remark(SERIOUS, sentence, "stations"))
    gone = np.flatnonzero(verdict == "NOT REACHED")
    if len(gone):
        sentence = words(
            "attention.not_reached",
            n=len(gone),
            all=len(verdict),
            spans=_spans(stations["station"], gone, units, words),
        )
        remarks.append(Remark(SERIOUS, sentence, "stations"))
    if partly := int((stations["state"] == "partly cut").sum()):
        remarks.append(Remark(WORTH, words("attention.partly", n=partly, all=len(verdict)), "stations"))
    return remarks


def _spans(station: np.ndarray, rows: np.ndarray, units: Units, words: Words) -> str:
    """Runs of neighbouring stations in words, at most three."""
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    said = [
        words(
            "attention.span",
            first=text_of(float(units.to_length(station[run[0]])), units.station_digits),
            last=station_text(station[run[-1]], units),
        )
        if len(run) > 1
        else station_text(station[run[0]], units)
        for run in runs[:3]
    ]
    return ", ".join(said) + (", …" if len(runs) > 3 else "")


def _of_causes(inputs: ReportInputs, units: Units, words: Words) -> list[Remark]:
    found = (inputs.survey.get("checks") or {}).get("diagnosis") or {}
    if found.get("state") not in ("named", "cannot tell"):
        return []
    best = found["candidates"][0]
    key = "attention.cause" if found["state"] == "named" else "attention.cause_unclear"
    sentence = words(key, cause=cause_text(best, words), value=value_text(best, units, words))
    return [Remark(GRAVE, sentence, "checks")]


def no_statistics(inputs: ReportInputs, words: Words) -> str:
    """Why there are no statistics of floor shots: no shot at all could be compared, or only other kinds."""
    checks = inputs.table("checks")
    others = checks is not None and bool(counted(checks, None).any())
    return words("attention.no_floor_checks" if others else "attention.no_checks")


def _of_checks(inputs: ReportInputs, words: Words, statistics: dict[str, Number] | None) -> list[Remark]:
    checks = inputs.table("checks")
    if statistics is None or checks is None:
        remarks = [Remark(SERIOUS, no_statistics(inputs, words), "checks")]
    else:
        remarks = []
    if checks is None:
        return remarks
    z = checks["z"][counted(checks, None)]
    if off := int((np.abs(z) > CHECK_OFF_SIGMAS).sum()):
        remarks.append(Remark(GRAVE, words("attention.check_off", n=off, all=len(z)), "checks"))
    value = None if statistics is None else statistics["reduced_chi_square"]["value"]
    if value is not None and value > CHI_SQUARE_HIGH:
        remarks.append(Remark(SERIOUS, words("attention.chi_square", value=text_of(value, 2)), "checks"))
    return remarks


def _of_stroke(inputs: ReportInputs, words: Words) -> list[Remark]:
    """Sensors that were read where their curve is only extrapolated."""
    return [
        Remark(
            SERIOUS,
            words(
                "attention.beyond_stroke",
                sensor=name,
                n=found["beyond"],
                all=found["readings"],
                low=text_of(found["stroke"][0], 3),
                high=text_of(found["stroke"][1], 3),
                least=text_of(found["least"], 3),
                most=text_of(found["most"], 3),
                date=found["calibrated"],
            ),
            "provenance",
        )
        for name, found in (inputs.solution.get("beyond_stroke") or {}).items()
    ]


def _of_network(inputs: ReportInputs, words: Words) -> list[Remark]:
    remarks = []
    residuals = inputs.table("residuals")
    if residuals is not None:
        unseen = sorted(set(inputs.site.benchmarks) - set(residuals["marker"].tolist()))
        if unseen:
            sentence = words("attention.benchmark_unseen", names=", ".join(unseen))
            remarks.append(Remark(SERIOUS, sentence, "quality"))
    statics = inputs.table("statics")
    if statics is not None:
        told = " ".join(map(str, inputs.solution.get("warnings") or ()))
        shift = np.nan_to_num(statics["shift_sigmas"])
        moved = [i for i in np.argsort(-np.abs(shift), kind="stable") if abs(shift[i]) > MOVED_SIGMAS]
        moved = [i for i in moved if str(statics["quantity"][i]) not in told]
        if moved:
            sentence = words(
                "attention.static_moved",
                n=len(moved),
                quantity=f"{statics['quantity'][moved[0]]} {statics['component'][moved[0]]}",
                sigmas=text_of(float(shift[moved[0]]), 1, signed=True),
            )
            remarks.append(Remark(WORTH, sentence, "statics"))
    return remarks


def _of_coverage(inputs: ReportInputs, words: Words, timeline: Timeline | None) -> list[Remark]:
    if timeline is None:
        return []
    remarks = []
    silent = [camera for camera, tags in timeline.accepted.items() if tags.sum() == 0]
    if silent:
        sentence = words("attention.camera_silent", names=", ".join(silent))
        remarks.append(Remark(SERIOUS, sentence, "coverage"))
    if timeline.bridged_s > BRIDGED_WORTH_S:
        sentence = words(
            "attention.bridged", seconds=duration_text(timeline.bridged_s), n=len(timeline.gaps_ns)
        )
        remarks.append(Remark(WORTH, sentence, "coverage"))
    return remarks
