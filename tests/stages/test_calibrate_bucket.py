"""Stands and touches out of a track, and what is put into machine.toml."""

import datetime

import numpy as np
import pytest

from pipeline.calibration import bucket
from pipeline.calibration import standings as t
from pipeline.calibration.agreement import kept_of
from pipeline.config import load_machine
from pipeline.config.rewriting import with_values
from pipeline.errors import CalibrationError
from pipeline.estimation.sensitivities import Sensitivities, Source
from pipeline.network import network_of
from pipeline.report.bucket_sheet import BucketFacts
from pipeline.stages.bucket_files import points_of, rig_of, values_of, wear_values
from pipeline.stages.calibrate_bucket import sensor_of
from pipeline.surface.parked import KnownPoint
from pipeline.surface.rests import Rests
from pipeline.surface.shots import NO_TIME, Shots
from pipeline.synthetic import files, recording
from pipeline.synthetic.touched_stake import calibration_bucket
from pipeline.tracks.poses import States
from tests.calibration.rigs import drawn

DAY = datetime.date(2025, 6, 15)
S = 10**9


@pytest.fixture(scope="module")
def world():
    return recording.world(calibration_bucket(), 3)


@pytest.fixture(scope="module")
def text(world):
    return files.machine_toml(world.spec, world.files, world.sigma)


@pytest.fixture(scope="module")
def machine(text):
    return load_machine(text, "machine.toml")


@pytest.fixture(scope="module")
def site(world):
    from pipeline.config import load_site

    return load_site(files.site_toml(world.spec, world.files), "site.toml")


def states_at(time_s, x, own_mm=1.0):
    """The pin's frame at rest, moved along x; own sigma in mm per epoch."""
    n = len(time_s)
    own = np.zeros((n, 21))
    own[:, [0, 6, 11]] = (np.broadcast_to(own_mm, n)[:, None] / 1000) ** 2
    return States(
        time_ns=np.round(np.asarray(time_s) * S).astype(np.int64), body=np.full(n, "tool", object),
        p_world=np.column_stack([x, np.zeros(n), np.ones(n)]), q_world_body=np.tile([0.0, 0, 0, 1], (n, 1)),
        angle_rad=np.full(n, np.nan), seen=np.ones(n, bool), own=own, common=np.zeros((n, 21)),
    )  # fmt: skip


def test_a_rest_is_cut_where_the_reading_moves_and_averaged_over_what_is_left():
    time_s = np.arange(0, 8, 0.1)
    readings = np.arange(0, 8, 0.05)
    raw = np.where(readings < 3, 1.0, np.where(readings < 4, 1.0 + (readings - 3), 2.0))
    raw = raw + 0.001 * np.resize([1, -1], len(raw))
    states = states_at(time_s, np.where(time_s < 4, 5.0, 5.5))
    rests = Rests(np.array([0]), np.array([len(time_s)]))
    found = t.standings(
        states, rests, states.time_ns, None, 0.1, np.round(readings * S).astype(np.int64), raw, 0.002
    )
    assert [round(f.stand.raw, 2) for f in found] == [1.0, 2.0]
    assert found[0].first_ns >= 0.1 * S and found[0].last_ns <= 2.95 * S and found[1].first_ns >= 4.05 * S
    np.testing.assert_allclose(found[0].stand.T_world_axis[:3, 3], [5.0, 0, 1.0], atol=1e-12)
    kept = np.count_nonzero((readings * S >= found[0].first_ns) & (readings * S <= found[0].last_ns))
    assert found[0].stand.raw_sigma == pytest.approx(0.002 / np.sqrt(kept), rel=0.02)
    # Errors of 0.1 s in a mean over 2.6 s or so: 2 tau / T (1 - tau / T).
    span = 2.6
    share = 2 * 0.1 / span * (1 - 0.1 / span)
    assert found[0].stand.own[0, 0] == pytest.approx(1e-6 * share, rel=0.08)


