"""A sensor that read beyond its calibrated stroke is named on the page; the sheet of a bucket renders."""

import datetime

import numpy as np
import pytest

from pipeline.calibration import bucket
from pipeline.calibration.agreement import kept_of
from pipeline.config import load_machine
from pipeline.network.model import Readings
from pipeline.report import render
from pipeline.report.bucket_sheet import BucketFacts, bucket_sheet, edge_sigma
from pipeline.report.sheet import GOOD, POOR, render_sheet
from pipeline.stages.estimate import beyond_stroke
from tests.calibration.rigs import drawn

SENSOR = """
[sensors.pot]
topic = "/pot"
joint = "bucket"
noise = 0.01
[sensors.pot.curve]
output = "angle_deg"
coefficients = [0.0, 30.0]
sigma = [0.1, 0.1]
raw_range = [0.4, 4.1]
calibrated = { date = 2026-11-02, source = "touches.mcap", raw_range = [0.5, 4.0] }
"""


def machine_with_sensor(text):
    return load_machine(text + SENSOR, "machine.toml")


def test_readings_beyond_the_stroke_are_counted_those_dropped_as_well():
    from tests.report.conftest import MACHINE

    raw = np.array(
        [0.5, 0.49, 1.0, 4.0, 4.05, 4.9, np.nan]
    )  # the ends belong to the stroke; 4.9 is dropped later
    found = beyond_stroke(machine_with_sensor(MACHINE), {"pot": Readings(np.arange(7), raw)})
    assert found == {
        "pot": {
            "readings": 6,
            "beyond": 3,
            "stroke": [0.5, 4.0],
            "least": 0.49,
            "most": 4.9,
            "calibrated": "2026-11-02",
        }
    }
    assert beyond_stroke(machine_with_sensor(MACHINE), {"pot": Readings(np.arange(2), raw[2:4])}) == {}
    plain = machine_with_sensor(MACHINE.replace("[cutting_edge]", "[cutting_edge]")).model_copy(
        update={"sensors": {}}
    )
    assert beyond_stroke(plain, {"pot": Readings(np.arange(7), raw)}) == {}


def test_the_report_names_the_sensor_and_lists_what_was_calibrated(made_up):
    from dataclasses import replace

    from tests.report.conftest import MACHINE

    inputs = made_up()
    machine = machine_with_sensor(MACHINE)
    solution = {
        **inputs.solution,
        "beyond_stroke": beyond_stroke(machine, {"pot": Readings(np.arange(3), np.array([1.0, 2.0, 4.7]))}),
    }
    page = render(replace(inputs, machine=machine, solution=solution))
    html, content = page.html, page.content
    items = content["attention"]["items"] + content["attention"]["more"]
    told = [item for item in items if "beyond the stroke" in item["sentence"]]
    assert len(told) == 1 and told[0]["section"] == "provenance"
    assert "Sensor pot" in told[0]["sentence"] and "1 of 3 readings" in told[0]["sentence"]
    assert "2026-11-02 (0.500 to 4.000)" in told[0]["sentence"]
    (row,) = content["provenance"]["calibrations"]["rows"]
    assert (row["what"], row["date"]) == ("sensors.pot.curve", "2026-11-02")
    assert (row["source"], row["beyond"]) == ("touches.mcap", "1 of 3 readings")
    assert "touches.mcap" in html


def facts(tolerance_m):
    d = drawn(1)
    found = bucket.adjust(d.rig, d.stands, d.touches, list(d.points.values()))
    return BucketFacts(
        machine="ex-14", sensor="pot", adjusted=found, kept=kept_of(found, "pot"),
        touch_names=tuple(t.name for t in d.touches), point_names=("TP1",), left_out={"shot of the floor": 2},
        wear_m=None, tolerance_m=tolerance_m, date=datetime.date(2026, 11, 2), log="touches.mcap",
        log_sha256="a" * 64, checks="checks.csv", machine_sha256="b" * 64,
    )  # fmt: skip


@pytest.mark.parametrize("tolerance_m, state", [(0.010, GOOD), (0.001, POOR)])
def test_the_sheet_says_in_millimetres_whether_the_bucket_is_good_enough(tolerance_m, state):
    said = facts(tolerance_m)
    html, content = render_sheet(bucket_sheet(said))
    assert content["state"] == state
    assert f"U = {1000 * said.expanded_m:.1f} mm (k = 2)" in content["sentence"]
    assert "2 shot of the floor" in " ".join(content["remarks"])
    assert html.count("touch 7") >= 1 and "<svg" in html


def test_the_sigma_at_the_edge_is_at_least_that_of_angle_times_radius_and_of_radius():
    from pipeline.calibration import curve_fit

    found = facts(0.01).adjusted
    raw = np.linspace(found.stands[0].raw, found.stands[-1].raw, 5)
    r, sigma_r, _ = curve_fit.radius_with_jacobian(found)
    across = r * curve_fit.direction(found, raw).sigma_rad
    sigma = edge_sigma(found, raw)
    assert np.all(sigma >= np.maximum(across, sigma_r) - 1e-12)
    assert np.all(sigma <= np.hypot(across, sigma_r) + 1e-12)
