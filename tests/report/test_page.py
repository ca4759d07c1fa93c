"""The page is sound HTML, asks for nothing, hides nothing, and its numbers are those of report.json and the tables."""

import dataclasses
import datetime
import html
import json
import re

import numpy as np
import pytest

from pipeline.config.quantities import Calibrated
from pipeline.report import palette, render
from pipeline.report.facts import gaps_of
from tests.report.conftest import HOSTILE, made_up_inputs
from tests.report.pages import PageReader, as_float, at_path

NO_MATCH_SVG = re.compile(r"<svg .*?</svg>", re.S)


@pytest.fixture(scope="module")
def page():
    return render(made_up_inputs())


@pytest.fixture(scope="module")
def read(page):
    return PageReader(page.html)


def test_the_same_inputs_give_the_same_bytes(page):
    again = render(made_up_inputs())
    assert again.html == page.html
    assert json.dumps(again.content) == json.dumps(page.content)


def test_the_page_is_small(page):
    assert len(page.html.encode()) < 3_000_000


def test_the_page_is_balanced_and_its_ids_are_unique(read):
    assert read.faults == []
    assert len(set(read.ids)) == len(read.ids)


def test_a_browser_grade_parser_finds_no_fault(page):
    html5lib = pytest.importorskip("html5lib")
    parser = html5lib.HTMLParser(strict=False)
    parser.parse(page.html)
    # HTML knows no prefixes inside SVG; nothing else may be wrong.
    assert parser.errors == []


def test_nothing_on_the_page_points_outside(page, read):
    assert all(
        ref.startswith(("#", "data:image/png;base64,", "data:image/jpeg;base64,")) for ref in read.references
    ), read.references
    assert re.findall(r"url\((?!#)", page.html) == []
    assert "@import" not in page.html
    assert not [
        tag for tag, _ in read.tags if tag in ("script", "link", "iframe", "object", "img", "base", "form")
    ]
    assert not [name for _, found in read.tags for name in found if name.startswith("on")]


def test_every_link_inside_the_page_has_its_target(read):
    targets = {ref[1:] for ref in read.references if ref.startswith("#")}
    assert targets <= set(read.ids)


def test_every_label_names_an_element_that_is_there(read):
    for tag, found in read.tags:
        for name in ("aria-labelledby", "aria-describedby"):
            for target in (found.get(name) or "").split():
                assert target in read.ids, (tag, target)


def test_every_figure_is_described_and_says_what_good_looks_like(page, read):
    pictures = [found for tag, found in read.tags if tag == "svg"]
    drawn = [name for name, about in page.content["figures"].items() if not about["why"]]
    assert len(pictures) == len(drawn) == 15
    assert all(found.get("role") == "img" and found.get("aria-labelledby") for found in pictures)
    for name in drawn:
        about = page.content["figures"][name]
        assert about["good"].startswith("Good:") and len(about["description"]) > 20


def test_headings_go_down_one_step_at_a_time(read):
    assert read.headings[0] == 1 and read.headings.count(1) == 1
    assert all(after - before <= 1 for before, after in zip(read.headings[:-1], read.headings[1:]))


def test_tables_have_scoped_heads_and_captions(read):
    assert all(found.get("scope") in ("col", "row") for tag, found in read.tags if tag == "th")
    count = sum(tag == "table" for tag, _ in read.tags)
    assert (
        count == sum(tag == "caption" for tag, _ in read.tags) == sum(tag == "thead" for tag, _ in read.tags)
    )


def test_landmarks_language_and_a_way_past_the_head(read):
    tags = [tag for tag, _ in read.tags]
    assert [tags.count(name) for name in ("html", "header", "main", "nav", "footer", "h1")] == [1] * 6
    assert dict(read.tags)["html"]["lang"] == "en"
    first_link = next(found for tag, found in read.tags if tag == "a")
    assert first_link["href"] == "#report"


