"""The bucket on the stake: the true edge stands where it should, and every touch is seen and within the stroke."""

import csv
import datetime
import io

import numpy as np
import pytest

from pipeline.errors import UsageError
from pipeline.synthetic import command, recording, truth
from pipeline.synthetic.touching import check_file


@pytest.fixture(scope="module")
def world():
    return recording.world(command.specification_of("calibration-bucket"), 5)


def test_the_true_edge_stands_on_the_stake_while_it_is_held(world):
    motion, plan = world.motion, world.spec.touches
    for share in (-0.45, 0.0, 0.45):
        at = motion.touch_s + share * plan.hold_s
        middle = truth.edge_points(world.spec, world.truth, motion, at)[:, 1]
        # What the engine shakes; at the very instant that is aimed at, nothing.
        np.testing.assert_allclose(middle, motion.contact, atol=1e-6 if share == 0 else 1.5e-3)
    off = motion.contact - motion.stake
    assert 0.5 < np.std(off) * 1000 / plan.contact_mm < 1.5


def test_the_touches_span_the_angles_that_work_does(world):
    angle = np.rad2deg(world.motion.poses(world.motion.touch_s).joint_rad())
    assert np.ptp(angle) > 140 and np.all(np.diff(angle) > 10)
    _, raw = recording.readings(world, world.spec.sensors[0])
    assert raw.min() > 0.3 and raw.max() < 4.8  # the sensor's own range


def test_the_check_file_has_the_surveyed_stake_and_when_it_was_touched(world):
    rows = list(csv.DictReader(io.StringIO(check_file(world.spec, world.motion))))
    assert len(rows) == 8 and {row["kind"] for row in rows} == {"control"}
    enh = np.array([[float(row[k]) for k in ("easting", "northing", "elevation")] for row in rows])
    np.testing.assert_allclose(enh - world.spec.origin, np.tile(world.motion.surveyed, (8, 1)), atol=1e-4)
    for row, t in zip(rows, world.motion.touch_s):
        told = datetime.datetime.fromisoformat(row["time"]).timestamp() - world.spec.start_utc_ns / 1e9
        assert abs(told - t) < world.spec.touches.hold_s / 2


def test_its_length_is_that_of_its_touches():
    with pytest.raises(UsageError, match="as long as its touches take"):
        command.specification_of("calibration-bucket", minutes=3)
