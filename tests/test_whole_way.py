"""From a box of cameras to a report: the commands of docs/calibrating-a-machine.md, one after another."""

from __future__ import annotations

import pytest

from benchmarks.main_job import RMSE_BAR_M, SIGMA_RATIO_BAR, STATION_BAR_M
from benchmarks.whole_way import PLAN_BAR, Way, walk
from pipeline.synthetic.command import SAMPLE_SEED

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3000)]


@pytest.fixture(scope="module")
def way(tmp_path_factory) -> Way:
    """The sample's machine, calibrated in an empty folder."""
    return walk(SAMPLE_SEED, tmp_path_factory.mktemp("new-user"))


def test_a_machine_file_from_the_documented_commands_meets_the_bounds_of_the_main_job(way):
    score = way.score
    print(
        f"RMSE {1e3 * score.rmse_m:.1f} mm, median sigma {1e3 * score.median_sigma_m:.1f} mm, "
        f"95 % intervals hold {score.covered / score.epochs:.1%}, worst station {1e3 * score.worst_station_m:.1f} mm"
    )
    assert score.rmse_m <= RMSE_BAR_M["sample"]
    assert score.rmse_m <= SIGMA_RATIO_BAR * score.median_sigma_m
    assert score.worst_station_m <= STATION_BAR_M
    # That 95 % intervals hold 90 to 99 % is asked of several machines together, as in the main job: one of them has one
    # draw of the common error. `make bench-whole-way` asks it of four.
    assert score.covered / score.epochs >= 0.85


def test_the_plan_with_the_calibrated_file_says_what_its_report_says(way):
    print(f"predicted {way.predicted_mm} mm, reported {way.reported_mm} mm")
    assert way.predicted_mm == pytest.approx(way.reported_mm, rel=PLAN_BAR)
