"""axe-core finds nothing on the page, folded or unfolded, full or empty; and it would find what is wrong."""

import dataclasses

import pytest

from pipeline.report import render
from tests.browser.accessibility import findings
from tests.report.conftest import made_up_inputs

pytestmark = pytest.mark.browser
SIZE = "--window-size=1280,3000"


def passing():
    inputs = made_up_inputs("us_survey_foot")
    return dataclasses.replace(inputs, survey={**inputs.survey, "verdict": "PASS"})


def empty():
    """A run of which nothing is left."""
    return dataclasses.replace(
        made_up_inputs(),
        tables={},
        detections={},
        survey={},
        solution={},
        detection={},
        log_facts={},
        manifests={},
        alignment=None,
        moments=(),
        views=(),
        missing={"stations": "stations.parquet is missing or damaged"},
    )


@pytest.mark.parametrize("make", [made_up_inputs, pytest.param(passing, marks=pytest.mark.slow), empty])
def test_axe_finds_nothing(browser, tmp_path, make):
    found = findings(browser, render(make()).html, tmp_path, SIZE)
    assert found["violations"] == []
    assert found["passes"] >= 30  # of an empty document some five apply


def test_axe_finds_nothing_in_what_is_folded_away(browser, page, tmp_path):
    """Contents of a closed element are hidden from axe as from a person."""
    html = page.html.replace("<details", "<details open")
    assert html.count("<details") >= 8
    assert findings(browser, html, tmp_path, SIZE)["violations"] == []


@pytest.mark.slow
def test_axe_would_find_what_is_wrong(browser, page, tmp_path):
    """Pale text, a picture without words, a table head without a scope, a link without a name."""
    html = page.html.replace("--muted: #4d565f", "--muted: #b5bcc4")
    html = html.replace("</main>", '<img src="data:image/png;base64,AAAA"><a href="#report"></a></main>')
    found = {rule["id"]: rule["impact"] for rule in findings(browser, html, tmp_path, SIZE)["violations"]}
    assert found["image-alt"] == "critical"
    assert found["color-contrast"] == found["link-name"] == "serious"
