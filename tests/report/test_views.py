"""The frames of the worst stations: tags where the tables have them, and every tag accounted for."""

import base64
import dataclasses
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from pipeline.report import View, palette, render, views
from pipeline.report.units import units_of
from pipeline.report.words import Words
from tests.report.conftest import T0, made_up_inputs, square, view
from tests.report.pages import PageReader

UNITS, WORDS = units_of("m", 1.0), Words()
SVG = "{http://www.w3.org/2000/svg}"


def evidence_of(*shown):
    inputs = dataclasses.replace(made_up_inputs(), views=shown)
    return views.evidence(inputs, UNITS, WORDS)


def drawn(shown):
    """The SVG of one view, as XML."""
    _, pictures, _ = evidence_of(shown)
    text = pictures["view_0"].replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    return ElementTree.fromstring(text)


def many(count, side=30.0, step=45.0, status="accepted"):
    """A view of a wall of tags."""
    uv = np.stack([square(60 + step * (i % 12), 40 + step * (i // 12), side) for i in range(count)])
    tags = {
        "tag": np.array([f"tag36h11 {i}" for i in range(count)], object),
        "marker": np.array(["wall"] * count, object),
        "status": np.array([status] * count, object),
        "uv": uv,
        "predicted": uv + 0.1,
        "normalised": np.full(count, 1.0),
        "weight": np.full(count, 1.0),
    }
    return dataclasses.replace(view(), tags=tags)


def test_outlines_stand_at_the_detected_corners_in_the_pixels_of_the_camera():
    shown = view()
    root = drawn(shown)
    # The centre of the first pixel is (0, 0): the picture's border is half a pixel further out.
    assert root.get("viewBox") == "-0.5 -0.5 640 480"
    image = root.find(f"{SVG}image")
    assert [image.get(name) for name in ("x", "y", "width", "height")] == ["-0.5", "-0.5", "640", "480"]
    light = [p for p in root.iter(f"{SVG}polygon") if p.get("stroke") == palette.DETECTED]
    corners = np.array([[pair.split(",") for pair in p.get("points").split()] for p in light], float)
    assert corners == pytest.approx(shown.tags["uv"], abs=0.006)
    assert [p.get("stroke-dasharray") is not None for p in light] == [False, False, True]


def test_the_picture_in_the_page_is_the_one_given():
    shown = view()
    href = drawn(shown).find(f"{SVG}image").get("href")
    assert base64.b64decode(href.removeprefix("data:image/jpeg;base64,")) == shown.jpeg


def test_crosses_stand_where_the_solution_puts_the_corners_and_strokes_are_enlarged_residuals():
    shown = view()
    times = views.enlargement(shown)
    (path,) = [p.get("d") for p in drawn(shown).iter(f"{SVG}path") if p.get("stroke") == palette.PREDICTED]
    number = r"(-?[\d.]+)"
    crosses = np.array(re.findall(rf"M{number},{number}h{number}M", path), float)
    known = shown.tags["predicted"][:2].reshape(-1, 2)
    assert crosses[:, 0] + crosses[:, 2] / 2 == pytest.approx(known[:, 0], abs=0.02)
    assert crosses[:, 1] == pytest.approx(known[:, 1], abs=0.006)
    strokes = np.array(re.findall(rf"M{number},{number}L{number},{number}", path), float)
    assert (strokes[:, 2:] - strokes[:, :2]) / times == pytest.approx(
        known - shown.tags["uv"][:2].reshape(-1, 2), abs=0.01
    )


@pytest.mark.parametrize("offset, expected", [(0.01, 200), (0.5, 20), (3.0, 5), (500.0, 1)])
def test_residuals_are_enlarged_as_far_as_they_stay_near(offset, expected):
    shown = view()
    shown.tags["predicted"][:2] = shown.tags["uv"][:2] + np.array([offset, 0.0])
    assert views.enlargement(shown) == expected  # of 640 px, 3 % is 19 px


def test_every_tag_stands_in_the_table_those_that_were_not_used_first():
    content, _, about = evidence_of(view())
    rows = content["views"][0]["tags"]["rows"]
    assert [row["tag"] for row in rows] == ["tag36h11 11", "tag36h11 2", "tag36h11 1"]
    assert [row["status"] for row in rows] == ["covered", "left out by the adjustment as gross", "used"]
    assert rows[0]["meaning"].startswith("Part of the print is hidden")
    assert rows[0]["rms_px"] is None and rows[0]["weight"] is None
    # Predicted is 0.3 px to the right and 0.4 px above: 0.5 px, per component 0.5 / sqrt(2).
    assert rows[2]["rms_px"] == pytest.approx(0.353553, abs=1e-6)
    assert rows[1]["rms_px"] == pytest.approx(np.sqrt((3.3**2 + 2.6**2) / 2), abs=1e-6)
    assert (rows[2]["normalised"], rows[2]["weight"]) == (1.2, 0.9)
    assert "2 accepted tags" in about["view_0"]["description"]
    assert "Rejected: 1 (tag36h11 11 (covered))" in about["view_0"]["description"]


@pytest.mark.parametrize(
    "status, weight, expected",
    [
        ("accepted", 0.3, "used"),
        ("accepted", 0.0, "gross"),
        ("accepted", np.nan, "unused"),
        ("covered", np.nan, "rejected"),
    ],
)
def test_a_tag_is_told_by_symbol_and_word(status, weight, expected):
    assert views.outcome(status, weight) == expected
    shown = many(1)
    shown.tags["status"][0], shown.tags["weight"][0] = status, weight
    (label,) = [text.text for text in drawn(shown).iter(f"{SVG}text")]
    said = {"used": "", "gross": " left out", "unused": " not used", "rejected": " covered"}[expected]
    assert label == f"{views.SYMBOLS[expected]} 0{said}"
    assert len(set(views.SYMBOLS.values())) == 4


@pytest.mark.parametrize("count, step", [(3, 45.0), (60, 45.0), (96, 33.0)])
def test_labels_hide_neither_tags_nor_each_other(count, step):
    shown = many(count, step=step)
    boxes = [
        [float(rect.get(name)) for name in ("x", "y", "width", "height")]
        for rect in drawn(shown).iter(f"{SVG}rect")
    ]
    assert boxes if count < 96 else True
    quads = [[*uv.min(axis=0), *np.ptp(uv, axis=0)] for uv in shown.tags["uv"]]
    for i, (x, y, w, h) in enumerate(boxes):
        for a, b, c, d in [*boxes[:i], *quads]:
            assert x + w <= a + 0.11 or a + c <= x + 0.11 or y + h <= b + 0.11 or b + d <= y + 0.11
        assert x >= -0.05 and y >= -0.05 and x + w <= 640 and y + h <= 480


def test_one_frame_of_two_stations_names_both():
    _, pictures, about = evidence_of(view((106.25, 106.75)))
    assert about["view_0"]["title"] == "Station 106.25 m, 106.75 m, camera bench at 14:13:21.00 UTC"
    assert list(pictures) == ["view_0"]


def test_a_picture_that_is_not_there_is_a_sentence():
    content, pictures, about = evidence_of(View((113.75,), "bench", T0, why="the log has no index"))
    assert pictures == {} and content["views"][0]["tags"] is None
    assert about["view_0"]["why"] == "Not available: the log has no index."
    inputs = dataclasses.replace(made_up_inputs(), views=(View((1.0,), "bench", T0, why="gone"),))
    assert "Not available: gone." in render(inputs).html


def test_a_frame_without_tags_is_still_shown():
    shown = dataclasses.replace(view(), tags={})
    assert drawn(shown).find(f"{SVG}image") is not None
    empty = {name: values[:0] for name, values in view().tags.items()}
    assert len(list(drawn(dataclasses.replace(view(), tags=empty)))) == 3  # title, description, picture


def test_names_that_others_wrote_are_text():
    shown = view(camera='<script>"&')
    shown.tags["status"][2] = "<b>covered"
    shown.tags["marker"][0] = "</table>"
    html = render(dataclasses.replace(made_up_inputs(), views=(shown,))).html
    assert "<script" not in html and "<b>covered" not in html
    assert PageReader(html).faults == []


def test_six_pictures_of_noise_stay_under_a_quarter_of_the_page():
    shown = [view((100.0 + i,), "bench", i) for i in range(6)]
    _, pictures, _ = evidence_of(*shown)
    assert sum(len(text) for text in pictures.values()) < 750_000
    assert max(len(text) for text in pictures.values()) < 125_000


def test_the_sentences_say_when_the_floor_was_made():
    content, _, _ = evidence_of(view())
    assert content["moments"][0] == (
        "Station 106.25 m, FAIL, deviation +71 mm, U = 11 mm: 200 of its 240 cut cells got their height within "
        "a second of 14:13:21.0 UTC."
    )


def test_a_job_without_a_cut_station_says_so():
    content, _, _ = views.evidence(dataclasses.replace(made_up_inputs(), moments=(), views=()), UNITS, WORDS)
    assert content["why"].startswith("Not available: no station was cut")
