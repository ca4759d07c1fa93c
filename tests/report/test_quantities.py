"""Chainage, volumes, sides and wanted shots as the page prints them, in metres and in feet."""

import copy

import numpy as np
import pytest

from pipeline.report.page import render
from pipeline.report.units import units_of
from tests.report.conftest import METRES, made_up_inputs

CUBIC_YARD_M3 = 0.9144**3


@pytest.fixture(scope="module", params=["m", "international_foot", "us_survey_foot"])
def made(request):
    return request.param, render(made_up_inputs(request.param))


def test_volumes_of_the_job_are_those_of_the_survey_in_the_unit_of_the_trade(made):
    unit, page = made
    rows = page.content["quantities"]["volumes"]["rows"]
    per_m3 = 1.0 if unit == "m" else 1 / CUBIC_YARD_M3
    # A cubic yard of US survey feet is 6 parts in a million larger.
    np.testing.assert_allclose(
        [r["volume"] for r in rows], np.array([38.05, 3.125, 2.5, 0.18]) * per_m3, rtol=1e-5, atol=1e-5
    )
    np.testing.assert_allclose(rows[0]["sigma"], 0.05 * per_m3, rtol=1e-3)
    assert rows[2]["sigma"] is None
    assert page.content["quantities"]["volumes"]["columns"][1]["unit"] == ("m³" if unit == "m" else "cu yd")


def test_chainage_and_its_gaps_are_told(made):
    unit, page = made
    reach = {entry["key"]: entry["number"]["value"] for entry in page.content["quantities"]["reach"]}
    scale = METRES[unit]
    np.testing.assert_allclose(
        [reach[k] for k in ("first", "last", "dug")], np.array([100, 116.5, 16]) / scale, atol=1e-4
    )
    assert reach["uncut"] == pytest.approx(0.6 / scale**2, rel=1e-4)
    assert f"{108.0 / scale:.2f} to {108.5 / scale:.2f}" in page.content["quantities"]["gaps"]


def test_sides_have_u_of_both_parts_and_a_verdict_where_there_is_a_tolerance(made):
    unit, page = made
    units = units_of(unit, METRES[unit])
    first = page.content["sides"]["rows"][0]
    assert first["u_left"] == pytest.approx(float(units.to_deviation(2 * 0.005)), rel=1e-3)
    assert first["verdict_left"] == "PASS"
    one_sided = [row for row in page.content["sides"]["rows"] if row["right"] is None]
    assert len(one_sided) == 1 and one_sided[0]["left"] is not None
    assert len(page.content["sides"]["rows"]) == 33


def test_without_a_tolerance_the_sides_have_no_verdict_and_without_a_ground_the_page_says_so():
    inputs = made_up_inputs()
    inputs.survey["side_tolerance"] = None
    page = render(inputs)
    assert not any(c["key"].startswith("verdict") for c in page.content["sides"]["columns"])
    assert "site.toml gives no [ground]" in page.content["quantities"]["note"]


def test_the_shots_to_take_stand_with_what_they_would_settle(made):
    unit, page = made
    wanted = page.content["wanted"]
    assert [row["settles"] for row in wanted["shots"]["rows"]] == [0.75, 1.25]
    assert wanted["shots"]["rows"][0]["station"] == pytest.approx(110.25 / METRES[unit], abs=1e-4)
    assert "their level: 2" in wanted["sentence"] and "about 1.5" in wanted["sentence"]
    assert "only part of their floor was cut: 1" in wanted["sentence"]


@pytest.mark.parametrize(
    ("open_", "partly", "said"),
    [(3, 0, "as much as a quarter of one"), (0, 0, "None is needed"), (0, 2, "None is needed")],
)
def test_where_no_shot_helps_the_page_says_why(open_, partly, said):
    inputs = made_up_inputs()
    survey = copy.deepcopy(inputs.survey)
    survey["wanted_shots"] |= {"shots": [], "open": open_, "partly": partly}
    inputs.survey.update(survey)
    wanted = render(inputs).content["wanted"]
    assert wanted["shots"] is None and said in wanted["sentence"]
    assert ("digging does" in wanted["sentence"]) == (partly > 0)


def test_the_width_of_the_floor_stands_beside_its_sides(made):
    unit, page = made
    units = units_of(unit, METRES[unit])
    row = page.content["sides"]["rows"][0]
    outward = float(np.sum([0.02 * np.sin(100.25), 0.015 * np.cos(100.25)]))
    assert row["width"] == pytest.approx((1.2 + outward) / METRES[unit], abs=1e-5)
    assert row["u_width"] == pytest.approx(float(units.to_deviation(2 * 0.0057)), rel=1e-3)


def test_each_station_has_its_common_error_by_source_and_what_brings_nothing_is_left_out(made):
    unit, page = made
    units = units_of(unit, METRES[unit])
    table = page.content["error_budget_by_station"]
    assert [c["key"] for c in table["columns"]] == ["station", "benchmarks", "mounts"]
    assert len(table["rows"]) == 33
    assert table["rows"][5]["benchmarks"] == pytest.approx(float(units.to_deviation(0.0036)), rel=1e-3)
