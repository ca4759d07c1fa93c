"""Values put into a TOML file: comments, order and everything else stay."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import load_machine
from pipeline.config.rewriting import with_values
from pipeline.errors import ConfigError

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "trench" / "machine.toml"


def test_only_what_is_set_changes():
    text = SAMPLE.read_text()
    covariance = np.diag([1e-6, 2e-6, 3e-6, 1e-8, 2e-8, 3e-8])
    changed = with_values(
        text,
        "machine.toml",
        {
            "cameras.arm.mount": {
                "xyz_m": [0.7, 0.9, 2.3],
                "rpy_deg": [-96.0, 0.5, -94.0],
                "covariance": covariance,
            },
            "cameras.arm.intrinsics.fx": 851.25,
            "sensors.bucket-pot.time_offset_s": np.float64(0.02),
        },
    )
    machine = load_machine(changed, "machine.toml")
    assert np.array_equal(machine.cameras["arm"].mount.covariance_xi(), covariance)
    assert machine.cameras["arm"].intrinsics.fx == 851.25
    gone = [line for line in text.splitlines() if line not in changed.splitlines()]
    new = [line for line in changed.splitlines() if line not in text.splitlines()]
    assert len(gone) == len(new) == 3, (gone, new)
    assert "# true time minus stamp" in next(line for line in new if line.startswith("time_offset_s"))
    assert changed.count("#") == text.count("#")


def test_a_value_can_go_and_tables_can_come():
    changed = with_values("[a]\nb = 1 # one\nc = 2\n", "x.toml", {"a.b": None, "d.e": {"f": [1, 2.5]}})
    assert tomllib.loads(changed) == {"a": {"c": 2}, "d": {"e": {"f": [1, 2.5]}}}


def test_what_is_no_table_is_refused():
    with pytest.raises(ConfigError, match=r"x\.toml: a\.b\.c cannot be set: b is no table"):
        with_values("[a]\nb = 1\n", "x.toml", {"a.b.c": 2})
    with pytest.raises(ConfigError, match="not valid TOML"):
        with_values("[a\n", "x.toml", {"a.b": 2})


def test_a_new_key_stays_before_the_comment_that_announces_the_next_table():
    text = "[a]\nx = 1  # one\n\n# What follows.\n[b]\nz = 3\n\n# End.\n"
    changed = with_values(text, "x.toml", {"a.y": 2, "b.w": {"k": [1]}, "a.v": 5})
    assert changed == (
        "[a]\nx = 1  # one\ny = 2\nv = 5\n\n# What follows.\n[b]\nz = 3\nw = {k = [1]}\n\n# End.\n"
    )


def test_a_covariance_that_replaces_sigmas_stands_in_its_own_table():
    text = SAMPLE.read_text()
    lens = {"width": 640, "height": 480, "fx": 850.0, "fy": 850.0, "cx": 320.0, "cy": 240.0,
            "distortion": [0.0] * 5, "covariance": np.eye(9), "calibrated": {"by": "test"}}  # fmt: skip
    lines = with_values(text, "machine.toml", {"cameras.arm.intrinsics": lens}).splitlines()
    heading = lines.index("[cameras.arm.intrinsics]")
    end = next(k for k in range(heading, len(lines)) if not lines[k].strip())
    assert any(line.startswith("covariance") for line in lines[heading:end])
    assert any(line.startswith("calibrated") for line in lines[heading:end])