def test_hostile_names_are_text(page, read):
    assert "<script" not in page.html
    points = [row[0] for row in read.tables["checks"]]
    assert " ".join(HOSTILE.split()) in points


def test_hostile_names_in_figures_are_text():
    """As point id of a shot that is drawn, as benchmark and as camera they go through matplotlib."""
    inputs = made_up_inputs()
    inputs.tables["checks"]["point"][0] = "<b>&"
    html = render(inputs).html
    assert "<b>" not in html
    assert PageReader(html).faults == []


def test_every_number_on_the_page_is_the_one_in_report_json(page, read):
    assert len(read.numbers) >= 15
    for key, (raw, shown) in read.numbers.items():
        entry = at_path(page.content, key)
        assert raw == ("" if entry["value"] is None else repr(entry["value"])), key
        printed = as_float(shown.replace("+", ""))
        if entry["value"] is None:
            assert printed is None
        else:
            assert printed == pytest.approx(entry["value"], abs=0.5001 * 10.0 ** -entry["digits"]), key


def test_every_table_on_the_page_is_the_one_in_report_json(page, read):
    assert {"stations", "checks", "statics", "coverage.cameras", "provenance.files"} <= set(read.tables)
    for key, (head, *rows) in read.tables.items():
        table = at_path(page.content, key)
        assert len(head) == len(table["columns"])
        if not table["rows"]:
            continue
        assert len(rows) == len(table["rows"]), key
        for shown, expected in zip(rows, table["rows"]):
            for text, column in zip(shown, table["columns"]):
                value = expected[column["key"]]
                if column["digits"] is None:
                    assert " ".join(value.split()) in text
                elif value is None:
                    assert as_float(text) is None
                else:
                    limit = 0.5001 * 10.0 ** -column["digits"]
                    assert as_float(text) == pytest.approx(value, abs=limit), (key, column["key"])


@pytest.mark.parametrize("unit", ["m", "international_foot", "us_survey_foot"])
def test_stations_on_the_page_are_those_of_the_table(unit):
    """The factor is written out here, so that a wrong one in units.py cannot agree with itself."""
    feet = {"m": 1.0, "international_foot": 1 / 0.3048, "us_survey_foot": 3937 / 1200}[unit]
    inputs = made_up_inputs(unit)
    read = PageReader(render(inputs).html)
    rows = read.tables["stations"][1:] + read.tables.get("stations_beyond", [[]])[1:]
    stations = inputs.tables["stations"]
    assert len(rows) == len(stations["station"])
    keys = ("station", "verdict", "deviation", "h", "expanded_uncertainty", "sigma_own", "sigma_common")
    for row, station, verdict, deviation, h, u, own, common in zip(rows, *(stations[k] for k in keys)):
        assert as_float(row[0]) == pytest.approx(station * feet, abs=0.00501)
        assert row[1].endswith(verdict)
        if np.isnan(deviation):
            assert as_float(row[2]) is None
            continue
        fall, limit = (1000, 0.501) if unit == "m" else (feet, 0.00501)
        assert as_float(row[2]) == pytest.approx(deviation * fall, abs=limit)
        assert as_float(row[3]) == pytest.approx(u * fall, abs=limit)
        assert as_float(row[4]) == pytest.approx(h * feet, abs=0.000501)
        assert as_float(row[6]) == pytest.approx(own * fall, abs=limit)
        assert as_float(row[7]) == pytest.approx(common * fall, abs=limit)


def test_the_budget_stands_by_what_the_machine_was_doing(page):
    by_class = page.content["error_budget_by_class"]
    rows = {row["class"]: row for row in by_class["rows"]}
    assert list(rows) == ["digging", "bridged"]
    assert rows["bridged"]["own"] == 30.5  # mm
    assert rows["digging"]["sigma"] == 4.9
    assert rows["digging"]["lasts"] == 0.31  # s, of the own part alone
    assert "bridged" in page.html


