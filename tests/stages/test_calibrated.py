"""What a calibration may write, and what it leaves as it was."""

from __future__ import annotations

import datetime
import stat

import pytest
from click.testing import CliRunner

from pipeline.__main__ import main
from pipeline.config import load_machine
from pipeline.config.rewriting import with_values
from pipeline.errors import ArtefactError, CalibrationError, ConfigError
from pipeline.report.sheet import Sheet
from pipeline.resources import template_folder
from pipeline.stages.calibrated import put_into, refuse_read_only, refuse_twice

SAMPLE = template_folder().parent / "sample_logs" / "trench"
SHEET = Sheet("Lens", "bench", "good", "Good enough.")


@pytest.fixture
def machine(tmp_path):
    file = tmp_path / "machine.toml"
    file.write_bytes((SAMPLE / "machine.toml").read_bytes())
    return file


def test_a_read_only_file_is_refused_before_any_work(machine):
    refuse_read_only(machine)
    machine.chmod(0o444)
    with pytest.raises(ArtefactError, match=r"machine\.toml is read-only"):
        refuse_read_only(machine)


def test_who_may_read_a_file_stays_as_it_was(machine):
    machine.chmod(0o640)
    kept = put_into(machine, "machine", {"cutting_edge.width_m": 1.1}, SHEET, machine.with_name("sheet.html"))
    assert stat.S_IMODE(machine.stat().st_mode) == 0o640
    assert kept.read_bytes() == (SAMPLE / "machine.toml").read_bytes()
    assert "width_m = 1.1" in machine.read_text(encoding="utf-8")


def test_values_that_the_file_may_not_have_leave_no_sheet_either(machine):
    before = machine.read_bytes()
    with pytest.raises(ConfigError):
        put_into(machine, "machine", {"cutting_edge.width_m": -1.0}, SHEET, machine.with_name("sheet.html"))
    assert machine.read_bytes() == before and [f.name for f in machine.parent.iterdir()] == ["machine.toml"]


def test_a_log_that_told_a_prior_is_not_counted_twice(machine):
    text = machine.read_text(encoding="utf-8")
    stamp = {"date": datetime.date(2026, 5, 1), "by": "test", "source": "log.mcap", "sha256": "a" * 64}
    told = load_machine(with_values(text, "m", {"cutting_edge.mount.calibrated": stamp}), "m")
    refuse_twice(told, "b" * 64, ())
    refuse_twice(told, "a" * 64, ("cutting_edge.mount",))
    with pytest.raises(
        CalibrationError, match=r"^cutting_edge\.mount of machine\.toml was told by this very log"
    ):
        refuse_twice(told, "a" * 64, ("sensors.bucket-pot.curve",))


@pytest.mark.parametrize(
    "wrong",
    [
        ["--sigma-px", "nan"],
        ["--looks", "inf"],
        ["--looks", "1e308"],
        ["--frame-rate", "nan"],
        ["--boom", "nan"],
        ["--ground", "1e300"],
        ["--at", "nan,nan,nan"],
        ["--at", "reach=inf,depth=1"],
        ["--area", "nan:nan"],
        ["--area", "0:inf"],
        ["--out", "plan.json"],
    ],
)
def test_wishes_that_are_no_numbers_are_usage(tmp_path, monkeypatch, wrong):
    monkeypatch.chdir(tmp_path)
    files = [str(SAMPLE / name) for name in ("machine.toml", "site.toml")]
    done = CliRunner().invoke(main, ["plan", *files, *wrong])
    assert done.exit_code == 2 or getattr(done.exception, "exit_code", None) == 2, done.output
    assert not list(tmp_path.iterdir())
