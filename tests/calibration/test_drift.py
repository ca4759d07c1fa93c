"""Machine files by date: what moved is told in sigmas and millimetres."""

import datetime
import json

import numpy as np
import pytest

from pipeline.calibration.drift import history
from pipeline.config import load_machine
from pipeline.config.rewriting import with_values
from pipeline.errors import CalibrationError
from pipeline.resources import template_folder
from pipeline.stages import calibrate_history

SAMPLE = template_folder().parent / "sample_logs" / "trench" / "machine.toml"
TODAY = datetime.date(2026, 6, 1)


def mount(x_m, yaw_deg, day, sigma_mm=1.0, sigma_deg=0.01):
    return {
        "xyz_m": [x_m, 0.5, 2.0],
        "rpy_deg": [0.0, 0.0, yaw_deg],
        "sigma_mm": sigma_mm,
        "sigma_deg": sigma_deg,
        "calibrated": {"date": datetime.date.fromisoformat(day), "by": "calibrate cluster"},
    }


def texts():
    text = SAMPLE.read_text(encoding="utf-8")
    return [
        with_values(text, "machine.toml", {"cameras.arm.mount": value})
        for value in (
            mount(1.0, 0.0, "2025-06-01"),
            mount(1.003, 0.0, "2025-12-01"),
            mount(1.003, 0.2, "2026-05-01"),
        )
    ]


def test_changes_in_closed_form():
    machines = [load_machine(text, "machine.toml") for text in texts()]
    first, moved, turned = history(machines, TODAY, 8.0)["cameras.arm.mount"]
    assert first.sigmas is None and first.age_days == 365
    # 3 mm against two calibrations of 1 mm, over six components.
    assert moved.sigmas == pytest.approx(3 / np.sqrt(2) / np.sqrt(6))
    assert moved.edge_mm == pytest.approx(3.0)
    assert turned.sigmas == pytest.approx(0.2 / 0.01 / np.sqrt(2) / np.sqrt(6))
    assert turned.edge_mm == pytest.approx(8000 * np.deg2rad(0.2))
    assert turned.age_days == 31


def test_what_carries_the_edge_moves_it_by_its_own_lever():
    text = SAMPLE.read_text(encoding="utf-8")
    machine = load_machine(text, "machine.toml")
    axis, edge = machine.bodies["bucket"].axis, machine.cutting_edge
    turned = {
        "xyz_m": list(axis.xyz_m),
        "rpy_deg": [axis.rpy_deg[0], axis.rpy_deg[1], axis.rpy_deg[2] + 0.1],
        "sigma_mm": 1.0,
        "sigma_deg": 0.01,
    }
    new = load_machine(with_values(text, "machine.toml", {"bodies.bucket.axis": turned}), "machine.toml")
    change = history([machine, new], TODAY, 8.0)["bodies.bucket.axis"][1]
    assert change.edge_mm == pytest.approx(
        1000 * np.linalg.norm(edge.mount.xyz_m) * np.deg2rad(0.1), rel=1e-3
    )


def test_a_lens_moves_the_edge_by_the_turn_and_the_stretch_of_its_rays():
    text = SAMPLE.read_text(encoding="utf-8")
    machine = load_machine(text, "machine.toml")
    lens = machine.cameras["bench"].intrinsics
    for key, moved_px, expected_mm in (
        ("cx", 0.5, 8000 * 0.5 / lens.fx),
        ("fx", 0.6, 8000 * 0.6 / lens.fx / 3),
    ):
        value = getattr(lens, key) + moved_px
        new = load_machine(with_values(text, "m", {f"cameras.bench.intrinsics.{key}": value}), "machine.toml")
        (_, change) = history([machine, new], TODAY, 8.0)["cameras.bench.intrinsics"]
        assert change.edge_mm == pytest.approx(expected_mm, rel=1e-6)


def test_one_file_and_a_day_before_its_calibrations_are_said(tmp_path):
    (tmp_path / "machine.toml").write_text(texts()[2], encoding="utf-8")
    _, sentences = calibrate_history.run([tmp_path / "machine.toml"], TODAY, 8.0)
    assert "there is one file only" in sentences[0]
    with pytest.raises(CalibrationError, match="was not made yet; give --today a later day"):
        calibrate_history.run([tmp_path / "machine.toml"], datetime.date(2026, 4, 30), 8.0)


def test_a_quantity_that_is_as_before_adds_no_row():
    machines = [load_machine(text, "machine.toml") for text in texts()]
    assert len(history(machines, TODAY, 8.0)["cameras.bench.mount"]) == 1


def test_the_stage_orders_files_and_names_what_moved_and_what_is_old(tmp_path):
    names = ("machine.before-2025-11-30-1.toml", "machine.before-2025-11-30-2.toml", "machine.toml")
    for name, text in zip(names, texts(), strict=True):
        (tmp_path / name).write_text(text, encoding="utf-8")
    page = tmp_path / "history.html"
    rows, sentences = calibrate_history.run([tmp_path / n for n in reversed(names)], TODAY, 8.0, 30, page)
    mine = [row for row in rows if row[0] == "cameras.arm.mount"]
    assert [row[1] for row in mine] == ["2025-06-01", "2025-12-01", "2026-05-01"]
    assert mine[2][3:] == ("5.8", "27.9", "31")
    assert any("cameras.arm.mount moved by 5.8 sigma, 27.9 mm at the cutting edge" in s for s in sentences)
    assert any("cameras.arm.mount was calibrated 31 days ago (limit 30)" in s for s in sentences)
    sheet = json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))
    assert sheet["word"] == "Needs attention" and sheet["remarks"] == sentences
    (shown,) = (t["table"]["rows"] for part in sheet["parts"] for t in part["tables"])
    assert [r["edge"] for r in shown if r["key"] == "cameras.arm.mount"] == [
        None,
        3.0,
        pytest.approx(27.925, abs=1e-3),
    ]
    assert "27.9" in page.read_text(encoding="utf-8")


def test_files_of_two_machines_are_refused(tmp_path):
    a, b = tmp_path / "a.toml", tmp_path / "b.toml"
    text = SAMPLE.read_text(encoding="utf-8")
    a.write_text(text, encoding="utf-8")
    b.write_text(text.replace('id = "ex-14"', 'id = "ex-15"'), encoding="utf-8")
    with pytest.raises(CalibrationError, match="different machines: ex-14, ex-15"):
        calibrate_history.run([a, b], TODAY, 8.0)
