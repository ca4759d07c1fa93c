"""A cluster told from drawn corners: OpenCV projects them, so nothing is shared with the adjustment."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.calibration import cluster as clusters
from pipeline.calibration.cluster import calibrate_cluster, cluster_machine, cluster_of, point_sigma_m
from pipeline.config import load_machine, load_site
from pipeline.errors import CalibrationError
from pipeline.estimation.repeated import WHITE
from pipeline.geometry import se3
from pipeline.network import network_of
from pipeline.network.model import Observations
from pipeline.synthetic import calibration_log, calibration_sites

SIGMA_PX = 0.05
START_NS = 1_750_000_000_000_000_000


@pytest.fixture(scope="module")
def yard():
    """Machine, site, truth and network of one drawn rig."""
    drawn = calibration_sites.calibration_site(calibration_sites.CLUSTER, 4)
    machine = load_machine(
        calibration_log.machine_text(drawn.spec, drawn.files, drawn.sigma, bucket_board=False), "machine.toml"
    )
    site = load_site(calibration_log.site_toml(drawn), "site.toml")
    return drawn, machine, site, network_of(cluster_machine(machine, "bench"), site)


def seen(drawn, network, rng, delay_s=0.0, cameras=("bench", "arm"), scale=1.0):
    """What cameras see at each stop of the swing."""
    rows = {key: [] for key in ("camera", "tag", "time_ns", "uv")}
    for stop in range(len(calibration_sites.STOPS_DEG)):
        t = stop * (calibration_sites.REST_S + calibration_sites.TURN_S) + 0.3
        T_world_cab = drawn.motion.poses(np.array([t])).T_world_cab[0]
        for name in cameras:
            lens = drawn.truth.intrinsics[name]
            K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
            T_camera_world = np.linalg.inv(T_world_cab @ drawn.truth.cameras[name])
            for tag, (m, corners) in enumerate(zip(network.tag_marker, network.tag_corners, strict=True)):
                T = T_camera_world @ drawn.truth.benchmarks[network.markers[m].name]
                p = scale * corners @ T[:3, :3].T + T[:3, 3]
                if p[:, 2].min() < 1 or T[:3, 2] @ T[:3, 3] > 0:
                    continue
                uv = cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, lens[4:])[0].reshape(4, 2)
                if uv.min() < 3 or uv[:, 0].max() > 636 or uv[:, 1].max() > 476:
                    continue
                rows["camera"].append(network.camera_index(name))
                rows["tag"].append(tag)
                rows["time_ns"].append(START_NS + round((t + (name == "arm") * delay_s) * 1e9))
                rows["uv"].append(uv + rng.normal(size=(4, 2)) * SIGMA_PX)
    n = len(rows["tag"])
    return Observations(
        np.array(rows["camera"]),
        np.array(rows["tag"]),
        np.array(rows["time_ns"], dtype=np.int64),
        np.array(rows["uv"]),
        np.tile(np.eye(2) * SIGMA_PX**2, (n, 4, 1, 1)),
    )


def error_of(drawn, pair):
    T = np.linalg.inv(drawn.truth.cameras[pair.first]) @ drawn.truth.cameras[pair.second]
    return se3.local(pair.T_first_second, T)


def test_one_rig_lies_within_its_covariance_and_everything_on_the_way_agrees(yard):
    drawn, _, site, network = yard
    found = cluster_of(network, seen(drawn, network, np.random.default_rng(0)), site, "bench", repeated=WHITE)
    (pair,) = found.pairs
    e = error_of(drawn, pair)
    # 99.9 % of a chi-square of six.
    assert e @ np.linalg.solve(pair.covariance, e) < 22.5
    assert pair.sigma_m < 0.003 and pair.sigma_rad < np.deg2rad(0.03)
    assert pair.instants == len(calibration_sites.STOPS_DEG)
    # The reference is exact, so the other's mount has the pair's covariance, whichever of the two is named first.
    assert np.all(found.mounts["bench"][1] == 0)
    assert pair.first == "bench"
    assert found.mounts["arm"][1] == pytest.approx(pair.covariance, rel=1e-9, abs=1e-15)
    assert found.mounts["bench"][0] @ pair.T_first_second == pytest.approx(found.mounts["arm"][0], abs=1e-12)
    assert 0.8 < found.whole.sigma0 < 1.2
    # A loop of two pictures is as good as single pictures are: some millimetres, some hundredths of a degree.
    assert len(pair.closures.xi) == pair.instants
    assert 0.0003 < pair.closures.rms_m < 0.02 and pair.closures.rms_rad < np.deg2rad(0.2)
    assert found.defines_body


@pytest.mark.slow
def test_errors_and_halves_scatter_as_their_covariances_say():
    lengths, halves = [], []
    for seed in range(12):
        drawn = calibration_sites.calibration_site(calibration_sites.CLUSTER, 100 + seed)
        machine = load_machine(
            calibration_log.machine_text(drawn.spec, drawn.files, drawn.sigma, bucket_board=False),
            "machine.toml",
        )
        site = load_site(calibration_log.site_toml(drawn), "site.toml")
        network = network_of(cluster_machine(machine, "bench"), site)
        found = cluster_of(
            network, seen(drawn, network, np.random.default_rng(seed)), site, "bench", repeated=WHITE
        )
        e = error_of(drawn, found.pairs[0])
        lengths.append(e @ np.linalg.solve(found.pairs[0].covariance, e))
        xi, expected = found.cross["arm"]
        halves.append(xi @ np.linalg.solve(expected, xi))
    # Means of 12 chi-squares of six degrees of freedom: sigma 1.0.
    assert 3.5 < np.mean(lengths) < 9.0
    assert 3.5 < np.mean(halves) < 9.0


def test_a_tag_that_only_one_half_of_the_log_saw_is_compared_all_the_same(yard):
    drawn, _, site, network = yard
    rows = seen(drawn, network, np.random.default_rng(0))
    shy = rows.tag[0]
    rows = rows.take((rows.tag != shy) | (np.arange(len(rows.tag)) == np.flatnonzero(rows.tag == shy)[0]))
    found = cluster_of(network, rows, site, "bench")  # with the errors that come back among the statics
    xi, expected = found.cross["arm"]
    # 99.9 % of a chi-square of six.
    assert xi @ np.linalg.solve(expected, xi) < 22.5


def test_a_camera_that_shares_no_instant_is_named(yard):
    drawn, _, site, network = yard
    apart = seen(drawn, network, np.random.default_rng(0), delay_s=1.0)
    with pytest.raises(CalibrationError, match="camera 'bench' shares no instant with any other"):
        cluster_of(network, apart, site, "bench")


def test_a_camera_that_saw_nothing_and_too_few_views_are_named(yard):
    drawn, _, site, network = yard
    alone = seen(drawn, network, np.random.default_rng(0), cameras=("bench",))
    with pytest.raises(CalibrationError, match="camera 'arm' saw no marker of the site"):
        cluster_of(network, alone, site, "bench")
    both = seen(drawn, network, np.random.default_rng(0))
    few = both.take(both.time_ns <= np.unique(both.time_ns)[2])
    with pytest.raises(CalibrationError, match=r"shares only 3 instants .* too few views"):
        cluster_of(network, few, site, "bench")


def test_a_print_of_another_size_contradicts_the_pictures(yard):
    drawn, _, site, network = yard
    # Where it is off by this much the adjustment may not even end; either way the size is named.
    with pytest.raises(CalibrationError, match=r"contradicts? the (files|log).* size"):
        cluster_of(network, seen(drawn, network, np.random.default_rng(0), scale=1.05), site, "bench")


@pytest.mark.parametrize("stated", [0.7, 1.5])
def test_corners_count_with_the_scatter_of_the_log_and_not_with_what_is_stated(yard, stated):
    drawn, _, site, network = yard
    rows = seen(drawn, network, np.random.default_rng(0))
    found = [
        cluster_of(network, replace(rows, cov=factor**2 * rows.cov), site, "bench", repeated=WHITE)
        for factor in (1.0, stated)
    ]
    true, other = (f.pairs[0] for f in found)
    print(f"{1e3 * true.sigma_m:.2f} mm, with sigmas {stated} times as large {1e3 * other.sigma_m:.2f} mm")
    assert other.sigma_m == pytest.approx(true.sigma_m, rel=0.05)
    assert other.sigma_rad == pytest.approx(true.sigma_rad, rel=0.05)
    assert found[1].whole.sigma0 == pytest.approx(found[0].whole.sigma0 / stated, rel=0.05)


@pytest.mark.parametrize("scale", [0.99, 1.01])
def test_prints_one_in_a_hundred_off_are_named_by_the_benchmarks(yard, scale):
    drawn, _, site, network = yard
    with pytest.raises(
        CalibrationError, match=r"\d+ of \d+ benchmarks are off: most likely the prints are of another"
    ):
        cluster_of(
            network,
            seen(drawn, network, np.random.default_rng(0), scale=scale),
            site,
            "bench",
            repeated=WHITE,
        )


def test_what_a_print_one_in_a_hundred_too_large_would_have_put_into_the_file(yard, monkeypatch):
    drawn, _, site, network = yard
    monkeypatch.setattr(clusters, "refuse_contradiction", lambda whole: {})
    found = cluster_of(
        network, seen(drawn, network, np.random.default_rng(0), scale=1.01), site, "bench", repeated=WHITE
    )
    off_m = np.linalg.norm(error_of(drawn, found.pairs[0])[:3])
    print(
        f"mount {1e3 * off_m:.0f} mm off, sigma {1e3 * found.pairs[0].sigma_m:.1f} mm, sigma0 {found.whole.sigma0:.2f}"
    )
    assert off_m > 10 * found.pairs[0].sigma_m and found.whole.sigma0 < 2


def test_one_benchmark_with_a_wrong_survey_is_named_alone(yard):
    drawn, _, site, network = yard
    rows = seen(drawn, network, np.random.default_rng(0))
    statics = list(network.statics)
    wrong = next(m for m in network.markers if m.name == "wall-3")
    at = statics[wrong.mount]
    statics[wrong.mount] = replace(at, value=at.value @ se3.exp(np.array([0.02, 0, 0, 0, 0, 0])))
    with pytest.raises(
        CalibrationError, match=r"'wall-3' lies (19|20|21) mm .* check its survey in site\.toml"
    ):
        cluster_of(replace(network, statics=tuple(statics)), rows, site, "bench", repeated=WHITE)


def test_the_machine_is_cut_down_to_the_cluster_and_wrong_references_are_named(yard):
    _, machine, _, _ = yard
    cut = cluster_machine(machine, "arm")
    assert list(cut.bodies) == ["cab"] and not cut.markers and not cut.sensors
    assert cut.cameras["bench"].mount is None
    assert np.all(cut.cameras["arm"].mount.covariance_xi() == 0)
    with pytest.raises(CalibrationError, match=r"no camera 'left' in machine\.toml; known are bench, arm"):
        cluster_machine(machine, "left")
    cameras = {**machine.cameras, "arm": machine.cameras["arm"].model_copy(update={"body": "stick"})}
    with pytest.raises(CalibrationError, match="'bench' is alone on 'cab'"):
        cluster_machine(machine.model_copy(update={"cameras": cameras}), "bench")


def test_a_body_that_carries_more_than_cameras_is_not_defined_by_one(yard):
    _, machine, _, _ = yard
    assert clusters.defines_body(machine, "cab")
    assert not clusters.defines_body(machine, "stick")


def test_point_sigma_in_closed_form():
    covariance = np.diag([1e-6, 1e-6, 1e-6, 4e-8, 4e-8, 1.0])
    # The turn about the axis itself moves no point of it.
    assert point_sigma_m(covariance, 10.0) == pytest.approx(np.hypot(0.001, 0.002))


def test_nothing_seen_is_named(yard):
    _, machine, site, _ = yard
    empty = {key: np.zeros(0, object) for key in ("family", "tag_id", "status", "time_ns")}
    empty |= {f"{a}{k}": np.zeros(0) for a in "uv" for k in range(4)}
    empty |= {f"cov{k}_{c}": np.zeros(0) for c in ("uu", "uv", "vv") for k in range(4)}
    with pytest.raises(CalibrationError, match="saw no marker of the site"):
        calibrate_cluster(machine, site, "bench", {"bench": empty, "arm": empty})
