"""What is handed on equals report.json, as other programs read it: pandas, DuckDB, lxml, ezdxf."""

import io
import json
import re

import duckdb
import ezdxf
import numpy as np
import pandas as pd
import pytest
from lxml import etree

from pipeline.report import render
from pipeline.report.exports import csv_of
from pipeline.report.hand_off import files_table, hand_off_of
from pipeline.report.units import units_of
from pipeline.report.words import Words
from pipeline.runs import json_bytes
from pipeline.surface.drawing_exchange import dxf_bytes
from pipeline.surface.landxml_out import NAMESPACE, landxml_bytes
from pipeline.surface.shots import read_shots
from tests.report.conftest import HOSTILE, METRES, made_up_inputs

UNITS = ["m", "international_foot", "us_survey_foot"]


@pytest.fixture(scope="module", params=UNITS)
def made(request):
    return request.param, render(made_up_inputs(request.param))


@pytest.fixture(scope="module")
def content(made):
    """report.json, as somebody else reads it."""
    return json.loads(json_bytes(made[1].content))


def column(table, key):
    return np.array([np.nan if row[key] is None else row[key] for row in table["rows"]], float)


def stations_of(content):
    """Every station of report.json, in order."""
    rows = content["stations"]["rows"] + (content["stations_beyond"] or {"rows": []})["rows"]
    return {"rows": sorted(rows, key=lambda row: row["station"])}


def written(page, name, tmp_path):
    path = tmp_path / f"{name}.csv"
    path.write_bytes(csv_of(page.exports[name], heading=name != "as_built_pnezd"))
    return path


def csv_rows(path, reader, **more):
    if reader == "pandas":
        return pd.read_csv(path, keep_default_na=False, na_values=[""], **more)
    header = "names" not in more
    names = "" if header else f", names={more['names']}"
    return duckdb.sql(f"SELECT * FROM read_csv('{path}', header={header}{names}, sample_size=-1)").df()


@pytest.mark.parametrize("reader", ["pandas", "duckdb"])
def test_stations_csv_is_report_json(made, content, tmp_path, reader):
    unit = content["units"]
    frame = csv_rows(written(made[1], "stations", tmp_path), reader)
    table = stations_of(content)
    assert len(frame) == len(table["rows"]) == 36
    for key, of in (("station", "length"), ("h", "length"), ("design_h", "length"), ("deviation", "deviation"),
                    ("u", "deviation"), ("sigma_own", "deviation"), ("sigma_common", "deviation")):  # fmt: skip
        read = frame[f"{key} [{unit[of]}]"].to_numpy(float)
        np.testing.assert_array_equal(read, column(table, key))
    assert frame["verdict"].tolist() == [row["verdict"] for row in table["rows"]]


@pytest.mark.parametrize("reader", ["pandas", "duckdb"])
def test_checks_csv_is_report_json(made, content, tmp_path, reader):
    kinds = {"dtype": {"point": str}} if reader == "pandas" else {}
    frame = csv_rows(written(made[1], "checks", tmp_path), reader, **kinds)
    table, unit = content["checks"], content["units"]
    falls = ("difference", "sigma_own", "sigma_common")
    for key, of in (("station", "length"), *((name, "deviation") for name in falls)):
        np.testing.assert_array_equal(frame[f"{key} [{unit[of]}]"].to_numpy(float), column(table, key))
    if reader == "pandas":
        assert frame["point"].tolist() == [row["point"] for row in table["rows"]]
    assert frame["point"].iloc[-1] == HOSTILE


