"""Buried utilities on the page: verdicts, numbers in the site's unit, remarks, and nothing where there are none."""

import dataclasses

import numpy as np
import pytest

from pipeline.config import load_site
from pipeline.report import palette, render
from pipeline.surface.alignment import polyline
from pipeline.surface.table import columns_of_utilities
from pipeline.surface.utilities import VERDICTS, facts_of, find_approaches, read_utilities
from pipeline.tracks.poses import CuttingEdge
from tests.report.conftest import METRES, ORIGIN_M, T0, made_up_inputs, site_text
from tests.report.pages import PageReader, as_float, at_path

# Name, kind, height of its axis above the origin: all cross the trench at E 9 m, where the edge passes at height 0.
CROSSING = (
    ("main", "gas", 0.08),
    ("duct", "power", -0.20),
    ("sewer", "sewer", -0.65),
    ("deep", "water", -1.5),
)


def inputs_with(unit="m", unseen=False):
    """The made-up run with utilities, found by the stage's own code from a pass of 1 m/s along easting."""
    scale = METRES[unit]
    text = site_text(unit)
    for name, kind, h in (*CROSSING, ("far", "other", 40.0)):
        ends = [((ORIGIN_M + [9.0, n, h]) / scale).tolist() for n in (-20.0, 20.0)]
        text += (
            f'[utilities.{name}]\nkind = "{kind}"\npoints = {ends}\nradius_mm = 100\nsigma_mm = [30, 60]\n'
        )
    site = load_site(text, "site.toml")
    t = np.arange(0, 16, 0.1)
    middle = ORIGIN_M + np.column_stack([1 + t, 0 * t, 0 * t])
    across = np.array([0.0, 0.6, 0.0])
    cov = np.zeros((len(t), 3, 6))
    cov[..., [0, 3, 5]] = 2.5e-5
    seen = ~((t > 6.9) & (t < 7.5)) if unseen else np.ones(len(t), bool)
    edge = CuttingEdge(
        T0 + np.round(t * 1e9).astype(np.int64),
        np.stack([middle - across, middle, middle + across], axis=1), seen, cov, 0.4 * cov,
    )  # fmt: skip
    line = polyline(np.array([[0.0, 0.0], [9.0, 3.0], [18.0, 5.0]]) + ORIGIN_M[:2], 100.0)
    buried = read_utilities(site, {})
    found = find_approaches(edge, buried)
    base = made_up_inputs(unit)
    return dataclasses.replace(
        base,
        site=site,
        utilities=buried,
        survey={**base.survey, "utilities": {"reach": 2.0, "lines": [facts_of(f, line) for f in found]}},
        tables={**base.tables, "utilities": columns_of_utilities(found, line)},
    )


@pytest.fixture(scope="module")
def inputs():
    return inputs_with()


@pytest.fixture(scope="module")
def page(inputs):
    return render(inputs)


def test_the_lines_stand_with_the_gravest_first(page):
    rows = page.content["utilities"]["lines"]["rows"]
    assert [(row["name"], row["kind"], row["verdict"]) for row in rows] == [
        ("main", "gas", "STRIKE LIKELY"),
        ("duct", "power", "STRIKE POSSIBLE"),
        ("sewer", "sewer", "NEAR MISS"),
        ("deep", "water", "CLEAR"),
        ("far", "other", "NOT APPROACHED"),
    ]
    assert [row["distance"] for row in rows] == pytest.approx([-0.02, 0.1, 0.55, 1.4, 39.9], abs=1e-3)
    # 0.55 m less 1.645 times 60 mm of the line and 5 mm of the edge, and a little for errors sideways.
    assert rows[2]["bound"] == pytest.approx(0.55 - 1.645 * np.hypot(0.06, 0.005), abs=0.002)
    assert rows[2]["sigma_line"] == pytest.approx(0.06) and rows[2]["sigma_edge"] == pytest.approx(0.005)
    assert rows[2]["time"] == "2026-09-21 14:13:28.0 UTC"
    assert rows[3]["approaches"] == 0 and rows[0]["approaches"] == 1


