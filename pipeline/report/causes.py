"""What the check shots say: statistics by kind, and which one cause would explain their differences, in sentences."""

from __future__ import annotations

from typing import Any

from pipeline.report import numbers
from pipeline.report.facts import deviation_text
from pipeline.report.inputs import ReportInputs
from pipeline.report.numbers import column
from pipeline.report.units import Units, text_of
from pipeline.report.words import Words

MILLISECONDS = 1000.0
LIKELY = 0.05
"""What is left agrees with the stated uncertainties above this."""


def kinds_table(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Statistics of each kind of check, or None without any shot."""
    kinds = (inputs.survey.get("checks") or {}).get("kinds") or {}
    if not kinds:
        return None
    fall, fine = units.deviation, units.fine_digits
    columns = [
        column("kind", words("columns.check_kind")),
        column("shots", words("columns.shots"), "", 0),
        column("n", words("statistics.n"), "", 0),
        column("bias", words("statistics.bias"), fall, fine, signed=True),
        column("rmse", words("statistics.rmse"), fall, fine),
        column("worst", words("statistics.worst"), fall, fine, signed=True),
        column("horizontal_rmse", words("columns.horizontal_rmse"), fall, fine),
        column("reduced_chi_square", words("statistics.reduced_chi_square"), "", 2),
        column("p_value", words("columns.p_value"), "", 3),
    ]
    rows = []
    for kind, found in kinds.items():
        shown = {key: found.get(key) for key in ("shots", "n", "reduced_chi_square")}
        for key in ("bias", "rmse", "worst", "horizontal_rmse"):
            shown[key] = None if found.get(key) is None else units.to_deviation(found[key])
        shown["p_value"] = (found.get("global_test") or {}).get("p_value")
        rows.append({"kind": words(f"check_kinds.{kind}"), **shown})
    return numbers.table(columns, rows)


def diagnosis(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Sentences on the one cause that would explain the differences, and the table of all; None without shots."""
    found = (inputs.survey.get("checks") or {}).get("diagnosis")
    if not found:
        return None
    candidates = found["candidates"]
    p = _chance(found["global_test"]["p_value"])
    best = candidates[0] if candidates else {}
    places = {
        "n": len(candidates),
        "p": p,
        "critical": text_of(found["critical"], 1),
        "w": text_of(abs(best["w"]) if best else None, 1),
    }
    state = str(found["state"]).replace(" ", "_")
    sentences = []
    if state in ("none", "unexplained"):
        sentences.append(words(f"causes.{state}", **places))
    else:
        sentences.append(
            words(
                f"causes.{state}",
                cause=cause_text(best, words),
                value=value_text(best, units, words),
                sigma=_size(best, best["sigma"], units),
                **places,
            )
        )
    if state == "cannot_tell":
        rivals = [
            words("causes.rival", cause=cause_text(rival, words), value=value_text(rival, units, words))
            for rival in found["rivals"]
        ]
        sentences.append(words("causes.rivals", rivals="; ".join(rivals)))
        sentences.append(_telling(found, units, words))
    if state in ("named", "cannot_tell"):
        left = best["left_p_value"]
        key = "causes.left_agrees" if left is not None and left >= LIKELY else "causes.left_over"
        sentences += [words(key, p=_chance(left)), words("causes.never_applied")]
    if not found["common_factors"]:
        sentences.append(words("causes.no_factors"))
    return {
        "state": found["state"],
        "sentences": sentences,
        "table": _table(candidates, units, words),
    }


def cause_text(candidate: dict[str, Any], words: Words) -> str:
    """The cause by name, such as "benchmark B2"."""
    return words(f"causes.names.{candidate['kind'].replace(' ', '_')}", name=candidate["name"])


def value_text(candidate: dict[str, Any], units: Units, words: Words) -> str:
    """The size and the sense of a cause: "teeth 12.0 mm shorter than the file says"."""
    key = f"causes.values.{candidate['kind'].replace(' ', '_')}"
    if candidate["kind"] in ("benchmark", "datum"):
        key += f"_{candidate['component']}"
    key += "_more" if candidate["value"] >= 0 else "_less"
    return words(key, value=_size(candidate, abs(candidate["value"]), units))


def _telling(found: dict[str, Any], units: Units, words: Words) -> str:
    shot = found["telling_shot"]
    if shot is None:
        return words("causes.no_shot_tells")
    return words(
        f"causes.shot_{shot['kind']}",
        station=f"{text_of(float(units.to_length(shot['station'])), units.station_digits)} {units.length}",
        offset=f"{text_of(float(units.to_length(shot['offset'])), units.station_digits, True)} {units.length}",
        time=numbers.utc_text(shot["time_ns"]),
        axis=words(f"causes.axes.{shot['axis']}"),
        first=deviation_text(shot["first"], units, fine=True),
        second=deviation_text(shot["second"], units, fine=True),
        first_cause=cause_text(found["candidates"][0], words),
        second_cause=cause_text(found["rivals"][0], words),
    )


def _table(candidates: list[dict[str, Any]], units: Units, words: Words) -> dict[str, Any]:
    digits = max(2, units.fine_digits)
    columns = [
        column("cause", words("columns.cause")),
        column("component", words("columns.component")),
        column("unit", words("columns.unit")),
        column("value", words("columns.cause_value"), "", digits, signed=True),
        column("sigma", words("columns.sigma"), "", digits),
        column("w", words("columns.w"), "", 1, signed=True),
        column("left_p_value", words("columns.left_p_value"), "", 3),
        column("seen_from", words("columns.seen_from"), "", digits),
        column("told_from", words("columns.told_from"), "", digits),
    ]
    rows = []
    for candidate in candidates:
        unit, factor = _unit(candidate, units)
        scaled = {
            key: None if candidate[key] is None else factor * candidate[key]
            for key in ("value", "sigma", "seen_from", "told_from")
        }
        component = candidate["component"]
        rows.append(
            {
                "cause": cause_text(candidate, words),
                "component": words(f"causes.axes.{component}") if component else "",
                "unit": unit,
                "w": candidate["w"],
                "left_p_value": candidate["left_p_value"],
                **scaled,
            }
        )
    return numbers.table(columns, rows)


def _unit(candidate: dict[str, Any], units: Units) -> tuple[str, float]:
    """What a value is printed in, and what it is multiplied by."""
    if candidate["unit"] == "s":
        return "ms", MILLISECONDS
    return ("°", 1.0) if candidate["unit"] == "deg" else (units.deviation, float(units.to_deviation(1.0)))


def _size(candidate: dict[str, Any], value: float, units: Units) -> str:
    if candidate["unit"] == "m":
        return deviation_text(value, units, signed=False, fine=True)
    unit, factor = _unit(candidate, units)
    return f"{text_of(factor * value, 2)} {unit}"


def _chance(p_value: float | None) -> str:
    if p_value is not None and p_value < 0.001:
        return "< 0.001"
    return f"= {text_of(p_value, 3)}"