def test_the_statistics_are_those_of_the_survey_stage(page):
    inputs = made_up_inputs()
    shown = {entry["key"]: entry["number"]["value"] for entry in page.content["check_statistics"]}
    assert shown["n"] == inputs.survey["checks"]["n"] == 8
    assert shown["rmse"] == pytest.approx(1000 * inputs.survey["checks"]["rmse"], abs=0.001)
    assert shown["bias"] == pytest.approx(1000 * inputs.survey["checks"]["bias"], abs=0.001)
    assert page.content["indicative"] is True
    assert "indicative only" in page.html


@pytest.mark.parametrize("verdict", ["PASS", "FAIL", "CANNOT TELL", "NOT REACHED"])
def test_a_verdict_is_a_word_a_symbol_and_a_colour(verdict):
    inputs = dataclasses.replace(made_up_inputs(), survey={**made_up_inputs().survey, "verdict": verdict})
    content = render(inputs).content["verdict"]
    style = palette.VERDICTS[verdict]
    assert (content["word"], content["symbol"], content["style"]) == (verdict, style.symbol, style.slug)
    others = [other for name, other in palette.VERDICTS.items() if name != verdict]
    assert all(style.symbol != other.symbol and style.marker != other.marker for other in others)


def test_every_verdict_of_a_station_stands_as_word_and_symbol(page, read):
    shown = {row[1] for row in read.tables["stations"][1:]} | {
        row[1] for row in read.tables["stations_beyond"][1:]
    }
    assert shown == {f"{style.symbol} {word}" for word, style in palette.VERDICTS.items()}


def test_at_most_five_remarks_stand_first_and_none_is_lost(page):
    attention = page.content["attention"]
    assert len(attention["items"]) == 5
    said = " ".join(item["sentence"] for item in attention["items"] + attention["more"])
    for word in (
        "14.2 s lost",
        "Out of tolerance: 2 of 36",
        "Cannot be decided: 2",
        "Not reached",
        "BM3",
        "BM2",
        "gaps: 1",
    ):
        assert word in said
    assert said.count("The recording ends") == 1


def test_remarks_link_to_sections_that_are_there(page, read):
    attention = page.content["attention"]
    assert {item["section"] for item in attention["items"] + attention["more"]} <= set(read.ids)


def test_an_unknown_measurement_is_named_when_u_exceeds_the_tolerance():
    inputs = made_up_inputs()
    inputs.tables["stations"]["expanded_uncertainty"][:5] = 0.060
    said = [item["sentence"] for item in render(inputs).content["attention"]["items"]]
    assert any("not capable at 5 of 36 stations" in sentence and "60 mm" in sentence for sentence in said)


def test_gaps_are_measured_from_the_last_seen_instant_to_the_next(page):
    # Frames 200 to 259 of five a second were not seen: from frame 199 to frame 260 are 12.2 s.
    assert page.content["coverage"]["bridged"]["value"] == pytest.approx(12.2)
    assert page.content["coverage"]["gap_count"]["value"] == 1


def test_time_without_epochs_is_a_gap_wherever_it_lies():
    second = 1_000_000_000
    stamps = np.array([10, 11, 12, 62, 63, 64]) * second
    gaps = gaps_of(stamps, np.ones(6, bool), (0, 70 * second), 1.5) / second
    assert gaps.tolist() == [[0, 10], [12, 62], [64, 70]]
    assert gaps_of(stamps[:3], np.array([1, 0, 1]), (10 * second, 12 * second), 5.0).tolist() == [
        [10 * second, 12 * second]
    ]


def test_a_run_without_anything_says_what_is_missing_and_why():
    whole = made_up_inputs()
    empty = dataclasses.replace(
        whole,
        tables={},
        detections={},
        survey={},
        solution={},
        log_facts={},
        alignment=None,
        moments=(),
        views=(),
        missing={"stations": "stations.parquet is missing or damaged", "survey.json": "it was never written"},
    )
    page = render(empty)
    read = PageReader(page.html)
    assert read.faults == []
    assert page.content["verdict"]["word"] == "NO VERDICT"
    assert "it was never written" in page.content["verdict"]["reason"]
    assert page.html.count("Not available:") >= 8
    assert "stations.parquet is missing or damaged" in page.html
    assert page.content["figures"]["plan"]["why"]