def test_epochs_between_two_pictures_do_not_count():
    time_s = np.arange(0, 3, 0.1)
    blind = np.arange(len(time_s)) % 2 == 1
    states = states_at(time_s, np.where(blind, 5.1, 5.0), np.where(blind, 3.0, 1.0))
    rests = Rests(np.array([0]), np.array([len(time_s)]))
    stamps = np.round(np.arange(0, 3, 0.05) * S).astype(np.int64)
    found = t.standings(states, rests, states.time_ns, None, 0.1, stamps, np.ones(len(stamps)), 0.002)
    np.testing.assert_allclose(found[0].stand.T_world_axis[0, 3], 5.0, atol=1e-12)


def test_what_the_factors_say_is_shared_and_the_rest_of_the_common_part_is_own():
    states = states_at(np.arange(0, 3, 0.1), np.full(30, 5.0), 1e-6)
    states.common[:, 0] = 5e-6
    response = np.zeros((30, 2, 6), np.float32)
    response[:, 1, 0] = 0.002  # 4e-6 m² of the 5e-6 along easting
    answer = Sensitivities(
        states.time_ns, (Source("wear", "", "", "m"), Source("common", "1", "", "sigma")), response
    )
    rests = Rests(np.array([0]), np.array([30]))
    stamps = np.round(np.arange(0, 3, 0.05) * S).astype(np.int64)
    stand = t.standings(states, rests, states.time_ns, answer, 0.1, stamps, np.ones(60), 0.002)[0].stand
    np.testing.assert_allclose(stand.factors, [[0.002], [0], [0], [0], [0], [0]], atol=1e-9)
    assert stand.own[0, 0] == pytest.approx(1e-6, rel=1e-3)


def standing(first_s, x=0.0):
    states = states_at(np.arange(first_s, first_s + 2, 0.1), np.full(20, x))
    stamps = np.round(np.arange(first_s, first_s + 2, 0.05) * S).astype(np.int64)
    rests = Rests(np.array([0]), np.array([20]))
    return t.standings(states, rests, states.time_ns, None, 0.1, stamps, np.ones(40), 0.002)[0]


def associate(found, shots, known=None):
    return t.touched(
        found, shots, known or {}, np.array([100.0, 0, 0]), 1.25, 1.0, 0.15, 5.0, 0.002, 0.001, "middle"
    )


def rows(kind, times_s, points=None, name="P"):
    n = len(times_s)
    return Shots(
        np.full(n, name, object), np.full(n, "", object),
        np.tile([101.25, 0.0, 1.0], (n, 1)) if points is None else np.array(points, float),
        kind=np.full(n, kind, object),
        time_ns=np.array([NO_TIME if s is None else round(s * S) for s in times_s], np.int64),
    )  # fmt: skip


def test_rows_with_a_time_go_to_the_stand_nearest_in_time():
    found = [standing(10), standing(20, 0.3)]
    told = associate(found, rows("control", [11.0, 23.5, 40.0, 11.2]))
    assert [x.stand for x in told.touches] == [0, 1] and len(told.stands) == 2
    assert told.left_out == {
        "row at whose time the machine did not stand still": 1,
        "second row of one touch": 1,
    }
    np.testing.assert_allclose(told.touches[0].p_world, [1.25, 0, 1.0])
    assert (
        told.touches[0].sigma_m == 0.001 and told.points == [0.002] and told.touches[0].edge_point == "middle"
    )
    assert told.touches[0].name == "P at 00:00:11"


def test_a_point_without_times_is_where_the_edge_could_reach_it():
    # Pins 1.25 m away, 1.45 m away (too far), and beside the bucket's plane.
    found = [standing(10), standing(20, -0.2), standing(30)]
    found[2].stand.T_world_axis[2, 3] = 2.0
    told = associate(found, rows("control", [None]))
    assert [x.stand for x in told.touches] == [0] and told.stands[0].name == "00:00:10"
    assert not told.touches[0].by_time
    known = {"K": KnownPoint(np.array([101.25, 0, 1.0]), 0.004)}
    told = associate(found, rows("floor", [1.0]), known)
    assert len(told.touches) == 1 and told.points == [0.004] and told.left_out == {"shot of the floor": 1}


