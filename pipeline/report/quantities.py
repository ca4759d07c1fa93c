"""What was dug in figures: chainage, volumes, the sides of the trench, and where a surveyor should go next."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.report import numbers
from pipeline.report.facts import deviation_number, station_text
from pipeline.report.inputs import ReportInputs
from pipeline.report.numbers import column, number
from pipeline.report.units import Units, text_of
from pipeline.report.words import Words


def quantities(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Chainage and volumes of the job, volumes by station; None where the survey did not tell them."""
    found = inputs.survey.get("volumes")
    if not found:
        return None
    return {
        "reach": _reach(inputs, units, words),
        "gaps": _gaps(inputs, units, words),
        "volumes": _job_volumes(inputs, found, units, words),
        "note": words("quantities.no_ground") if inputs.site.ground is None else words("quantities.ground"),
        "by_station": _station_volumes(inputs, units, words),
    }


def _reach(inputs: ReportInputs, units: Units, words: Words) -> list[dict[str, Any]]:
    """First and last station that were dug and the length between, as labelled numbers."""
    reach = inputs.survey.get("reach") or {}
    entries = []
    for key in ("first", "last", "dug"):
        value = reach.get(key)
        shown = None if value is None else units.to_length(value)
        entries.append((key, number(shown, units.length, units.station_digits)))
    uncut = inputs.survey.get("uncut_floor")
    entries.append(("uncut", number(None if uncut is None else units.to_area(uncut), units.area, 2)))
    return [{"key": key, "label": words(f"quantities.{key}"), "number": value} for key, value in entries]


def _gaps(inputs: ReportInputs, units: Units, words: Words) -> str:
    """Stretches in between that were not dug, in one sentence."""
    gaps = (inputs.survey.get("reach") or {}).get("gaps") or []
    if not gaps:
        return words("quantities.no_gaps")
    said = [
        words(
            "attention.span",
            first=text_of(float(units.to_length(first)), units.station_digits),
            last=station_text(last, units),
        )
        for first, last in gaps[:10]
    ]
    return words("quantities.gaps", n=len(gaps), spans=", ".join(said) + (", …" if len(gaps) > 10 else ""))


def _volume_columns(units: Units, words: Words) -> list[dict[str, Any]]:
    return [
        column("kind", words("columns.volume_kind")),
        column("volume", words("columns.volume"), units.volume, units.volume_digits),
        column("sigma", words("columns.sigma"), units.volume, units.volume_digits),
        column("sigma_own", words("columns.sigma_own"), units.volume, units.volume_digits),
        column("sigma_common", words("columns.sigma_common"), units.volume, units.volume_digits),
        column("area", words("columns.area"), units.area, 2),
    ]


def _job_volumes(inputs: ReportInputs, found: list[dict], units: Units, words: Words) -> dict[str, Any]:
    rows = []
    for volume in found:
        own, common = volume["sigma_own"], volume["sigma_common"]
        told = volume["m3"] is not None
        rows.append(
            {
                "kind": words(f"volumes.{volume['kind'].replace(' ', '_')}"),
                "volume": units.to_volume(volume["m3"]) if told else None,
                "sigma": units.to_volume(np.hypot(own, common)) if told else None,
                "sigma_own": units.to_volume(own) if told else None,
                "sigma_common": units.to_volume(common) if told else None,
                "area": units.to_area(volume["area"]),
            }
        )
    elsewhere = inputs.survey.get("left_where_not_cut")
    if elsewhere is not None:
        # Below the volume it is a part of.
        of_left = [volume["kind"] for volume in found].index("left to cut") + 1
        rows.insert(
            of_left, {"kind": words("volumes.left_where_not_cut"), "volume": units.to_volume(elsewhere)}
        )
    return numbers.table(_volume_columns(units, words), rows)