def test_a_trench_that_nobody_reached_has_a_page():
    inputs = made_up_inputs()
    stations, cells = inputs.tables["stations"], inputs.tables["as_built"]
    for name in ("h", "deviation", "sigma_own", "sigma_common", "expanded_uncertainty", "width"):
        stations[name][:] = np.nan
    stations["verdict"][:] = "NOT REACHED"
    stations["state"][:] = "not reached"
    for name in ("h", "h_lowest", "deviation", "sigma_own", "sigma_common"):
        cells[name][:] = np.nan
    cells["state"][:] = "never touched"
    page = render(inputs)
    assert PageReader(page.html).faults == []
    assert page.content["figures"]["cross_sections"]["why"]


def test_no_sentence_on_the_page_keeps_a_place_unfilled(page):
    text = NO_MATCH_SVG.sub("", page.html)
    text = re.sub(r"<style>.*?</style>", "", text, flags=re.S)
    assert re.findall(r"\{\w+\}", text) == []


def said(page):
    """Every sentence of report.json that stands on the page outside its tables."""
    content = page.content
    attention = content["attention"]
    sentences = [item["sentence"] for item in attention["items"] + attention["more"]]
    sentences += [entry["note"] for entry in content["summary"]] + content["evidence"]["moments"]
    sentences += [figure["description"] for figure in content["figures"].values()]
    return [sentence for sentence in sentences if sentence]


def test_every_sentence_of_report_json_stands_on_the_page(page):
    text = html.unescape(re.sub(r"<style>.*?</style>", "", page.html, flags=re.S))
    for sentence in said(page):
        assert sentence in text, sentence


def test_numbers_in_sentences_are_those_of_the_tables(page):
    """Counted and measured here from the inputs, not taken from what the page was made of."""
    inputs = made_up_inputs()
    stations, cells, checks = (inputs.tables[name] for name in ("stations", "as_built", "checks"))
    verdict, deviation = stations["verdict"], 1000 * stations["deviation"]
    worst = int(np.nanargmax(np.abs(deviation)))
    dug = np.isfinite(deviation)
    own, common = (1000 * np.nanmedian(stations[f"sigma_{part}"]) for part in ("own", "common"))
    on = np.isfinite(cells["deviation"])
    everything = " ".join(said(page)).replace("\u2212", "-")
    for expected in (
        f"Out of tolerance: {np.sum(verdict == 'FAIL')} of {len(verdict)} stations",
        f"the worst is {stations['station'][worst]:.2f} m with {deviation[worst]:+.0f} mm ± "
        f"{1000 * stations['expanded_uncertainty'][worst]:.0f} mm, high",
        f"Cannot be decided: {np.sum(verdict == 'CANNOT TELL')} of {len(verdict)}",
        f"Not reached by the cutting edge: {np.sum(verdict == 'NOT REACHED')} of {len(verdict)}",
        f"of {dug.sum()} dug, {len(verdict)} in the design",
        f"lowest {deviation[dug].min():+.0f} mm, highest {deviation[dug].max():+.0f} mm",
        f"Histogram of the deviation, as-built minus design, of {on.sum()} cut cells",
        "with the tolerance from -50 mm to +30 mm",
        f"of {np.isfinite(checks['z']).sum()} compared check shots",
        f"its own part (median {own:.3g} mm), its common part (median {common:.3g} mm)",
        "Beyond 20 mm no deviation could pass",  # (30 + 50) / 2 over k = 2
        "(1 gaps, 12.2 s in all)",
        "(1 spells, 20.0 s in all)",
        "with 2 accepted tags outlined",
    ):
        assert expected in everything, expected


