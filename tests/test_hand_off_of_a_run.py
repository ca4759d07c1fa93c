"""Every file that a run leaves to others, read by libraries that wrote none of it, says what report.json says."""

import json

import duckdb
import ezdxf
import numpy as np
import pandas as pd
import pytest
from lxml import etree

from pipeline.stages import STAGES
from pipeline.tables import read_schema

TABLES = {table for stage in STAGES for table in stage.tables}


@pytest.fixture(scope="module")
def run(finished):
    return finished[0]


@pytest.fixture(scope="module")
def content(run):
    return json.loads((run / "report.json").read_text(encoding="utf-8"))


def stations_of(content):
    rows = content["stations"]["rows"] + (content["stations_beyond"] or {"rows": []})["rows"]
    return sorted(rows, key=lambda row: row["station"])


def numbers(rows, key):
    return np.array([np.nan if row[key] is None else row[key] for row in rows], float)


def test_every_parquet_table_is_the_same_in_duckdb_and_pandas(run):
    files = sorted(run.rglob("*.parquet"))
    assert {f.relative_to(run).parts[0].removesuffix(".parquet") for f in files} == TABLES
    for file in files:
        name = file.relative_to(run).parts[0].removesuffix(".parquet")
        frame = pd.read_parquet(file)
        other = duckdb.sql(f"SELECT * FROM '{file}'").df()
        assert list(frame.columns) == list(other.columns) == list(read_schema(name).column_names), name
        assert len(frame) == len(other), name
        for column in frame.columns:
            ours, theirs = frame[column], other[column]
            if pd.api.types.is_float_dtype(ours):
                np.testing.assert_array_equal(ours.to_numpy(float), theirs.to_numpy(float), err_msg=column)
            else:
                same = (ours.astype(object) == theirs.astype(object)) | (ours.isna() & theirs.isna())
                assert same.all(), (name, column)


@pytest.mark.parametrize("table", ["stations", "checks"])
def test_table_csv_and_report_json_agree(run, content, table):
    parquet = duckdb.sql(f"SELECT * FROM '{run / table}.parquet'").df()
    frame = pd.read_csv(run / f"{table}.csv")
    rows = stations_of(content) if table == "stations" else content["checks"]["rows"]
    assert len(parquet) == len(frame) == len(rows) > 0
    keys = {"stations": ("deviation", "sigma_own"), "checks": ("difference", "sigma_own")}[table]
    for key in keys:
        np.testing.assert_array_equal(frame[f"{key} [mm]"].to_numpy(float), numbers(rows, key))
        np.testing.assert_allclose(parquet[key].to_numpy(float) * 1000, numbers(rows, key), rtol=0, atol=6e-4)
    np.testing.assert_allclose(parquet["station"], numbers(rows, "station"), rtol=0, atol=1e-5)


def test_points_of_the_floor_are_report_json(run, content):
    file = run / "as_built_pnezd.csv"
    rows = content["hand_off"]["as_built_points"]["rows"]
    frame = pd.read_csv(file, header=None, names=["point", "n", "e", "h", "code"])
    assert frame.to_dict("records") == rows
    other = duckdb.sql(f"SELECT * FROM read_csv('{file}', header=False)").df()
    np.testing.assert_array_equal(other["column3"], numbers(rows, "h"))
    assert other["column0"].tolist() == [row["point"] for row in rows]
    # Three per station; at one that was reached in part, by its neighbourhood alone, there is nothing to point at.
    whole = pd.read_csv(run / "stations.csv").query("state == 'cut'")["station [m]"]
    assert {f"S{station:07.2f}{side}" for station in whole for side in "LCR"} <= set(frame["point"])
    reached = {f"S{row['station']:07.2f}" for row in stations_of(content) if row["h"] is not None}
    assert {name[:-1] for name in frame["point"]} <= reached


def test_drawings_hold_the_cells_of_the_table(run, content):
    cut = duckdb.sql(f"SELECT h FROM '{run}/as_built.parquet' WHERE state = 'cut'").df()["h"].to_numpy()
    root = etree.parse(str(run / "as_built.xml")).getroot()
    space = {"x": root.nsmap[None]}
    points = np.array([p.text.split() for p in root.iterfind(".//x:Pnts/x:P", space)], float)
    faces = np.array([f.text.split() for f in root.iterfind(".//x:Faces/x:F", space)], int)
    away = np.abs(np.sort(cut)[None, :] - points[:, 2:])
    assert away.min(axis=1).max() < 0.6e-6 and len(points) > 0.8 * len(cut)
    drawing = ezdxf.readfile(run / "as_built.dxf")
    drawn = [[v.xyz for v in face.wcs_vertices()[:3]] for face in drawing.modelspace().query("3DFACE")]
    np.testing.assert_array_equal(np.array(drawn), points[faces - 1][:, :, [1, 0, 2]])
    lists = root.findall(".//x:ProfSurf/x:PntList2D", space)
    profile = np.concatenate([np.array(e.text.split(), float).reshape(-1, 2) for e in lists])
    heights = {row["station"]: row["h"] for row in stations_of(content)}
    np.testing.assert_allclose(
        profile[:, 1], [heights[round(s, 5)] for s in profile[:, 0]], rtol=0, atol=1e-6
    )
    end_ns = json.loads((run / "log.json").read_text())["end_ns"]
    assert f"{root.get('date')}T{root.get('time')}" == str(
        np.datetime64(end_ns, "ns").astype("datetime64[s]")
    )


def test_the_page_promises_what_lies_beside_it(run, content):
    names = [row["name"] for row in content["hand_off"]["files"]["rows"]]
    assert {"as_built.xml", "as_built.dxf", "as_built_pnezd.csv", "checks.csv"} <= set(names)
    assert all((run / name).stat().st_size > 0 for name in names)