@pytest.mark.parametrize("reader", ["pandas", "duckdb"])
def test_the_points_of_the_floor_are_report_json(made, content, tmp_path, reader):
    names = ["point", "northing", "easting", "elevation", "code"]
    frame = csv_rows(written(made[1], "as_built_pnezd", tmp_path), reader, names=names)
    table = content["hand_off"]["as_built_points"]
    assert [c["key"] for c in table["columns"]] == ["point", "n", "e", "h", "code"]
    assert frame["point"].tolist() == [row["point"] for row in table["rows"]]
    for name, key in (("northing", "n"), ("easting", "e"), ("elevation", "h")):
        np.testing.assert_array_equal(frame[name].to_numpy(float), column(table, key))
    assert set(frame["code"]) == {"FLOOR-L", "FLOOR-C", "FLOOR-R"}
    # Three for each station that was reached, at the station that its name says.
    reached = [row["station"] for row in stations_of(content)["rows"] if row["h"] is not None]
    assert len(frame) == 3 * len(reached)
    told = [float(re.fullmatch(r"S([\d.]+)[LCR]", name).group(1)) for name in frame["point"]]
    np.testing.assert_allclose(told, np.repeat(reached, 3), atol=0.00501)


def test_the_points_of_the_floor_are_means_of_the_cells_that_touch_the_station(made, tmp_path):
    """By brute force over the table, and by hand along the two lines of the alignment."""
    unit, page = made
    inputs = made_up_inputs(unit)
    shots = read_shots(written(page, "as_built_pnezd", tmp_path), "PNEZD", METRES[unit])
    cells, stations = inputs.tables["as_built"], inputs.tables["stations"]["station"]
    cut = cells["state"] == "cut"
    start, bend, end = (np.array(p) for p in (*inputs.alignment.start, inputs.alignment.end[1]))
    for name, place in zip(shots.point, shots.p_grid):
        station = stations[np.argmin(np.abs(stations - float(name[1:-1]) * METRES[unit]))]
        touching = cut & (np.abs(cells["station"] - station) < 0.0251)
        offsets = np.unique(np.round(cells["offset"][touching], 6))
        half_way = np.argmin(np.abs(offsets - (offsets[0] + offsets[-1]) / 2))
        offset = {"L": offsets[0], "C": offsets[half_way], "R": offsets[-1]}[name[-1]]
        at = touching & (np.abs(cells["offset"] - offset) < 1e-5)
        along = cells["station"][at].mean() - 100
        first = np.hypot(*(bend - start))
        origin, way, along = (
            (start, bend - start, along) if along < first else (bend, end - bend, along - first)
        )
        way = way / np.hypot(*way)
        expected = [*(origin + along * way + offset * np.array([way[1], -way[0]])), cells["h"][at].mean()]
        np.testing.assert_allclose(place, expected, rtol=0, atol=2e-6)


def test_landxml_is_report_json(made, content):
    unit, page = made
    root = etree.fromstring(landxml_bytes(page.hand_off))
    space = {"x": NAMESPACE}
    lists = root.findall(".//x:Profile/x:ProfSurf/x:PntList2D", space)
    profile = np.concatenate([np.array(element.text.split(), float).reshape(-1, 2) for element in lists])
    reached = [row for row in stations_of(content)["rows"] if row["h"] is not None]
    np.testing.assert_allclose(profile, [[r["station"], r["h"]] for r in reached], rtol=0, atol=2e-5)
    # Station 16 was cut in part and counts; only the last three were not reached.
    assert len(lists) == 1 and len(profile) == 33
    assert root.find("x:Project", space).get("name") == "North main, lot 4"
    assert root.find("x:Application", space).get("version") == content["version"]
    line = root.find(".//x:Alignment", space)
    scale = METRES[unit]
    assert float(line.get("staStart")) == pytest.approx(100 / scale, abs=1e-6)
    assert float(line.get("length")) == pytest.approx((np.hypot(9, 3) + np.hypot(9, 2)) / scale, abs=1e-5)
    surface = root.find(".//x:Surface/x:Definition", space)
    points = np.array([p.text.split() for p in surface.iterfind("x:Pnts/x:P", space)], float)
    cells = made_up_inputs(unit).tables["as_built"]
    known = np.sort(cells["h"][cells["state"] == "cut"]) / scale
    at = np.clip(np.searchsorted(known, points[:, 2]), 1, len(known) - 1)
    nearest = np.minimum(np.abs(known[at] - points[:, 2]), np.abs(known[at - 1] - points[:, 2]))
    assert nearest.max() < 0.6e-6, "every corner is a cell of the table"
    assert len(points) == (cells["state"] == "cut").sum()


