"""From the two files to a network: what hangs where, and what is unknown with which prior."""

import copy
import datetime

import numpy as np
import pytest

from pipeline.config import Machine, Site
from pipeline.errors import ConfigError, NetworkError
from pipeline.geometry import se3, so3
from pipeline.network import network_of
from pipeline.network.build import rigid_fit
from pipeline.network.model import SOURCES
from tests.estimation.simulator import MACHINE, SITE


def _network(machine=None, site=None, date=None):
    return network_of(Machine.model_validate(machine or MACHINE), Site.model_validate(site or SITE), date)


def test_every_calibrated_quantity_is_a_static_with_the_prior_of_its_file():
    network = _network()
    assert {s.source for s in network.statics} == set(SOURCES)
    mount = next(s for s in network.statics if s.name == "camera bench mount")
    np.testing.assert_allclose(np.sqrt(np.diagonal(mount.covariance)), [0.002] * 3 + [np.deg2rad(0.05)] * 3)
    board = next(s for s in network.statics if s.name == "benchmark B1 pose")
    np.testing.assert_allclose(board.value[:3, 3], [-2.5, 9.0, 1.2])  # grid minus origin
    assert sum(s.scale.shape[1] for s in network.statics) == 75


def test_components_without_variance_are_exact_and_no_unknowns():
    network = _network()
    linkage = next(s for s in network.statics if s.name == "sensor pot linkage")
    assert linkage.scale.shape == (9, 8) and not linkage.scale[8].any()


def test_a_full_covariance_comes_back_from_its_square_root():
    A = np.random.default_rng(0).standard_normal((6, 4)) * np.array([1e-3] * 3 + [1e-2] * 3)[:, None]
    machine = copy.deepcopy(MACHINE)
    mount = machine["cameras"]["dig"]["mount"]
    machine["cameras"]["dig"]["mount"] = {k: mount[k] for k in ("xyz_m", "rpy_deg")} | {
        "covariance": (A @ A.T).tolist()
    }
    static = next(s for s in _network(machine).statics if s.name == "camera dig mount")
    assert static.scale.shape == (6, 4)  # two directions are exact
    np.testing.assert_allclose(static.scale @ static.scale.T, A @ A.T, atol=1e-12)


def test_worn_teeth_draw_the_edge_back_along_z_and_add_their_sigma():
    machine = copy.deepcopy(MACHINE)
    machine["cutting_edge"]["wear"] = [
        {"date": "2025-03-01", "wear_mm": 10.0, "sigma_mm": 1.0},
        {"date": "2025-06-01", "wear_mm": 30.0, "sigma_mm": 4.0},
    ]
    fresh = _network().statics[_network().tool]
    for date, wear, sigma in (
        (datetime.date(2025, 1, 1), 0, 0),
        (datetime.date(2025, 4, 1), 10, 1),
        (None, 30, 4),
    ):
        network = _network(machine, date=date)
        tool = network.statics[network.tool]
        shift = se3.inverse(fresh.value) @ tool.value
        np.testing.assert_allclose(shift[:3, 3], [0, 0, -wear / 1000], atol=1e-12)
        assert tool.covariance[2, 2] == pytest.approx(0.003**2 + (sigma / 1000) ** 2)
    # A rotation of the mount moves the worn edge less far: its lever is shorter.
    lever = 0.03 * np.deg2rad(0.2)
    assert tool.covariance[0, 0] == pytest.approx(0.003**2 + lever**2)


def test_a_benchmark_from_corner_shots_has_the_pose_and_covariance_that_its_scatter_shows():
    rng = np.random.default_rng(3)
    p = np.array([[-0.3, 0.3, 0], [0.3, 0.3, 0], [0.3, -0.3, 0], [-0.3, -0.3, 0.0]])
    truth = se3.from_rotation_translation(so3.from_rpy_deg([80.0, 5.0, 30.0]), [3.0, 9.0, 1.0])
    errors = []
    for _ in range(2000):
        T, cov = rigid_fit(p, se3.transform(truth, p) + 0.002 * rng.standard_normal((4, 3)), 0.002)
        errors.append(se3.local(T, truth))
    scatter = np.cov(np.array(errors).T)
    sigma = np.sqrt(np.diagonal(cov))
    assert np.abs((scatter - cov) / np.outer(sigma, sigma)).max() < 0.1  # 2000 runs: 0.03


def _corner_site(corners):
    site = copy.deepcopy(SITE)
    board = site["benchmarks"]["B1"]
    pose = board.pop("pose")
    T = se3.from_rotation_translation(so3.from_rpy_deg(pose["rpy_deg"]), np.array(pose["enh"]))
    tags = {t["id"]: t for t in board["tags"]}
    signs = [(-1, 1), (1, 1), (1, -1), (-1, -1)]
    board["corners"] = []
    for tag, corner in corners:
        t = tags[tag]
        p = [
            t["x_m"] + signs[corner][0] * t["size_m"] / 2,
            t["y_m"] + signs[corner][1] * t["size_m"] / 2,
            0.0,
        ]
        board["corners"].append({"tag": tag, "corner": corner, "enh": se3.transform(T, np.array(p)).tolist()})
    board["sigma_corner_mm"] = 2.0
    return site


def test_surveyed_corners_stand_in_for_a_surveyed_pose():
    site = _corner_site([(0, 0), (1, 1), (2, 2), (2, 3)])
    static = next(s for s in _network(site=site).statics if s.name == "benchmark B1 pose")
    expected = next(s for s in _network().statics if s.name == "benchmark B1 pose")
    np.testing.assert_allclose(static.value, expected.value, atol=1e-6)


def test_corners_on_a_line_are_refused_in_words():
    with pytest.raises(NetworkError, match="'B1' lie on one line"):
        _network(site=_corner_site([(0, 0), (0, 1), (1, 0), (1, 1)]))


def test_corners_that_do_not_fit_the_print_are_refused_in_words():
    site = _corner_site([(0, 0), (1, 1), (2, 2)])
    site["benchmarks"]["B1"]["corners"][1]["corner"] = 3
    with pytest.raises(NetworkError, match="do not fit its print"):
        _network(site=site)


def test_a_tag_on_two_markers_and_a_name_used_twice_are_refused():
    machine = copy.deepcopy(MACHINE)
    machine["markers"]["stick"]["tags"][0]["id"] = 0
    with pytest.raises(ConfigError, match=r"tag 0 of tag36h11 stands on both 'stick' and 'B1'"):
        _network(machine)
    machine = copy.deepcopy(MACHINE)
    machine["markers"]["B1"] = machine["markers"].pop("stick")
    with pytest.raises(NetworkError, match="both a marker of the machine and a benchmark"):
        _network(machine)


def test_a_camera_without_intrinsics_is_refused_in_words():
    machine = copy.deepcopy(MACHINE)
    machine["cameras"]["dig"].pop("intrinsics")
    with pytest.raises(NetworkError, match="camera 'dig' has no intrinsics"):
        _network(machine)