@pytest.mark.parametrize("unit", ["international_foot", "us_survey_foot"])
def test_new_figures_of_a_site_in_feet_speak_in_feet(unit):
    feet = {"international_foot": 1 / 0.3048, "us_survey_foot": 3937 / 1200}[unit]
    content = render(made_up_inputs(unit)).content
    name = {"international_foot": "ft", "us_survey_foot": "US ft"}[unit]
    assert (
        f"Station {106.25 * feet:.2f} {name}, FAIL, deviation +{0.071 * feet:.3f} {name}"
        in (content["evidence"]["moments"][0])
    )
    assert content["figures"]["view_0"]["title"].startswith(f"Station {106.25 * feet:.2f} {name}")
    assert (
        f"Beyond {0.020 * feet:.3f} {name} no deviation" in content["figures"]["uncertainty"]["description"]
    )
    assert f"[{name}]" in content["cell_deviations"]["columns"][0]["label"]


def test_every_table_of_the_new_sections_is_held_against_report_json(read):
    """Those that the test of all tables must have met."""
    assert {
        "check_residuals",
        "cell_deviations",
        "coverage.idle",
        "coverage.gaps",
        "evidence.views.0.tags",
        "evidence.views.1.tags",
    } <= set(read.tables)
    assert {"coverage.idle_total", "coverage.idle_count"} <= set(read.numbers)


def test_a_station_that_fails_by_a_side_alone_is_told_with_the_side():
    inputs = made_up_inputs()
    stations = inputs.tables["stations"]
    stations["verdict"][:] = "PASS"
    stations["deviation"][:] = 0.001
    stations["verdict"][4], stations["reason"][4] = "FAIL", "the left side is too wide by at least 12 mm"
    attention = render(inputs).content["attention"]
    said = [item["sentence"] for item in attention["items"]]
    told = [one for one in said if one.startswith("Out of tolerance")]
    assert len(told) == 1
    assert told[0].startswith("Out of tolerance: 1 of 36 stations, by a side of the floor; at station 102.25")
    assert "too wide by at least 12 mm" in told[0]


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("control", "No shot of the trench floor could be compared"),
        (None, "No total-station shot stands against"),
    ],
)
def test_without_a_shot_of_the_floor_the_page_says_what_the_accuracy_rests_on(kind, said):
    inputs = made_up_inputs()
    checks = inputs.tables["checks"]
    inputs.survey["checks"]["n"] = 0
    if kind is None:
        inputs.tables["checks"] = {name: values[:0] for name, values in checks.items()}
    else:
        checks["kind"][:] = kind
    page = render(inputs)
    attention = page.content["attention"]
    sentences = [item["sentence"] for item in attention["items"] + attention["more"]]
    assert page.content["no_statistics"] in sentences
    assert page.content["no_statistics"].startswith(said)
    assert page.content["no_statistics"] in page.html


def test_calibrated_quantities_stand_with_their_age_on_the_day_of_the_log():
    inputs = made_up_inputs()
    assert render(inputs).content["provenance"]["calibrations"]["rows"] == []
    day = datetime.datetime.fromtimestamp(inputs.log_facts["start_ns"] / 1e9, datetime.UTC).date()
    told = Calibrated(
        date=day - datetime.timedelta(days=17), by="gradetrace calibrate cluster", source="c.mcap"
    )
    camera = inputs.machine.cameras["bench"]
    mount = camera.mount.model_copy(update={"calibrated": told})
    cameras = inputs.machine.cameras | {"bench": camera.model_copy(update={"mount": mount})}
    page = render(dataclasses.replace(inputs, machine=inputs.machine.model_copy(update={"cameras": cameras})))
    (row,) = page.content["provenance"]["calibrations"]["rows"]
    assert (row["what"], row["age"], row["source"]) == ("cameras.bench.mount", 17, "c.mcap")
    assert "cameras.bench.mount" in page.html