def test_the_drawing_is_report_json(made, content):
    unit, page = made
    drawing = ezdxf.read(io.StringIO(dxf_bytes(page.hand_off).decode("utf-8")))
    assert drawing.header["$INSUNITS"] == {"m": 6, "international_foot": 2, "us_survey_foot": 21}[unit]
    space = drawing.modelspace()
    reached = [row for row in stations_of(content)["rows"] if row["h"] is not None]
    marks = space.query("POINT[layer=='STATIONS']")
    np.testing.assert_allclose(
        [p.dxf.location.z for p in marks], [row["h"] for row in reached], rtol=0, atol=1e-6
    )
    for text, row in zip(space.query("TEXT[layer=='STATION_TEXT']"), reached):
        station, deviation, name, verdict = re.fullmatch(
            r"([\d.]+) ([+-][\d.]+) (mm|ft|US ft) (.+)", text.plain_text()
        ).groups()
        assert (name, verdict) == (content["units"]["deviation"], row["verdict"])
        assert float(station) == pytest.approx(row["station"], abs=0.00501)
        assert float(deviation) == pytest.approx(row["deviation"], abs=0.0501 if name == "mm" else 0.000501)
    shots = {(row["point"]): row for row in page.exports["checks"]["rows"]}
    places = space.query("POINT[layer=='CHECK_SHOTS']")
    texts = space.query("TEXT[layer=='CHECK_TEXT']")
    assert len(places) == len(texts) == len(shots) == 9
    for place, text in zip(places, texts):
        said = text.plain_text()
        name = next(point for point in shots if said.startswith(point))
        row = shots[name]
        assert place.dxf.location.xyz == pytest.approx((row["e"], row["n"], row["h"]), abs=2e-6)
        assert (row["difference"] is None) == (said == name)
        if row["difference"] is not None:
            assert float(said.split()[1]) == pytest.approx(row["difference"], abs=0.0501)
    assert HOSTILE in [text.plain_text() for text in texts]


def test_the_page_lists_its_files_by_name_and_links_to_none(made, content):
    rows = content["hand_off"]["files"]["rows"]
    assert [row["name"] for row in rows] == [
        "report.json", "stations.csv", "checks.csv", "as_built_pnezd.csv", "as_built.xml", "as_built.dxf",
        "as_built.parquet", "sides.parquet", "volumes.parquet", "cutting_edge.parquet", "poses.parquet",
    ]  # fmt: skip
    assert all(f"{row['name']}" in made[1].html and len(row["holds"]) > 20 for row in rows)


def test_without_check_shots_no_file_of_them_is_promised():
    inputs = made_up_inputs()
    del inputs.tables["checks"]
    hand_off = hand_off_of(inputs, units_of("m", 1.0))
    assert hand_off.checks is None
    drawing = ezdxf.read(io.StringIO(dxf_bytes(hand_off).decode("utf-8")))
    assert len(drawing.modelspace().query("POINT[layer=='CHECK_SHOTS']")) == 0
    names = [row["name"] for row in files_table({"stations"}, False, Words())["rows"]]
    assert names == [
        "report.json",
        "stations.csv",
        "as_built.parquet",
        "sides.parquet",
        "volumes.parquet",
        "cutting_edge.parquet",
        "poses.parquet",
    ]


def test_the_same_run_gives_the_same_files(made):
    unit, page = made
    again = hand_off_of(made_up_inputs(unit), units_of(unit, METRES[unit]))
    assert landxml_bytes(again) == landxml_bytes(page.hand_off)
