"""What is seen, what changes bring, and whole plans of the sample's job."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pipeline.cli import main
from pipeline.cli.plan import parse_at
from pipeline.config import load_machine, load_site
from pipeline.errors import PlanningError, UsageError
from pipeline.estimation.repeated import Repeated
from pipeline.geometry import se3, so3
from pipeline.network import network_of
from pipeline.planning.changes import (
    best_place,
    facing_print,
    gain_of,
    with_benchmark,
    with_larger_tags,
    with_longer_lens,
)
from pipeline.planning.postures import (
    Arm,
    chain_of,
    fitted_arm,
    link,
    postures_at,
    postures_from,
    reach_for,
    world_poses,
)
from pipeline.planning.prediction import Setup, predict, predict_elsewhere
from pipeline.planning.sight import (
    HIDDEN,
    OUTSIDE,
    SEEN,
    TOO_SMALL,
    TURNED_AWAY,
    SightRules,
    fitted_noise,
    sight,
)
from pipeline.planning.work import cab_pose
from tests.planning.setups import LOOKING, network, posture, seen_from

SAMPLE = Path("sample_logs/trench")


@pytest.fixture(scope="module")
def sample():
    machine = load_machine((SAMPLE / "machine.toml").read_text(encoding="utf-8"), "machine.toml")
    site = load_site((SAMPLE / "site.toml").read_text(encoding="utf-8"), "site.toml")
    return network_of(machine, site)


def test_the_arm_brings_the_edge_to_where_it_was_wanted(sample):
    wanted = np.array([[5.0, -1.5], [6.5, -0.5], [4.0, 1.0], [20.0, 0.0]])
    T = cab_pose(np.zeros((4, 2)) + [3.0, 4.0], np.tile([0.6, 0.8], (4, 1)), 2.0)
    arm = Arm(stick=chain_of(sample).pin_m)
    at, within = postures_at(sample, arm, T, wanted, np.deg2rad(-95.0))
    assert within.tolist() == [True, True, True, False]
    at = at.take(within)
    tool = world_poses(sample, at)["tool"]
    inside = se3.transform(se3.inverse(T[within]), tool[:, :3, 3])
    # The axis in machine.toml is askew by hundredths of a degree, which 1.25 m of bucket turn into 0.5 mm.
    assert inside[:, [0, 2]] == pytest.approx(wanted[within], abs=1e-3)
    assert np.abs(inside[:, 1]).max() < 3e-3


def test_the_bucket_hangs_in_the_direction_that_was_wanted(sample):
    at = postures_from(sample, Arm(), np.eye(4)[None], *np.deg2rad([[40.0], [-50.0], [-100.0]]))
    T = world_poses(sample, at)
    pin = se3.transform(at.T_world["stick"][0], sample.statics[sample.bodies["bucket"].static].value[:3, 3])
    way = T["tool"][0, :3, 3] - pin
    assert np.rad2deg(np.arctan2(way[2], way[0])) == pytest.approx(-100.0, abs=0.05)


def test_a_log_tells_the_arm_it_was_made_with():
    arm = Arm(0.35, -0.1, 1.7, 4.6, 2.45)
    boom = np.deg2rad(np.linspace(10, 60, 30))
    knee = np.stack([0.35 + 4.6 * np.cos(boom), np.full(30, -0.1), 1.7 + 4.6 * np.sin(boom)], axis=-1)
    found = fitted_arm(link(boom - 1.0, knee), 2.45)
    assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(arm), abs=1e-9)
    with pytest.raises(PlanningError, match="hardly moved"):
        fitted_arm(link(boom[:3] * 0 + 0.5, knee[:3] * 0 + [4.0, 0, 4.0]), 2.45)


def test_law_of_cosines_gives_the_knee():
    boom, stick = reach_for(Arm(0.0, 0.0, 0.0, 3.0, 4.0), np.array([[5.0, 0.0]]))
    assert np.rad2deg([boom[0], stick[0]]) == pytest.approx([53.1301, -36.8699], abs=1e-3)


def one_tag(T_world_tag, **rules):
    """Why the simulator's benchmark camera sees the first tag of the first benchmark, or not, when it stands there."""
    net = network()
    at = posture(net)
    k = next(k for k, m in enumerate(net.markers) if m.name == "B1")
    statics = [*net.statics]
    statics[net.markers[k].mount] = dataclasses.replace(statics[net.markers[k].mount], value=T_world_tag)
    net = dataclasses.replace(net, statics=tuple(statics))
    tag = int(np.flatnonzero(net.tag_marker == k)[0])
    return int(seen_from(net, at, **rules).reason[0, net.camera_index("bench"), tag])


