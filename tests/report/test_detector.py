"""What the page says of rejected tags and of pixel noise is what was counted and measured."""

import copy
import dataclasses
import re
import tomllib
from pathlib import Path

import pytest

from pipeline.config import load_machine
from pipeline.detection import acceptance
from pipeline.detection.refine import REASONS
from pipeline.report import detector, render
from pipeline.report.words import Words
from pipeline.resources import template_folder
from tests.report.conftest import DETECTION, MACHINE, made_up_inputs, tag_scatter
from tests.report.pages import PageReader, as_float

STATUSES = (
    {value for name, value in vars(acceptance).items() if name.isupper() and isinstance(value, str)}
    | set(REASONS)
) - {"", acceptance.ACCEPTED}


DOCS = Path(__file__).parents[2] / "docs"


def with_detection(change=None, **files):
    """The made-up inputs with other facts in detection.json, or with other descriptions."""
    detection = copy.deepcopy(DETECTION)
    if change:
        change(detection["cameras"])
    return dataclasses.replace(made_up_inputs(), detection=detection, **files)


def remarks_of(inputs):
    found = render(inputs).content["attention"]
    return [item for item in found["items"] + found["more"] if item["section"] == "detector"]


def test_every_rejected_tag_stands_in_the_table_under_its_reason_and_camera():
    inputs = made_up_inputs()
    rows = PageReader(render(inputs).html).tables["detector.rejected"]
    assert rows[0][:3] == ["Reason", "bench", "stickcam"]
    assert {row[0] for row in rows[1:]} == {"low margin", "cut by the border"}
    for row in rows[1:]:
        for camera, shown in zip(("bench", "stickcam"), row[1:3]):
            assert as_float(shown) == (inputs.detections[camera]["status"] == row[0]).sum()
        assert len(row[3]) > 20
    totals = [sum(map(as_float, row[1:3])) for row in rows[1:]]
    assert totals == sorted(totals, reverse=True)


def test_every_reason_that_a_tag_can_have_is_explained_and_no_other():
    assert {"low margin", "cut by the border"} < STATUSES
    words = tomllib.loads((template_folder() / "words.en.toml").read_text(encoding="utf-8"))
    assert set(words["reasons"]) == STATUSES
    for page in ("detector.md", "log-format.md"):
        text = (DOCS / page).read_text(encoding="utf-8")
        (table,) = re.findall(r"\| (?:reason|status) \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", text)
        told = {name for row in table.splitlines() for name in row.split("|")[1].strip().split(", ")}
        assert told - {acceptance.ACCEPTED} == STATUSES, page


def test_a_reason_nobody_foresaw_is_counted_all_the_same():
    inputs = made_up_inputs()
    inputs.detections["bench"]["status"][:3] = "eaten"
    (row,) = [row for row in detector.rejected(inputs, Words())["rows"] if row["reason"] == "eaten"]
    assert (row["count_0"], row["count_1"], row["meaning"]) == (3, 0, "")


def test_the_noise_of_each_camera_and_size_is_printed_and_judged():
    page = render(made_up_inputs())
    rows = PageReader(page.html).tables["detector.noise"]
    shown = [(row[0], row[1], as_float(row[6]), row[10]) for row in rows[1:]]
    assert shown == [
        ("bench", "under 25 px", 1.1, "as predicted"),
        ("bench", "25 to 50 px", 1.9, "larger than predicted"),
        ("stickcam", "100 px and more", 0.3, "smaller than predicted"),
    ]
    assert as_float(rows[2][4]) == 0.038 and as_float(rows[2][5]) == 0.02
    assert [row["ratio"] for row in page.content["detector"]["noise"]["rows"]] == [1.1, 1.9, 0.3]


@pytest.mark.parametrize(
    "low, high, said",
    [
        (1.49, 2.5, "near"),
        (1.51, 2.5, "larger"),
        (0.3, 0.51, "near"),
        (0.3, 0.49, "smaller"),
        (0.4, 1.7, "near"),
    ],
)
def test_a_ratio_is_judged_by_the_end_of_its_interval_that_speaks_for_it(low, high, said):
    assert detector.judgement({"ratio_low": low, "ratio_high": high}) == said


def test_the_figure_has_a_mark_for_each_tag_and_its_data_in_a_table():
    page = render(made_up_inputs())
    about = page.content["figures"]["pixel_noise"]
    assert "bench 2, stickcam 1; 3 in all" in about["description"]
    read = PageReader(page.html)
    assert [row[1] for row in read.tables["detector.tags"][1:]] == ["tag36h11 1", "tag36h11 2", "tag36h11 11"]
    assert [as_float(row[2]) for row in read.tables["detector.tags"][1:]] == [22, 41, 140]


def test_corners_that_scatter_less_than_half_are_worth_a_remark():
    (remark,) = remarks_of(made_up_inputs())
    assert remark["sentence"].startswith(
        "Camera stickcam: corners scatter less than half as much as predicted"
    )
    assert "tags of 100 px and more 0.30 times" in remark["sentence"]


def test_a_shake_is_an_error_only_between_what_cannot_move():
    """The cameras of the made-up machine ride on its cab, benchmarks 1 to 3 stand on the ground."""
    riding = with_detection()
    assert not [r for r in remarks_of(riding) if "shakes" in r["sentence"]]
    text = MACHINE.replace('"/bench/image"\nbody = "cab"', '"/bench/image"\nbody = "world"')
    assert text != MACHINE
    on_the_ground = load_machine(text, "machine.toml")
    (said,) = [
        r["sentence"] for r in remarks_of(with_detection(machine=on_the_ground)) if "shakes" in r["sentence"]
    ]
    assert said.startswith(
        "Camera bench shakes against tags that cannot move against it: tag36h11 2 by 0.060 px"
    )
    assert "6.0 times" in said

    def strange(cameras):  # 11 is on nothing that the files describe
        cameras["bench"]["pixel_noise"]["tags"] = [tag_scatter(11, 41.0, 1.0, 6.0)]

    assert not [
        r for r in remarks_of(with_detection(strange, machine=on_the_ground)) if "shakes" in r["sentence"]
    ]


def test_a_log_in_which_nothing_stood_still_says_so():
    def restless(cameras):
        for camera in cameras.values():
            camera["pixel_noise"] = {"sizes": [], "tags": []}

    page = render(with_detection(restless))
    assert PageReader(page.html).faults == []
    assert page.content["detector"]["noise"] is None
    assert "no tag stood still" in page.content["figures"]["pixel_noise"]["why"]


def test_a_run_without_detection_json_says_why():
    whole = made_up_inputs()
    inputs = dataclasses.replace(whole, detection={}, missing={"detection.json": "it is damaged"})
    page = render(inputs)
    assert "it is damaged" in page.content["figures"]["pixel_noise"]["why"]
    assert "detector.rejected" in PageReader(page.html).tables
