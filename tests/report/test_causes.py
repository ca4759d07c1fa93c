"""What the page says of kinds of checks and of causes: the numbers of survey.json, in sentences and tables."""

import pytest

from pipeline.report.causes import diagnosis, kinds_table
from pipeline.report.units import units_of
from pipeline.report.words import Words
from tests.report.conftest import candidate, made_up_inputs

WORDS, METRES = Words(), units_of("m", 1.0)


def said(units=METRES, unit="m", **changed):
    inputs = made_up_inputs(unit)
    inputs.survey["checks"]["diagnosis"] |= changed
    return diagnosis(inputs, units, WORDS)


def test_a_named_cause_is_said_with_its_size_sense_and_test_and_as_a_proposal():
    found = said()
    assert found["sentences"][0] == (
        "One cause would explain the differences, tooth wear: teeth 12 mm shorter than the file says (sigma 2 mm). Its "
        "test is passed at 6.0 sigmas, 2.6 needed, and no other cause does as well."
    )
    assert found["sentences"][1] == "What it leaves agrees with the stated uncertainties (p = 0.400)."
    assert "nothing was changed" in found["sentences"][2]
    assert (
        "does not explain everything"
        in said(candidates=[candidate("wear") | {"left_p_value": 0.01}])["sentences"][1]
    )


@pytest.mark.parametrize(
    "cause, sentence",
    [
        (candidate("wear", value=-0.0042), "teeth 4.2 mm longer than the file says"),
        (candidate("sensor", "pot", unit="deg", value=0.314), "its curve should lie 0.31 ° higher"),
        (candidate("sensor", "pot", value=-0.0021), "its curve should lie 2.1 mm lower"),
        (candidate("time offset", "pot", unit="s", value=0.0301), "its offset should be 30.10 ms more"),
        (candidate("benchmark", "B2", "n", value=-0.03), "benchmark B2: it stands 30 mm south of where the file"),
        (candidate("benchmark", "B2", "h", value=0.0145), "it stands 14.5 mm higher than the file has it"),
        (candidate("datum", component="h", value=0.011), "the job's heights lie 11 mm too high against those"),
    ],
)  # fmt: skip
def test_the_sense_of_each_cause_is_in_words(cause, sentence):
    assert sentence in said(candidates=[cause])["sentences"][0]


def test_two_causes_that_cannot_be_told_apart_are_both_said_with_the_shot_that_would_tell():
    rival = candidate("datum", component="h", value=-0.011, w=-5.5)
    shot = {"kind": "edge", "station": 104.5, "offset": -0.25, "time_ns": 1_767_225_600 * 10**9, "axis": "n",
            "first": 0.012, "second": 0.0, "apart_sigmas": 5.0}  # fmt: skip
    text = " ".join(said(state="cannot tell", rivals=[rival], telling_shot=shot)["sentences"])
    assert "do not tell what. tooth wear would explain" in text
    assert "As well would: the survey's datum (the job's heights lie 11 mm too low" in text
    assert (
        "parked as it stood at 2026-01-01 00:00:00 UTC (station 104.50 m, offset \N{MINUS SIGN}0.25 m)"
        in text
    )
    assert "tooth wear lets ours minus total station be +12 mm in northing, the survey's datum 0 mm" in text
    assert "No single further shot" in " ".join(said(state="cannot tell", rivals=[rival])["sentences"])


def test_where_nothing_is_wrong_no_cause_is_said():
    found = said(state="none", global_test={"statistic": 7.0, "components": 8, "p_value": 0.54})
    assert (
        len(found["sentences"]) == 1
        and "agree with the stated uncertainties (p = 0.540)" in found["sentences"][0]
    )
    assert "no single cause explains them" in said(state="unexplained")["sentences"][0]
    assert "published no common errors" in said(state="none", common_factors=False)["sentences"][-1]


def test_values_stand_in_the_table_in_the_units_of_the_site():
    rows = said()["table"]["rows"]
    assert [row["unit"] for row in rows] == ["mm", "ms", "°", "mm", "mm"]
    assert [row["value"] for row in rows] == pytest.approx([12.0, -20.0, 0.31, 30.0, -3.0])
    assert rows[0]["seen_from"] == pytest.approx(8.0) and rows[0]["told_from"] is None
    feet = units_of("international_foot", 0.3048)
    row = said(feet, "international_foot")["table"]["rows"][0]
    assert row["unit"] == "ft" and row["value"] == pytest.approx(0.012 / 0.3048, abs=1e-5)


def test_each_kind_of_check_has_its_own_statistics():
    rows = kinds_table(made_up_inputs(), METRES, WORDS)["rows"]
    assert [(row["kind"], row["shots"], row["n"]) for row in rows] == [
        ("trench floor", 9, 8),
        ("bucket on a known point", 2, 1),
    ]
    assert rows[0]["rmse"] == pytest.approx(4.9) and rows[0]["horizontal_rmse"] is None
    assert rows[1]["horizontal_rmse"] == pytest.approx(4.0) and rows[1]["p_value"] == pytest.approx(0.3329)
