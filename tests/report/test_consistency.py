"""The page says of changes, left-out benchmarks, halves and classes what solution.json holds; nothing without it."""

import copy
import dataclasses

import pytest

from pipeline.report import render
from tests.report.conftest import SOLUTION, made_up_inputs

T0 = 1_700_000_000_000_000_000
CHANGE = {
    "static": "benchmark B2 pose",
    "or": [],
    "at_ns": T0,
    "from_ns": T0,
    "to_ns": T0 + 10**9,
    "amounts": [{"size": 12.0, "sigma": 2.0, "unit": "mm", "text": "12.0 mm ± 2.0"}],
    "inflation": 1.4,
    "sentence": "benchmark B2 moved 12.0 mm ± 2.0 between 22:13:20.0 and 22:13:21.0 UTC",
}
OWN = {
    "changes": {"tested": ["benchmark B2 pose"], "instants": 180, "needed": 16, "why": "", "found": [CHANGE]},
    "odd_even": {"epochs": 9, "observed_mm": 2.1, "predicted_mm": 2.0, "ratio": 1.05, "ratio_95": [0.9, 1.1]},
    "left_out": {
        "B1": {"difference_mm": [1, -2, 3], "sigma_mm": [2, 2, 3], "normalised": 1.5, "off": False},
        "B2": {"difference_mm": [9, 9, 9], "sigma_mm": [1, 1, 1], "normalised": 15.6, "off": True},
        "B3": {"why": "nothing else in this log tells its place"},
    },
    "classes": [
        {
            "class": "corners", "source": "arm", "low_px": 25.0, "high_px": 50.0, "measurements": 800,
            "redundancy": 0.91, "rms_normalised": 1.02, "beyond_3_percent": 0.4, "down_weighted_percent": 1.0,
        },
        {
            "class": "readings", "source": "pot", "low_px": None, "high_px": None, "measurements": 80,
            "redundancy": 0.2, "rms_normalised": None, "beyond_3_percent": None, "down_weighted_percent": 1.0,
        },
    ],
    "worst": [
        {
            "camera": "arm", "marker": "stick", "tag_id": 50, "corner": 2, "time_ns": T0, "side_px": 41.0,
            "normalised": 9.9, "redundancy": 0.9, "weight": 0.0,
        }
    ],
}  # fmt: skip


def page_with(**changed):
    solution = copy.deepcopy(SOLUTION) | copy.deepcopy(OWN) | changed
    return render(dataclasses.replace(made_up_inputs(), solution=solution))


def test_a_change_stands_on_the_page_with_its_size_and_times():
    page = page_with()
    row = page.content["consistency"]["changes"]["rows"][0]
    assert (row["static"], row["amount"]) == ("benchmark B2 pose", "12.0 mm ± 2.0")
    assert "22:13:20" in row["from"] and "22:13:21" in row["to"]
    assert "12.0 mm ± 2.0" in page.html and 'id="table-consistency-changes"' in page.html


def test_benchmarks_left_out_are_judged_one_by_one():
    rows = {row["benchmark"]: row for row in page_with().content["consistency"]["left_out"]["rows"]}
    assert rows["B1"]["why"] == "fits" and rows["B1"]["elevation"] == 3
    assert "survey it again" in rows["B2"]["why"]
    assert rows["B3"]["easting"] is None and "nothing else" in rows["B3"]["why"]


@pytest.mark.parametrize(("ratio", "said"), [(1.0, "they agree"), (1.3, "too small"), (0.7, "too large")])
def test_halves_are_said_in_words(ratio, said):
    text = page_with(odd_even={**OWN["odd_even"], "ratio": ratio}).content["consistency"]["halves"]
    assert said in text


def test_what_was_not_tested_is_said_and_what_was_not_made_is_left_out():
    why = {**OWN["changes"], "found": [], "why": "the log has more than 9 epochs"}
    assert "the log has more than 9 epochs" in page_with(changes=why).html
    short = {**OWN["changes"], "found": [], "instants": 3}
    assert "too short" in page_with(changes=short).html
    bare = render(dataclasses.replace(made_up_inputs(), solution=copy.deepcopy(SOLUTION)))
    assert "table-consistency" not in bare.html and bare.content["consistency"]["changes_sentence"] == ""


@pytest.mark.parametrize(
    ("value", "words"), [(0.61, "safe side"), (1.0, "passed, bounds 0.968 to 1.033"), (1.9, "more scatter")]
)
def test_the_global_test_says_on_which_side_it_failed(value, words):
    test = {**SOLUTION["global_test"], "sigma0_squared": value, "passed": value == 1.0}
    page = page_with(global_test=test)
    assert words in page.content["quality"]["test"] and words in page.html
