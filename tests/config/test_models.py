"""What the models say about uncertainty and units, and that their exported schemas are up to date."""

import numpy as np
import pytest

from pipeline.config import Machine, Site, load_machine, load_site
from pipeline.config.export import exported, schema_file
from pipeline.config.machine import Intrinsics
from pipeline.config.quantities import Pose, Tag
from pipeline.config.site import METRES_PER_UNIT
from pipeline.errors import ConfigError


@pytest.mark.parametrize("name", ["machine", "site"])
def test_committed_schema_is_the_exported_one(name):
    assert schema_file(name).read_text(encoding="utf-8") == exported(name), "run `make schemas`"


def test_two_sigmas_and_their_covariance_say_the_same():
    by_sigma = Pose(xyz_m=(1, 2, 3), rpy_deg=(10, 20, 30), sigma_mm=(1.0, 2.0, 3.0), sigma_deg=0.1)
    matrix = np.diag([1e-6, 4e-6, 9e-6] + [np.deg2rad(0.1) ** 2] * 3)
    by_matrix = Pose(xyz_m=(1, 2, 3), rpy_deg=(10, 20, 30), covariance=tuple(map(tuple, matrix.tolist())))
    np.testing.assert_allclose(by_sigma.covariance_xi(), by_matrix.covariance_xi(), rtol=1e-12)
    np.testing.assert_array_equal(by_sigma.transform(), by_matrix.transform())


def test_rpy_turns_about_fixed_x_then_y_then_z():
    # Roll 90 takes y to z; yaw 90 then takes x to y: the child's x axis lies along the parent's y, its y along z.
    T_parent_child = Pose(xyz_m=(0, 0, 0), rpy_deg=(90, 0, 90), sigma_mm=0, sigma_deg=0).transform()
    np.testing.assert_allclose(T_parent_child[:3, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)


@pytest.mark.parametrize(
    "covariance, said",
    [
        (np.eye(5), "6x6"),
        (np.eye(6) + np.eye(6, k=1), "symmetric"),
        (np.diag([1, 1, 1, 1, 1, -1.0]), "negative eigenvalue"),
    ],
)
def test_matrix_that_is_no_covariance_is_refused(covariance, said):
    with pytest.raises(ValueError, match=said):
        Pose(xyz_m=(0, 0, 0), rpy_deg=(0, 0, 0), covariance=tuple(map(tuple, covariance.tolist())))


def test_tag_corners_run_as_seen_on_the_print():
    tag = Tag(id=0, size_m=0.2, x_m=1.0)
    np.testing.assert_allclose(
        tag.corners(), [[0.9, 0.1, 0], [1.1, 0.1, 0], [1.1, -0.1, 0], [0.9, -0.1, 0]], atol=1e-15
    )


def test_the_two_feet_differ_by_four_feet_at_two_million():
    assert METRES_PER_UNIT["international_foot"] == 0.3048
    difference_m = 2_000_000 * (METRES_PER_UNIT["us_survey_foot"] - METRES_PER_UNIT["international_foot"])
    assert difference_m == pytest.approx(1.219, abs=1e-3)


@pytest.mark.parametrize("unit", METRES_PER_UNIT)
def test_grid_and_world_are_inverse_and_keep_tenths_of_a_millimetre(site_text, unit):
    text = site_text.replace('unit = "m"', f'unit = "{unit}"')
    grid = load_site(text, "site.toml").grid
    p_world = grid.to_world([1003.5, 2010.25, 51.2])
    np.testing.assert_allclose(p_world / METRES_PER_UNIT[unit], [3.5, 10.25, 1.2], atol=1e-9)
    np.testing.assert_allclose(
        grid.to_grid_metres(p_world), np.array([1003.5, 2010.25, 51.2]) * METRES_PER_UNIT[unit], atol=1e-9
    )


def test_benchmark_pose_is_in_world_metres(site_text):
    site = load_site(site_text.replace('unit = "m"', 'unit = "us_survey_foot"'), "site.toml")
    pose = site.benchmark_pose("bm1")
    np.testing.assert_allclose(pose.transform()[:3, 3], np.array([3.5, 10.25, 1.2]) * 1200 / 3937, atol=1e-12)
    assert site.benchmark_pose("bm2") is None


def test_intrinsics_left_out_come_from_the_log(machine_text):
    start, end = machine_text.index("[cameras.front.intrinsics]"), machine_text.index("[markers.plate]")
    bare = machine_text[:start] + machine_text[end:]
    sigma = 'body = "cab"\nintrinsics_sigma = [1, 1, 1, 1, 0, 0, 0, 0, 0]'
    machine = load_machine(bare.replace('body = "cab"', sigma), "machine.toml")
    found = {
        "topic": "/front/calibration",
        "width": 640,
        "height": 480,
        "fx": 851.0,
        "fy": 852.0,
        "cx": 320.0,
        "cy": 240.0,
        "distortion": [0.1, 0.0, 0.0, 0.0, 0.0],
    }
    resolved = machine.with_calibrations({"front": found}, "machine.toml").cameras["front"].intrinsics
    np.testing.assert_array_equal(resolved.vector(), [851, 852, 320, 240, 0.1, 0, 0, 0, 0])
    np.testing.assert_array_equal(np.diag(resolved.covariance_matrix()), [1, 1, 1, 1, 0, 0, 0, 0, 0])
    with pytest.raises(ConfigError, match="camera 'front' has no intrinsics"):
        machine.with_calibrations({}, "machine.toml")
    with pytest.raises(ConfigError, match="intrinsics_sigma"):
        load_machine(bare, "machine.toml").with_calibrations({"front": found}, "machine.toml")
    with pytest.raises(ConfigError, match=r"/front/calibration\) cannot be used"):
        machine.with_calibrations({"front": {**found, "fx": 0.0}}, "machine.toml")


def test_intrinsics_in_the_machine_file_win_over_those_of_the_log(machine_text):
    machine = load_machine(machine_text, "machine.toml")
    assert machine.with_calibrations({}, "machine.toml") == machine


@pytest.mark.parametrize("form", ["both", "neither"])
def test_intrinsics_need_exactly_one_form_of_uncertainty(form):
    facts = {"width": 640, "height": 480, "fx": 850.0, "fy": 850.0, "cx": 319.5, "cy": 239.5}
    if form == "both":
        facts |= {"sigma": (1.0,) * 9, "covariance": tuple(map(tuple, np.eye(9).tolist()))}
    with pytest.raises(ValueError, match="either sigma"):
        Intrinsics(**facts)


def test_parents_that_run_in_a_circle_are_refused(machine_text):
    text = machine_text.replace(
        '[bodies.stick]\nkind = "moving"',
        machine_text[machine_text.index("[bodies.bucket]") :]
        .split("\n\n")[0]
        .replace("bodies.bucket", "bodies.stick")
        .replace('"stick"', '"bucket"'),
    )
    with pytest.raises(ConfigError, match="circle"):
        load_machine(text, "machine.toml")


def test_models_never_change_after_loading(machine_text, site_text):
    machine, site = load_machine(machine_text, "m"), load_site(site_text, "s")
    with pytest.raises(ValueError, match="frozen"):
        machine.cutting_edge.width_m = 2.0
    assert isinstance(machine, Machine)
    assert isinstance(site, Site)