def test_shots_of_the_parked_edge_stand_for_themselves():
    told = associate([standing(10)], rows("edge", [11.0, None]))
    assert told.touches[0].point == -1 and told.touches[0].sigma_m == 0.002 and told.points == []
    assert told.left_out == {"shot of the edge without a time": 1}


def test_the_machine_ends_at_the_pin(machine, site):
    reduced, joint = t.machine_to_the_pin(machine)
    assert joint == "bucket" and set(reduced.bodies) == {"cab", "stick"} and reduced.sensors == {}
    network = network_of(reduced, site)
    tool = network.statics[network.tool]
    np.testing.assert_allclose(tool.value, machine.bodies["bucket"].axis.transform())
    assert np.all(tool.covariance == 0) and network.tool_body == "stick"
    # Its ends are as far from the pin as the bucket reaches: what turns them is shared, not each epoch's own.
    reach = np.hypot(*machine.cutting_edge.mount.xyz_m[:2])
    assert network.edge_m == pytest.approx(2 * reach)


def test_a_bucket_without_an_angle_is_refused(text):
    fixed = load_machine(text.replace('body = "bucket"', 'body = "stick"'), "machine.toml")
    with pytest.raises(CalibrationError, match="'stick' is no body of kind 'joint'"):
        t.machine_to_the_pin(fixed)


def test_a_sensor_is_named_where_there_are_several(machine):
    assert sensor_of(machine, None) == "bucket-pot"
    with pytest.raises(
        CalibrationError, match="no sensor of that name reads the joint 'bucket'; there is bucket-pot"
    ):
        sensor_of(machine, "other")
    pot = machine.sensors["bucket-pot"]
    with pytest.raises(CalibrationError, match="2 sensors read the joint"):
        sensor_of(machine.model_copy(update={"sensors": {"a": pot, "b": pot}}), None)


def facts_of(found, kept, wear_m=None):
    return BucketFacts(
        machine="ex-14", sensor="bucket-pot", adjusted=found, kept=kept, touch_names=(), point_names=(), left_out={},
        wear_m=wear_m, tolerance_m=0.01, date=DAY, log="touches.mcap", log_sha256="a" * 64, checks=None,
        machine_sha256="b" * 64,
    )  # fmt: skip


def test_the_new_machine_file_loads_and_holds_curve_tool_and_provenance(machine, text, site):
    d = drawn(2)
    found = bucket.adjust(d.rig, d.stands, d.touches, list(d.points.values()))
    kept = kept_of(found, "bucket-pot")
    values = values_of(machine, "bucket", "bucket-pot", kept, facts_of(found, kept))
    after = load_machine(with_values(text, "machine.toml", values), "machine.toml")
    sensor = after.sensors["bucket-pot"]
    np.testing.assert_allclose(sensor.curve.coefficients, kept.coefficients, rtol=1e-9)
    # Ten digits must do for sigma over the stroke, which is a small difference of large numbers.
    raw = np.linspace(*kept.stroke, 9)
    powers = raw[:, None] ** np.arange(len(kept.coefficients))
    sigma = [
        np.sqrt(np.einsum("ni,ij,nj->n", powers, C, powers))
        for C in (sensor.curve.covariance_matrix(), kept.covariance)
    ]
    np.testing.assert_allclose(sigma[0], sigma[1], rtol=1e-3)
    told = sensor.curve.calibrated
    assert (told.date, told.source, told.sha256, told.raw_range) == (
        DAY,
        "touches.mcap",
        "a" * 64,
        pytest.approx(kept.stroke),
    )
    assert told.by == "gradetrace calibrate bucket" and sensor.curve.sigma is None
    assert sensor.linkage.sigma_mm == 0 and sensor.linkage.sigma_horn_angle_deg == 0
    np.testing.assert_allclose(after.cutting_edge.mount.transform(), kept.T_bucket_tool, atol=1e-8)
    axis = after.bodies["bucket"].axis
    before = np.diag(machine.bodies["bucket"].axis.covariance_xi()).copy()
    before[5] = 0.0
    np.testing.assert_allclose(np.diag(axis.covariance_xi()), before)
    network_of(after, site, DAY)


