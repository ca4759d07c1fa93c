"""Poses and the cutting edge against plain matrix products and Monte Carlo, and through Parquet and back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import tables
from pipeline.errors import ArtefactError
from pipeline.geometry import gaussian, se3
from pipeline.tracks import poses, table
from pipeline.tracks.poses import States, cutting_edge, grid_poses

ORIGIN = np.array([512_345.0, 4_123_456.0, 78.0])
WIDTH = 1.2


def covariances(rng, n, sigma_m, sigma_rad):
    """(n, 6, 6) random covariances with correlations."""
    scale = np.repeat([sigma_m, sigma_rad], 3)
    half = rng.normal(size=(n, 6, 9)) * scale[:, None] / 3
    return half @ np.swapaxes(half, 1, 2)


def states_of(n=5, bodies=("cab", "tool"), seed=0, sigma_m=0.004, sigma_rad=0.001):
    rng = np.random.default_rng(seed)
    rows = n * len(bodies)
    joint = np.tile([body == "tool" for body in bodies], n)
    return States(
        time_ns=np.repeat(1_750_000_000_000_000_000 + 100_000_000 * np.arange(n), len(bodies)),
        body=np.tile(np.array(bodies, dtype=object), n),
        p_world=rng.uniform(-20, 20, (rows, 3)),
        q_world_body=Rotation.random(rows, rng=1).as_quat(),
        angle_rad=np.where(joint, 0.3, np.nan),
        seen=rng.random(rows) < 0.8,
        own=gaussian.upper_triangle(covariances(rng, rows, sigma_m, sigma_rad)),
        common=gaussian.upper_triangle(covariances(rng, rows, sigma_m, sigma_rad)),
    )


def test_the_points_of_the_edge_are_half_a_width_along_the_tools_x_axis():
    states = states_of()
    edge = cutting_edge(states, WIDTH, ORIGIN)
    tool = np.flatnonzero(states.body == "tool")
    for k, row in enumerate(tool):
        x_axis = Rotation.from_quat(states.q_world_body[row]).as_matrix()[:, 0]
        for i, x in enumerate((-0.6, 0.0, 0.6)):  # left, middle, right
            wanted = ORIGIN + states.p_world[row] + x * x_axis
            assert np.allclose(edge.p_grid[k, i], wanted, rtol=0, atol=1e-9)
    assert np.array_equal(edge.seen, states.seen[tool])


def test_the_covariance_of_the_edge_predicts_the_scatter_of_a_disturbed_pose():
    states = states_of(n=1, bodies=("tool",))
    edge = cutting_edge(states, WIDTH, ORIGIN)
    rng = np.random.default_rng(2)
    own, common = (gaussian.from_upper_triangle(part[0]) for part in (states.own, states.common))
    T = se3.from_rotation_translation(
        Rotation.from_quat(states.q_world_body[0]).as_matrix(), states.p_world[0]
    )
    for part, whole in ((common, edge.common), (own + common, edge.cov)):
        xi = rng.multivariate_normal(np.zeros(6), part, size=60_000)
        disturbed = T @ se3.exp(xi)
        for i, x in enumerate((-0.6, 0.0, 0.6)):
            scatter = np.cov(se3.transform(disturbed, np.array([x, 0, 0])).T)
            claimed = gaussian.from_upper_triangle(whole[0, i])
            # 60,000 draws tell a variance to 0.6 %; four times that.
            assert np.allclose(scatter, claimed, rtol=0, atol=0.025 * np.abs(claimed).max())


def test_the_published_covariance_is_e_n_h_and_rotations_about_the_grids_axes():
    states = states_of(n=1, bodies=("cab",))
    published = grid_poses(states, ORIGIN)
    rng = np.random.default_rng(3)
    R = Rotation.from_quat(states.q_world_body[0])
    whole = gaussian.from_upper_triangle(states.own[0] + states.common[0])
    xi = rng.multivariate_normal(np.zeros(6), whole, size=60_000)
    disturbed = R * Rotation.from_rotvec(xi[:, 3:])
    turned = (disturbed * R.inv()).as_rotvec()  # about the axes of the grid
    scatter = np.cov(np.hstack([R.apply(xi[:, :3]), turned]).T)
    claimed = gaussian.from_upper_triangle(published.cov[0])
    sigma = np.sqrt(np.diag(claimed))
    assert np.allclose(scatter / np.outer(sigma, sigma), claimed / np.outer(sigma, sigma), rtol=0, atol=0.025)


def test_the_whole_covariance_is_more_than_the_common_part_by_the_own_part():
    states = states_of(n=4)
    nothing = replace(states, own=np.zeros_like(states.own))
    everything, only_common = grid_poses(states, ORIGIN), grid_poses(nothing, ORIGIN)
    assert np.allclose(only_common.cov, everything.common, rtol=1e-12, atol=0)
    difference = gaussian.from_upper_triangle(everything.cov - everything.common)
    assert np.all(gaussian.is_covariance(difference))


def test_the_world_origin_is_added_and_the_axes_stay():
    states = states_of()
    published = grid_poses(states, ORIGIN)
    assert np.allclose(published.p_grid - states.p_world, ORIGIN, rtol=0, atol=1e-8)
    same = np.abs(np.sum(published.q_grid_body * states.q_world_body, axis=1))
    assert np.allclose(same, 1, atol=1e-12)
    assert np.all(published.q_grid_body[:, 3] >= 0)


def test_chunks_change_nothing(monkeypatch):
    states = states_of(n=11)
    whole_poses, whole_edge = grid_poses(states, ORIGIN), cutting_edge(states, WIDTH, ORIGIN)
    monkeypatch.setattr(poses, "CHUNK_ROWS", 3)
    assert np.array_equal(grid_poses(states, ORIGIN).cov, whole_poses.cov)
    assert np.array_equal(cutting_edge(states, WIDTH, ORIGIN).common, whole_edge.common)


def test_the_edge_is_in_the_order_of_time_whatever_the_order_of_the_states():
    states = states_of(n=6)
    shuffled = states.take(np.random.default_rng(4).permutation(len(states)))
    edge, other = cutting_edge(states, WIDTH, ORIGIN), cutting_edge(shuffled, WIDTH, ORIGIN)
    assert np.all(np.diff(other.time_ns) > 0)
    assert np.array_equal(edge.p_grid, other.p_grid)


def test_poses_and_edge_survive_a_round_trip_through_parquet(tmp_path):
    states = states_of(n=7)
    published, edge = grid_poses(states, ORIGIN), cutting_edge(states, WIDTH, ORIGIN)
    tables.write_table(tmp_path / "poses.parquet", "poses", table.columns_of_poses(published))
    back = tables.read_table(tmp_path / "poses.parquet", "poses")
    assert np.array_equal(
        back["cov_h_h"], published.cov[:, 11]
    )  # e n h re rn rh, row by row: h_h is the twelfth
    assert np.array_equal(back["common_rh_rh"], published.common[:, 20])
    assert np.isnan(back["angle_rad"][0]) and back["angle_rad"][1] == 0.3

    tables.write_table(tmp_path / "cutting_edge.parquet", "cutting_edge", table.columns_of_cutting_edge(edge))
    columns = tables.read_table(tmp_path / "cutting_edge.parquet", "cutting_edge", table.EDGE_COLUMNS)
    assert columns["point"][:4].tolist() == ["left", "middle", "right", "left"]
    again = table.cutting_edge_from_columns(columns)
    for name in edge.__dataclass_fields__:
        assert np.array_equal(getattr(again, name), getattr(edge, name)), name


@pytest.mark.parametrize("spoil", ["a row missing", "another order of points", "two epochs at one time"])
def test_a_cutting_edge_that_is_not_left_middle_right_is_refused(spoil):
    columns = table.columns_of_cutting_edge(cutting_edge(states_of(n=3), WIDTH, ORIGIN))
    if spoil == "a row missing":
        columns = {name: values[:-1] for name, values in columns.items()}
    elif spoil == "another order of points":
        columns["point"] = columns["point"][::-1]
    else:
        columns["time_ns"] = np.full_like(columns["time_ns"], 5)
    with pytest.raises(ArtefactError, match="left, middle and right"):
        table.cutting_edge_from_columns(columns)
