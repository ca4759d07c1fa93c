"""The committed sample from its log to its report, held against the truth that lies beside it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import planning
from benchmarks.main_job import COVERAGE_BAR, RMSE_BAR_M, SAMPLE, SIGMA_RATIO_BAR, STATION_BAR_M, Score, score
from pipeline import resources
from tests.estimation.conforming import faults

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def sample(runs) -> Score:
    return score(ROOT / SAMPLE, runs)


def test_the_cutting_edge_is_right_and_knows_how_right_it_is(sample):
    print(f"RMSE {1e3 * sample.rmse_m:.1f} mm, median sigma {1e3 * sample.median_sigma_m:.1f} mm")
    assert sample.epochs > 400
    assert sample.rmse_m <= RMSE_BAR_M["sample"]
    assert sample.rmse_m <= SIGMA_RATIO_BAR * sample.median_sigma_m
    assert COVERAGE_BAR[0] <= sample.covered / sample.epochs <= COVERAGE_BAR[1]


def test_every_station_lies_within_the_papers_inch(sample):
    assert len(sample.station_errors_m) >= 10
    assert sample.worst_station_m <= STATION_BAR_M


def test_planning_says_beforehand_what_the_report_says(sample, runs):
    predicted, reported = planning.agreement(runs / "trench")
    print(f"predicted {1e3 * predicted:.2f} mm, reported {1e3 * reported:.2f} mm")
    assert predicted == pytest.approx(reported, rel=0.15)


def test_the_report_is_small_and_the_second_run_does_no_work(sample, runs):
    page = runs / "trench" / "report.html"
    assert 100_000 < page.stat().st_size < 3_000_000
    before = {file: file.stat().st_mtime_ns for file in page.parent.rglob("*.parquet")}
    start = time.monotonic()
    command = [sys.executable, "-m", "pipeline", "report", str(ROOT / SAMPLE), "--runs", str(runs)]
    again = subprocess.run(command, check=True, capture_output=True, text=True)
    assert time.monotonic() - start < 5.0
    assert again.stdout.splitlines()[-1].endswith(f"verdict {sample.verdict}")
    assert {file: file.stat().st_mtime_ns for file in page.parent.rglob("*.parquet")} == before


def test_what_the_adjustment_says_of_itself_conforms_to_its_schema(sample, runs):
    solution = json.loads((runs / "trench" / "solution.json").read_text(encoding="utf-8"))
    schema = json.loads(resources.schema_text("artefacts/solution.schema.json"))
    assert faults(solution, schema, schema) == []
    rounds = solution["learned"]["log_likelihood"]
    print(f"log likelihood {rounds}")
    assert rounds[-1] > rounds[0]


def test_the_same_log_adjusted_twice_gives_the_same_bytes(sample, runs, tmp_path):
    """All that estimate and track write, from the same detections, in another process."""
    again = tmp_path / "trench"
    shutil.copytree(runs / "trench", again)
    for name in ("estimate.manifest.json", "solution.json", "states.parquet", "poses.parquet"):
        (again / name).unlink()
    command = [sys.executable, "-m", "pipeline", "report", str(ROOT / SAMPLE), "--runs", str(tmp_path)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    for name in (
        "solution.json",
        *(f"{t}.parquet" for t in ("states", "statics", "residuals", "poses", "cutting_edge")),
    ):
        assert (again / name).read_bytes() == (runs / "trench" / name).read_bytes(), name
