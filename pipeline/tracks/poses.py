"""Poses and the cutting edge in the survey grid, with the whole covariance and its common part.

The adjustment works in the world frame with errors on the right of each pose; what is published stands in grid
metres, with errors along the axes of the grid. A state carries its covariance in two parts: *own* averages out over
epochs, *common* is shared by all of them. Published are the whole (own + common) and the common part, so that whoever
averages knows what will not shrink.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.geometry import gaussian, se3, so3

TOOL = "tool"
POINTS = ("left", "middle", "right")
# 6x6 matrices of one chunk take 19 MB apiece; a shift has a million rows.
CHUNK_ROWS = 65_536


@dataclass(frozen=True)
class States:
    """Rows of the ``states`` table: bodies at epochs, in the world frame."""

    time_ns: np.ndarray
    """(n,) int64, UTC."""
    body: np.ndarray
    """(n,) names; ``tool`` is the cutting edge's frame."""
    p_world: np.ndarray
    """(n, 3) origin of the body, metres."""
    q_world_body: np.ndarray
    """(n, 4) quaternion x y z w."""
    angle_rad: np.ndarray
    """(n,) joint angle; nan for a body that is no joint."""
    seen: np.ndarray
    """(n,) bool; false where the state is bridged over a gap."""
    own: np.ndarray
    """(n, 21) upper triangle of the own part, right perturbation ``[rho, phi]``, m and rad."""
    common: np.ndarray
    """(n, 21) upper triangle of the common part."""

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, rows: np.ndarray | slice) -> States:
        """Some of the rows, by mask, index or slice."""
        return States(**{name: getattr(self, name)[rows] for name in self.__dataclass_fields__})


@dataclass(frozen=True)
class Poses:
    """Rows of the ``poses`` table: bodies at epochs, in the grid."""

    time_ns: np.ndarray
    """(n,) int64, UTC."""
    body: np.ndarray
    """(n,) names."""
    p_grid: np.ndarray
    """(n, 3) easting, northing, elevation of the body's origin, metres."""
    q_grid_body: np.ndarray
    """(n, 4) quaternion x y z w, w >= 0."""
    angle_rad: np.ndarray
    """(n,) joint angle, or nan."""
    seen: np.ndarray
    """(n,) bool."""
    cov: np.ndarray
    """(n, 21) upper triangle of the whole covariance, order e n h re rn rh, m and rad."""
    common: np.ndarray
    """(n, 21) upper triangle of its common part."""


@dataclass(frozen=True)
class CuttingEdge:
    """The cutting edge at each epoch, as three points in the grid."""

    time_ns: np.ndarray
    """(n,) int64, UTC, ascending."""
    p_grid: np.ndarray
    """(n, 3, 3): point (left, middle, right as the operator sees it), then easting, northing, elevation, metres."""
    seen: np.ndarray
    """(n,) bool; false where the edge is bridged over a gap."""
    cov: np.ndarray
    """(n, 3, 6): per point, upper triangle e_e e_n e_h n_n n_h h_h of the whole covariance, m²."""
    common: np.ndarray
    """(n, 3, 6): the common part."""

    def __len__(self) -> int:
        return len(self.time_ns)


def grid_poses(states: States, origin_m: np.ndarray) -> Poses:
    """Every state as a pose in the grid.

    Parameters
    ----------
    states : States
        Of any bodies.
    origin_m : (3,) array
        The world's origin in grid metres.

    Returns
    -------
    Poses
        Row by row those of ``states``.
    """
    n = len(states)
    cov, common = np.empty((n, 21)), np.empty((n, 21))
    q = np.empty((n, 4))
    for rows in _chunks(n):
        T_world_body = _transforms(states, rows)
        q[rows] = so3.to_quaternion(T_world_body[:, :3, :3])
        own_grid = se3.to_grid_covariance(T_world_body, gaussian.from_upper_triangle(states.own[rows]))
        common_grid = se3.to_grid_covariance(T_world_body, gaussian.from_upper_triangle(states.common[rows]))
        common[rows] = gaussian.upper_triangle(common_grid)
        cov[rows] = gaussian.upper_triangle(own_grid + common_grid)
    return Poses(
        time_ns=states.time_ns,
        body=states.body,
        p_grid=states.p_world + np.asarray(origin_m, dtype=np.float64),
        q_grid_body=q,
        angle_rad=states.angle_rad,
        seen=states.seen,
        cov=cov,
        common=common,
    )


def cutting_edge(states: States, width_m: float, origin_m: np.ndarray) -> CuttingEdge:
    """Left end, middle and right end of the cutting edge in the grid.

    Parameters
    ----------
    states : States
        Rows of other bodies than ``tool`` are passed over.
    width_m : float
        Length of the edge; its ends are at x = ± width / 2 of the tool frame.
    origin_m : (3,) array
        The world's origin in grid metres.

    Returns
    -------
    CuttingEdge
        In the order of time.
    """
    tool = np.flatnonzero(states.body == TOOL)
    states = states.take(tool[np.argsort(states.time_ns[tool], kind="stable")])
    n = len(states)
    p_tool = np.array([[-0.5 * width_m, 0, 0], [0, 0, 0], [0.5 * width_m, 0, 0]])
    p_grid = np.empty((n, 3, 3))
    cov, common = np.empty((n, 3, 6)), np.empty((n, 3, 6))
    for rows in _chunks(n):
        T_world_tool = _transforms(states, rows)
        own_xi = gaussian.from_upper_triangle(states.own[rows])
        common_xi = gaussian.from_upper_triangle(states.common[rows])
        for i, p in enumerate(p_tool):
            p_grid[rows, i] = se3.transform(T_world_tool, p) + origin_m
            common_point = gaussian.tool_point_covariance(T_world_tool, common_xi, p)
            own_point = gaussian.tool_point_covariance(T_world_tool, own_xi, p)
            common[rows, i] = gaussian.upper_triangle(common_point)
            cov[rows, i] = gaussian.upper_triangle(own_point + common_point)
    return CuttingEdge(time_ns=states.time_ns, p_grid=p_grid, seen=states.seen, cov=cov, common=common)


def _chunks(n: int) -> Iterator[slice]:
    for start in range(0, n, CHUNK_ROWS):
        yield slice(start, min(start + CHUNK_ROWS, n))


def _transforms(states: States, rows: slice) -> np.ndarray:
    return se3.from_rotation_translation(so3.from_quaternion(states.q_world_body[rows]), states.p_world[rows])