def _station_volumes(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Volumes of the stations of which something was cut."""
    table = inputs.table("volumes")
    if table is None:
        return None
    columns = [column("station", words("columns.station"), units.length, units.station_digits)]
    kinds = {"cut": "cut", "left to cut": "left", "over-dug": "over"}
    for kind, key in kinds.items():
        label = words(f"volumes.{kind.replace(' ', '_')}")
        columns.append(column(key, label, units.volume, units.volume_digits))
        columns.append(
            column(f"sigma_{key}", words("columns.sigma_of", what=label), units.volume, units.volume_digits)
        )
    rows = []
    dug = set(np.unique(table["station"][(table["area"] > 0)]).tolist())
    for station in sorted(dug):
        row: dict[str, Any] = {"station": units.to_length(station)}
        for i in np.flatnonzero(table["station"] == station):
            key = kinds[str(table["kind"][i])]
            row[key] = units.to_volume(table["volume"][i])
            row[f"sigma_{key}"] = units.to_volume(np.hypot(table["sigma_own"][i], table["sigma_common"][i]))
        rows.append(row)
    return numbers.table(columns, rows)


def sides_table(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Width and sides of the stations where at least one side is told; None where none is."""
    table = inputs.table("sides")
    if table is None:
        return None
    fall, digits = units.deviation, units.deviation_digits
    judged = bool(inputs.survey.get("side_tolerance"))
    columns = [column("station", words("columns.station"), units.length, units.station_digits)]
    for side in ("left", "right"):
        named = words(f"columns.side_{side}")
        columns += [
            column(side, words(f"columns.{side}"), fall, digits, signed=True),
            column(f"u_{side}", words("columns.u_side", side=named), fall, digits),
            *(
                [column(f"verdict_{side}", words("columns.verdict_side", side=named), kind="judged")]
                if judged
                else []
            ),
            column(f"slope_{side}", words("columns.slope_side", side=named), "", 2),
        ]
    columns += [
        column("width", words("columns.floor_width"), units.length, units.length_digits),
        column("u_width", words("columns.u_width"), fall, digits),
    ]
    k = inputs.site.tolerance.coverage_factor
    rows = []
    at: dict[float, dict[str, Any]] = {}
    for i in range(len(table["station"])):
        side = str(table["side"][i])
        row = at.setdefault(
            float(table["station"][i]), {"station": units.to_length(float(table["station"][i]))}
        )
        row[side] = units.to_deviation(table["outward"][i])
        row[f"u_{side}"] = units.to_deviation(k * np.hypot(table["sigma_own"][i], table["sigma_common"][i]))
        row[f"verdict_{side}"] = table["verdict"][i]
        row[f"slope_{side}"] = table["slope"][i]
        row["width"] = units.to_length(table["width"][i])
        row["u_width"] = units.to_deviation(k * table["sigma_width"][i])
    for row in at.values():
        if np.isfinite(row["left"]) or np.isfinite(row["right"]):
            rows.append(row)
    return numbers.table(columns, rows) if rows else None


def wanted_shots(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Where total-station shots would settle most, with the sentence that says what they would bring."""
    found = inputs.survey.get("wanted_shots")
    if not found:
        return None
    columns = [
        column("order", words("columns.order"), "", 0),
        column("station", words("columns.station"), units.length, units.station_digits),
        column("settles", words("columns.settles"), "", 1),
    ]
    rows = [
        {"order": i, "station": units.to_length(shot["station"]), "settles": shot["settles"]}
        for i, shot in enumerate(found["shots"], 1)
    ]
    sigma = deviation_number(found["sigma_shot"], units, signed=False, fine=True)
    places = {
        "open": found["open"],
        "partly": found["partly"],
        "sigma": f"{text_of(sigma['value'], sigma['digits'])} {sigma['unit']}",
        "best": text_of(found["best_alone"], 1),
    }
    if rows:
        sentence = words("wanted.sentence", **places)
    elif found["open"]:
        sentence = words("wanted.hopeless", **places)
    else:
        sentence = words("wanted.none")
    if found["partly"]:
        sentence += " " + words("wanted.partly", **places)
    return {"sentence": sentence, "shots": numbers.table(columns, rows) if rows else None}
