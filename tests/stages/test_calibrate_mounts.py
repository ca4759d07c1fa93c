"""Shots of pins as a surveyor's file has them, on the way to `calibrate mounts --pins`."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.config import load_machine, load_site
from pipeline.errors import CalibrationError, SurfaceError
from pipeline.resources import template_folder
from pipeline.stages.calibrate_mounts import pin_shots

SAMPLE = template_folder().parent / "sample_logs" / "trench"
HEAD = "point,northing,easting,elevation,time,sigma_mm\n"


@pytest.fixture(scope="module")
def files():
    return tuple(
        load((SAMPLE / name).read_text(encoding="utf-8"), name)
        for load, name in ((load_machine, "machine.toml"), (load_site, "site.toml"))
    )


def test_ends_are_named_after_their_joint_and_lie_in_the_world(files, tmp_path):
    machine, site = files
    e, n, h = site.grid.to_grid_metres(np.zeros(3))
    file = tmp_path / "pins.csv"
    file.write_text(
        HEAD
        + f"bucket-L,{n + 1:.4f},{e + 2:.4f},{h + 3:.4f},2025-06-15T15:07:20Z,1.5\n"
        + f"bucket-R,{n:.4f},{e:.4f},{h:.4f},2025-06-15T15:07:30Z,\n"
    )
    left, right = pin_shots(file, machine, site)
    assert (left.name, left.joint, right.joint) == ("bucket-L", "bucket", "bucket")
    assert left.p_world == pytest.approx([2, 1, 3], abs=1e-3)
    assert (right.time_ns - left.time_ns, left.sigma_m) == (10_000_000_000, 0.0015)
    assert right.sigma_m == pytest.approx(site.checks.sigma_mm / 1000)


@pytest.mark.parametrize(
    ("row", "error", "said"),
    [
        ("spoon-L,1,2,3,2025-06-15T15:07:20Z,1", CalibrationError, "'spoon-L' is named after no joint"),
        ("bucket-L,1,2,3,,1", CalibrationError, "shot 'bucket-L' has no time"),
        ("bucket-L,inf,2,3,2025-06-15T15:07:20Z,1", SurfaceError, "expected a number, found 'inf'"),
        ("bucket-L,1e300,2,3,2025-06-15T15:07:20Z,1", SurfaceError, "expected a number, found '1e300'"),
        ("bucket-L,1,2,3,2025-06-15T15:07:20Z,-1", SurfaceError, "is not above zero"),
        ("", CalibrationError, "there is no shot in it"),
    ],
)
def test_a_row_that_is_no_shot_of_a_pin_is_named(files, tmp_path, row, error, said):
    file = tmp_path / "pins.csv"
    file.write_text(HEAD + row + "\n")
    with pytest.raises(error, match=said):
        pin_shots(file, *files)