def in_front(distance, turned_deg=0.0, aside=0.0):
    net = network()
    T_camera = posture(net).T_world["cab"][0] @ {s.name: s.value for s in net.statics}["camera bench mount"]
    R = so3.exp(np.pi * np.array([1.0, 0, 0])) @ so3.exp(np.deg2rad(turned_deg) * np.array([0, 1.0, 0]))
    return T_camera @ se3.from_rotation_translation(R, np.array([aside, 0.0, distance]))


def test_why_a_tag_is_not_seen():
    # A tag of 0.35 m with f = 1000 px is 20 px at 17.5 m.
    assert one_tag(in_front(8.0)) == SEEN
    assert one_tag(in_front(17.0)) == SEEN
    assert one_tag(in_front(18.0)) == TOO_SMALL
    assert one_tag(in_front(8.0, 74.0), least_px=5.0) == SEEN
    assert one_tag(in_front(8.0, 80.0), least_px=5.0) == TURNED_AWAY
    assert one_tag(in_front(8.0, 180.0)) == TURNED_AWAY
    assert one_tag(in_front(8.0, aside=7.0)) == OUTSIDE
    assert one_tag(in_front(-8.0)) == OUTSIDE


def test_the_boom_hides_what_is_behind_it():
    net = network()
    at = posture(net)
    T_world = world_poses(net, at)
    camera = T_world["cab"][0] @ net.statics[net.cameras[0].mount].value
    plain = sight(net, T_world, SightRules())
    of_benchmark = np.array([net.markers[m].benchmark for m in net.tag_marker])
    tag = int(np.flatnonzero(plain.seen[0, 0] & of_benchmark)[0])
    k = net.tag_marker[tag]
    target = (T_world[net.markers[k].body][0] @ net.statics[net.markers[k].mount].value)[:3, 3]
    between = 0.5 * (camera[:3, 3] + target)
    T_cab = T_world["cab"][0]
    for lift, expected in ((0.0, HIDDEN), (0.2, HIDDEN), (1.5, SEEN)):
        foot = se3.transform(se3.inverse(T_cab), between + [-2.0, 0.0, lift])
        T_world["stick"] = se3.from_rotation_translation(np.eye(3), between + [2.0, 0.0, lift])[None]
        seen = sight(net, T_world, SightRules(), Arm(*foot, 4.0, 0.01), ("cab", "stick"))
        assert seen.reason[0, 0, tag] == expected


def test_the_noise_model_is_found_again():
    side = np.geomspace(20, 160, 50)
    model = fitted_noise(side, 0.03 * (40 / side) ** 0.8)
    assert (model.at_40_px, model.power) == pytest.approx((0.03, 0.8))


def small_work(net):
    at = [posture(net, m, rate=0.1) for m in (-0.3, 0.0, 0.4)]
    return type(at[0])(*({k: np.concatenate([getattr(a, f)[k] for a in at]) for k in getattr(at[0], f)}
                         for f in ("T_world", "angle", "rate")))  # fmt: skip


def setup_of(net):
    return Setup(net, None, ("cab", "stick"), LOOKING, looks=3.0)


def test_changes_bring_what_they_must():
    net = network()
    work = small_work(net)
    before = gain_of("as it is", setup_of(net), work)
    larger = gain_of("larger", setup_of(with_larger_tags(net, 1.5, True)), work)
    longer = with_longer_lens(net, 1.1, "bench")
    assert larger.sigma_m < before.sigma_m and larger.seen == before.seen == 1.0
    assert longer.statics[longer.cameras[0].intrinsics].value[:2] == pytest.approx([1100.0, 1102.2])
    assert with_larger_tags(net, 2.0, False).tag_corners[0] == pytest.approx(2 * net.tag_corners[0])


def test_the_best_place_is_the_one_that_helps_most():
    net = network()
    work = small_work(net)
    behind, ahead = [0.0, -9.0, 1.3], [0.0, 8.0, 1.5]
    best, tried = best_place(setup_of(net), work, np.array([behind, ahead]), "B1")
    assert best is tried[1]
    assert best.gain.score_m < gain_of("as it is", setup_of(net), work).score_m
    # A print behind the machine is not seen and changes nothing.
    assert tried[0].gain.sigma_m == pytest.approx(gain_of("as it is", setup_of(net), work).sigma_m, rel=1e-9)