@pytest.mark.parametrize("unit", ["m", "international_foot", "us_survey_foot"])
def test_distances_and_stations_are_in_the_unit_of_the_site(unit):
    """The factor is written out here, so that a wrong one in units.py cannot agree with itself."""
    feet = {"m": 1.0, "international_foot": 1 / 0.3048, "us_survey_foot": 3937 / 1200}[unit]
    inputs = inputs_with(unit)
    read = PageReader(render(inputs).html)
    head, *rows = read.tables["utilities.lines"]
    by_name = {row[0]: row for row in rows}
    name = {"m": "m", "international_foot": "ft", "us_survey_foot": "US ft"}[unit]
    assert head[3].endswith(name)
    for buried, _, h in CROSSING[1:]:
        assert as_float(by_name[buried][3].replace("+", "")) == pytest.approx((-h - 0.1) * feet, abs=0.0006)
        assert as_float(by_name[buried][5]) == pytest.approx(0.5 * feet, abs=0.0006)
    lines = {line["name"]: line for line in inputs.survey["utilities"]["lines"]}
    assert as_float(by_name["duct"][8]) == pytest.approx(lines["duct"]["station"] * feet, abs=0.0051)
    events = read.tables["utilities.events"][1:]
    assert [row[0] for row in events] == ["main", "duct", "sewer"]
    assert as_float(events[1][2].replace("+", "")) == pytest.approx(0.1 * feet, abs=0.0006)


def test_every_table_of_the_section_is_the_one_in_report_json(page):
    read = PageReader(page.html)
    assert read.faults == [] and len(set(read.ids)) == len(read.ids)
    for key in ("utilities.lines", "utilities.events"):
        table = at_path(page.content, key)
        for shown, row in zip(read.tables[key][1:], table["rows"], strict=True):
            for text, column in zip(shown, table["columns"], strict=True):
                value = row[column["key"]]
                if column["digits"] is None:
                    assert value in text
                else:
                    assert as_float(text.replace("+", "")) == pytest.approx(
                        value, abs=0.51 * 10 ** -column["digits"]
                    )
    assert "Approaches below the clearance: 3, of which the gravest are listed (3)." in page.html


def test_strikes_come_before_everything_else_that_needs_attention(page):
    items = page.content["attention"]["items"]
    assert [item["section"] for item in items[:2]] == ["utilities", "utilities"]
    assert items[0]["sentence"].startswith("Strike likely: the cutting edge reached the gas line 'main'")
    assert "−0.02 m" in items[0]["sentence"] and items[1]["sentence"].startswith("Strike possible")
    said = [item["sentence"] for item in items + page.content["attention"]["more"]]
    assert any(s.startswith("Near miss") and "0.55 m" in s and "clearance 0.50 m" in s for s in said)


def test_time_without_sight_near_a_line_is_told():
    page = render(inputs_with(unseen=True))
    rows = {row["name"]: row for row in page.content["utilities"]["lines"]["rows"]}
    assert rows["deep"]["verdict"] == "CLEAR WHILE SEEN" and rows["deep"]["unseen"] == pytest.approx(0.6)
    assert rows["far"]["verdict"] == "NOT APPROACHED"
    assert (
        "The edge was not seen for 0.6 s while within 2.00 m of the water line 'deep'"
        in page.html.replace("&#39;", "'")
    )


def test_the_figure_names_every_line_and_the_plan_shows_where(page, inputs):
    about = page.content["figures"]["utilities"]
    assert about["good"].startswith("Good:")
    for name in ("main", "duct", "sewer", "deep", "far"):
        assert name in about["description"]
    without = dataclasses.replace(inputs, utilities=())
    assert render(without).html.count("<path") < page.html.count("<path")


def test_every_verdict_has_a_word_a_symbol_and_a_marker_of_its_own():
    styles = [palette.verdict_style(word) for word in VERDICTS]
    assert [style.word for style in styles] == list(VERDICTS)
    assert len({style.symbol for style in styles}) == len({style.marker for style in styles}) == len(VERDICTS)


def test_a_site_without_utilities_has_no_such_section():
    page = render(made_up_inputs())
    assert page.content["utilities"] is None
    assert "utilities" not in PageReader(page.html).ids and "utilities" not in page.content["figures"]


def test_a_run_without_its_survey_says_why_nothing_stands_here(inputs):
    empty = dataclasses.replace(inputs, survey={}, tables={}, missing={"survey.json": "it was never written"})
    page = render(empty)
    assert "it was never written" in page.content["utilities"]["why"]
    assert "utilities" in PageReader(page.html).ids


def test_fifty_lines_and_many_approaches_stay_small(inputs):
    line = inputs.survey["utilities"]["lines"][2]
    many = [{**line, "name": f"n{i}"} for i in range(200)]
    table = {k: np.tile(v, 2000) for k, v in inputs.tables["utilities"].items()}
    table["nearest"][5:] = False
    page = render(
        dataclasses.replace(
            inputs,
            survey={**inputs.survey, "utilities": {"reach": 2.0, "lines": many}},
            tables={**inputs.tables, "utilities": table},
        )
    )
    assert len(page.content["utilities"]["lines"]["rows"]) == 200
    assert len(page.content["utilities"]["events"]["rows"]) == 50
    assert len(page.html.encode()) < 3_000_000
