"""The machine moves as a machine can, and its parts hang together at any time."""

import numpy as np
import pytest

from pipeline.geometry import linkage, se3
from pipeline.synthetic import recording, specification, truth
from pipeline.synthetic.cycle import PHASES, bucket_pose
from pipeline.synthetic.excavator import joint_directions, raw_reading, true_curve


@pytest.fixture(scope="module", params=["trench", "other"])
def world(request):
    return recording.world(specification.SITES[request.param](), seed=3)


def test_the_boom_stick_and_bucket_reach_the_point_they_are_sent_to(world):
    arm = world.spec.arm
    tip = np.array([[6.5, -1.2], [4.2, 0.4], [5.0, 3.0]])
    bucket = np.deg2rad([-80.0, -150.0, -60.0])
    boom, stick = joint_directions(arm, tip, bucket)

    def leg(length, angle):
        return length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    reached = arm.foot + leg(arm.boom_m, boom) + leg(arm.stick_m, stick) + leg(arm.bucket_m, bucket)
    np.testing.assert_allclose(reached, tip, atol=1e-12)
    knee = arm.foot + leg(arm.boom_m, boom)
    assert np.all(knee[:, 1] > tip[:, 1])  # the elbow is up


def test_the_edge_follows_the_chain_of_pins(world):
    """The truth's edge against the plain product of its links, without the code that placed them."""
    p = world.motion.poses(np.array([5.0, 6.5]))
    T = bucket_pose(p.stick(world.spec), world.truth.axis, p.joint_rad()) @ world.truth.tool
    edge = truth.edge_points(world.spec, world.truth, world.motion, p.t)
    np.testing.assert_allclose(edge[:, 1], T[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(edge[:, 2] - edge[:, 0], axis=1), world.spec.arm.width_m)
    # "right" is to the operator's right, who looks along the cab's x.
    right = -p.T_world_cab[:, :3, 1]
    assert np.all(np.sum((edge[:, 2] - edge[:, 0]) * right, axis=1) > 0.99 * world.spec.arm.width_m)


def test_motion_is_smooth(world):
    """No jump of speed anywhere, and no jump of acceleration: halving the step halves every difference."""
    t = np.arange(0.5, world.motion.duration_s - 0.5, 0.01)

    def acceleration(step):
        at = [world.motion.poses(t + k * step) for k in (-1, 0, 1)]
        p = [se3.transform(x.stick(world.spec), np.array([2.0, 0.3, 0.0])) for x in at]
        return (p[0] - 2 * p[1] + p[2]) / step**2

    coarse, fine = acceleration(2e-3), acceleration(1e-3)
    assert np.abs(fine).max() < 25.0  # m/s²: brisk, not impossible
    assert np.abs(coarse - fine).max() < 0.05 * np.abs(fine).max()


def test_while_it_digs_the_edge_follows_the_wanted_floor(world):
    """Within what the machine shakes, and what a pass leaves for the next one."""
    t = np.concatenate([np.arange(s.start_s + 1.3, s.start_s + 4.4, 0.02) for s in world.motion.sweeps])
    edge = truth.edge_points(world.spec, world.truth, world.motion, t)[:, 1]
    station, offset = world.motion.place.station_offset(edge)
    above = edge[:, 2] - world.motion.floor(station)
    assert np.abs(offset).max() < 0.05
    assert above.min() > -0.02
    last = t > world.motion.sweeps[-1].start_s
    assert np.sqrt(np.mean(above[last] ** 2)) < 0.006
    speed = np.linalg.norm(np.diff(edge, axis=0), axis=1) / 0.02
    assert 0.5 < np.median(speed) < 0.9


def test_every_phase_of_the_work_occurs(world):
    found = set(world.motion.phase(np.arange(0, world.motion.duration_s, 0.1)))
    wanted = set(PHASES) - ({"tram"} if world.spec.cycles == 1 else set())
    assert found == wanted


def test_the_edge_stands_still_on_the_control_point(world):
    start, end = world.motion.control_stop_s
    assert end - start > 4.0
    edge = truth.edge_points(world.spec, world.truth, world.motion, np.arange(start, end, 0.05))[:, 1]
    assert np.linalg.norm(edge - world.motion.control_point, axis=1).max() < 0.012


def test_a_reading_leads_back_to_the_angle_of_the_bucket(world):
    angle = world.motion.poses(np.arange(0, world.motion.duration_s, 0.2)).joint_rad()
    for sensor in world.spec.sensors:
        raw = raw_reading(sensor.kind, angle, world.truth, 1, sensor.name)
        y = np.polyval(true_curve(sensor.kind)[::-1], raw)
        if sensor.kind == "potentiometer":
            assert raw.min() > 0.4 and raw.max() < 4.8  # a 5 V converter
            back = linkage.bucket_angle(y, np.append(world.truth.linkage, 0.0), 1)
        else:
            back = np.deg2rad(y)
        np.testing.assert_allclose(back, angle, atol=1e-9)


def test_the_true_floor_is_the_lowest_pass():
    """Against a brute search over a dense sweep, at a few cells."""
    w = recording.world(specification.trench(), seed=3)
    floor = truth.dug_floor(w.spec, w.truth, w.motion, 0.05)
    middle = floor.z.shape[1] // 2
    t = np.arange(0, w.motion.duration_s, 0.002)
    edge = truth.edge_points(w.spec, w.truth, w.motion, t)
    s, _ = w.motion.place.station_offset(edge[:, 1])
    cut = np.flatnonzero(np.isfinite(floor.z[:, middle]))
    for row in cut[10:-10:25]:
        near = np.abs(s - floor.station[row]) < 0.002
        lowest = edge[near, 1, 2].min()
        assert floor.z[row, middle] == pytest.approx(lowest, abs=0.002)  # the offset is half a cell