def test_a_further_benchmark_has_a_print_and_a_prior_of_its_own():
    net = network()
    more = with_benchmark(net, facing_print([0.0, 8.0, 1.5], [0.0, 0.0, 2.0]), "B1")
    assert len(more.markers) == len(net.markers) + 1 and len(set(more.tag_id.tolist())) == len(more.tag_id)
    T = more.statics[more.markers[-1].mount].value
    assert T[:3, 2] == pytest.approx([0, -1, 0]) and T[:3, 1] == pytest.approx([0, 0, 1])


def test_postures_of_the_work_are_the_same_asked_for_later():
    net = network()
    work = small_work(net)
    shift = predict(setup_of(net), work)
    again = predict_elsewhere(setup_of(net), work.take([1]), shift)
    assert again.edge.total[0] == pytest.approx(shift.edge.total[1], rel=1e-9)


def test_what_the_shift_has_told_stays_told_where_other_tags_are_seen():
    """With constant errors of corners among the statics: new ones have their priors, all others what the shift left."""
    net = network()
    errors = dataclasses.replace(LOOKING, repeated=Repeated())
    setup = Setup(net, None, ("cab", "stick"), errors, looks=3.0)
    near = dataclasses.replace(setup, rules=dataclasses.replace(setup.rules, least_px=30))
    shift = predict(near, small_work(net))
    there = predict_elsewhere(setup, posture(net, 0.2, rate=0.1), shift)
    names = [{s.name: k for k, s in enumerate(p.found.network.statics)} for p in (shift, there)]
    assert set(names[0]) < set(names[1])
    columns = [p.found.statics.columns for p in (shift, there)]
    told = [np.concatenate([c[n[name]] for name in names[0]]) for c, n in zip(columns, names, strict=True)]
    new = np.concatenate([columns[1][names[1][name]] for name in names[1] if name not in names[0]])
    P = np.linalg.inv(there.S)
    assert P[np.ix_(told[1], told[1])] == pytest.approx(
        np.linalg.inv(shift.S)[np.ix_(told[0], told[0])], abs=1e-9
    )
    assert P[np.ix_(new, new)] == pytest.approx(np.eye(len(new)))
    assert np.abs(P[np.ix_(told[1], told[1])] - np.eye(len(told[1]))).max() > 0.1


@pytest.mark.parametrize("text", ["6", "reach=6", "a,b,c", "reach=6,deep=2", "1,2,3,4"])
def test_a_posture_that_cannot_be_read_is_said(text):
    with pytest.raises(UsageError, match="boom,stick,bucket"):
        parse_at(text)


def run_plan(*arguments):
    files = [str(SAMPLE / "machine.toml"), str(SAMPLE / "site.toml")]
    return CliRunner().invoke(main, ["plan", *files, "--points", "10", *arguments], catch_exceptions=False)


def test_the_command_writes_a_page_and_its_numbers(tmp_path):
    out = tmp_path / "plan.html"
    done = run_plan("--area", "106:110", "--no-search", "--at", "reach=6,depth=1.5", "--out", str(out))
    assert done.exit_code == 0, done.output
    assert "The tolerance can be met: U = 2 sigma" in done.output
    content = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert content["state"] == "good"
    line = content["parts"][1]["pictures"][0]["data"]["rows"]
    assert [row["station"] for row in line] == [106, 107, 108, 109, 110]
    # U² = k² (own² + common²)
    for row in line:
        assert row["u"] ** 2 == pytest.approx(row["own"] ** 2 * 4 + row["common"] ** 2 * 4, rel=0.02)
    html = out.read_text(encoding="utf-8")
    assert html.count("<svg") == 4 and "http" not in html.replace("http-equiv", "")
    again = tmp_path / "again.html"
    run_plan("--area", "106:110", "--no-search", "--at", "reach=6,depth=1.5", "--out", str(again))
    assert again.read_bytes() == out.read_bytes()


def test_where_the_edge_is_not_seen_is_said(tmp_path):
    done = run_plan("--area", "108:120", "--no-search", "--out", str(tmp_path / "plan.html"))
    assert "stations only" in done.output


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("--area", "500:510"), "is not on the trench"),
        (("--area", "5"), "give 2 numbers"),
        (("--reach", "14"), "out of reach"),
        (("--at", "reach=30,depth=1", "--area", "106:108"), "does not reach"),
        (("--log", "sample_logs"), "not the run folder"),
    ],
)
def test_a_fault_is_one_sentence_and_nothing_is_written(tmp_path, arguments, said):
    out = tmp_path / "plan.html"
    done = run_plan("--no-search", "--out", str(out), *arguments)
    assert done.exit_code in (2, 3) and said in done.output
    assert not out.exists()