def test_the_rig_counts_the_turn_of_the_axis_once(machine, site):
    rig = rig_of(machine, site, "bucket-pot", DAY, wear=False)
    assert np.all(rig.axis[5] == 0) and np.all(rig.axis[:, 5] == 0)
    spec = calibration_bucket().sigmas
    assert np.rad2deg(np.sqrt(rig.bars_covariance[7, 7])) == pytest.approx(
        np.hypot(spec.horn_deg, spec.axis_deg)
    )
    assert rig.curve is None and rig.coefficients == 3
    worn = rig_of(machine, site, "bucket-pot", DAY, wear=True)
    assert worn.curve is not None and worn.tool[2, 2] == pytest.approx(0.2**2 + rig.tool[2, 2])


def test_wear_is_entered_by_date_and_never_negative(machine):
    d = drawn(2)
    found = bucket.adjust(d.rig, d.stands, d.touches, list(d.points.values()))
    entry = wear_values(machine, facts_of(found, None, 0.012))["cutting_edge.wear"]
    assert [(e["date"], e["wear_mm"]) for e in entry] == [(DAY, 12.0)] and entry[0]["sigma_mm"] > 0
    with pytest.raises(CalibrationError, match=r"reach 20.0 mm further than cutting_edge.mount says"):
        wear_values(machine, facts_of(found, None, -0.020))


def test_a_point_is_given_by_coordinates_or_by_name(site, tmp_path):
    _, known = points_of(None, "356137.0466,5812427.2143,36.0", site)
    np.testing.assert_allclose(known["point"].p_grid, [356137.0466, 5812427.2143, 36.0])
    file = tmp_path / "checks.csv"
    file.write_text("point,northing,easting,elevation,kind,sigma_mm\nTP1,20,10,3,control,1.5\n")
    shots, known = points_of(
        file, "TP1", site
    )  # headings count for more than the order that site.toml states
    np.testing.assert_allclose(known["TP1"].p_grid, [10, 20, 3])
    assert known["TP1"].sigma_m == 0.0015 and len(shots) == 1
    with pytest.raises(CalibrationError, match="--point TP9: no such point"):
        points_of(file, "TP9", site)
    with pytest.raises(CalibrationError, match="no point is known"):
        points_of(None, None, site)


def test_the_point_that_is_named_is_the_only_one_whatever_its_rows_are_called(site, tmp_path):
    file = tmp_path / "checks.csv"
    file.write_text(
        "point,northing,easting,elevation,kind\nTP1,20,10,3,control\nTP2,21,11,3,control\nTP1,20,10,3,\nE,1,2,3,edge\n"
    )
    shots, known = points_of(file, "TP1", site)
    assert list(known) == ["TP1"]
    assert list(zip(shots.point, shots.kind, strict=True)) == [("TP1", "control")] * 2 + [("E", "edge")]
    with pytest.raises(CalibrationError, match=r"touches of several points \(TP1, TP2\); name one"):
        points_of(file, "10,20,3.1", site)
    file.write_text("point,northing,easting,elevation,kind\nTP1,20,10,3,control\n")
    _, known = points_of(file, "10,20,3.1", site)
    np.testing.assert_allclose(known["TP1"].p_grid, [10, 20, 3.1])
    for text in ("10,20,inf", "10,twenty,3"):
        with pytest.raises(CalibrationError, match="write E,N,H as three numbers"):
            points_of(file, text, site)


def test_a_file_that_says_of_no_row_that_it_is_a_touch_is_refused(site, tmp_path):
    file = tmp_path / "checks.csv"
    file.write_text("point,northing,easting,elevation,time\nTP1,20,10,3,2025-06-15T15:06:10Z\n")
    with pytest.raises(CalibrationError, match="add a column kind with control or edge"):
        points_of(file, None, site)
    shots, _ = points_of(file, "TP1", site)
    assert list(shots.kind) == ["control"]
