"""Exports are read back by another reader and hold what the tables hold."""

import csv
import io
import json

import numpy as np
import pytest

from pipeline.report import render
from pipeline.report.exports import csv_of
from pipeline.runs import json_bytes
from tests.report.conftest import HOSTILE, made_up_inputs


@pytest.fixture(scope="module")
def page():
    return render(made_up_inputs())


def rows_of(data):
    return list(csv.DictReader(io.StringIO(data.decode("utf-8"))))


def test_stations_csv_holds_the_table(page):
    rows = rows_of(csv_of(page.exports["stations"]))
    stations = made_up_inputs().tables["stations"]
    assert len(rows) == len(stations["station"])
    for row, deviation, reason in zip(rows, stations["deviation"], stations["reason"]):
        assert row["reason"] == reason
        if np.isnan(deviation):
            assert row["deviation [mm]"] == ""
        else:
            assert float(row["deviation [mm]"]) == pytest.approx(1000 * deviation, abs=5e-4)


def test_checks_csv_keeps_ids_as_strings_and_coordinates(page):
    rows = rows_of(csv_of(page.exports["checks"]))
    checks = made_up_inputs().tables["checks"]
    assert [row["point"] for row in rows] == list(checks["point"])
    assert rows[0]["point"] == "001" and rows[-1]["point"] == HOSTILE
    assert float(rows[3]["n [m]"]) == pytest.approx(checks["n"][3], abs=1e-6)


@pytest.mark.parametrize("text", ["=1+1", "+A1", "@sum", "-2", "\tx"])
def test_a_point_id_is_no_formula(text):
    table = {"columns": [{"key": "a", "unit": "", "digits": None}], "rows": [{"a": text}]}
    assert rows_of(csv_of(table))[0]["a"] == "'" + text


def test_report_json_reads_back_as_it_was(page):
    assert json.loads(json_bytes(page.content)) == page.content
