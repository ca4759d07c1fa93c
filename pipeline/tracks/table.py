"""The columns of ``states``, ``poses`` and ``cutting_edge``, to and from arrays."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np

from pipeline.errors import ArtefactError
from pipeline.tracks.poses import POINTS, CuttingEdge, Poses, States

Columns = dict[str, np.ndarray]

_BODY_AXES = ("x", "y", "z", "rx", "ry", "rz")
_GRID_AXES = ("e", "n", "h", "re", "rn", "rh")
_POINT_AXES = ("e", "n", "h")
_QUATERNION = ("qx", "qy", "qz", "qw")


def triangle_names(prefix: str, axes: tuple[str, ...]) -> list[str]:
    """Names of the columns of an upper triangle, row by row: ``cov_e_e cov_e_n ...``."""
    return [f"{prefix}_{a}_{b}" for a, b in combinations_with_replacement(axes, 2)]


EDGE_COLUMNS = [
    "time_ns", "point", "e", "n", "h", "seen",
    *triangle_names("cov", _POINT_AXES),
    *triangle_names("common", _POINT_AXES),
]  # fmt: skip
"""Columns that `cutting_edge_from_columns` needs."""


def states_from_columns(columns: Columns) -> States:
    """States from the columns of the ``states`` table."""
    return States(
        time_ns=columns["time_ns"],
        body=columns["body"],
        p_world=_stack(columns, ["x_m", "y_m", "z_m"]),
        q_world_body=_stack(columns, _QUATERNION),
        angle_rad=columns["angle_rad"],
        seen=columns["seen"],
        own=_stack(columns, triangle_names("own", _BODY_AXES)),
        common=_stack(columns, triangle_names("common", _BODY_AXES)),
    )


def columns_of_poses(poses: Poses) -> Columns:
    """Columns of the ``poses`` table."""
    return {
        "time_ns": poses.time_ns,
        "body": poses.body,
        **_split(poses.p_grid, _POINT_AXES),
        **_split(poses.q_grid_body, _QUATERNION),
        "angle_rad": poses.angle_rad,
        "seen": poses.seen,
        **_split(poses.cov, triangle_names("cov", _GRID_AXES)),
        **_split(poses.common, triangle_names("common", _GRID_AXES)),
    }


def columns_of_cutting_edge(edge: CuttingEdge) -> Columns:
    """Columns of the ``cutting_edge`` table: per epoch left, middle, right."""
    n = len(edge)
    return {
        "time_ns": np.repeat(edge.time_ns, 3),
        "point": np.tile(np.array(POINTS, dtype=object), n),
        **_split(edge.p_grid.reshape(3 * n, 3), _POINT_AXES),
        "seen": np.repeat(edge.seen, 3),
        **_split(edge.cov.reshape(3 * n, 6), triangle_names("cov", _POINT_AXES)),
        **_split(edge.common.reshape(3 * n, 6), triangle_names("common", _POINT_AXES)),
    }


def cutting_edge_from_columns(columns: Columns) -> CuttingEdge:
    """The cutting edge from its columns.

    Raises
    ------
    ArtefactError
        When the rows are not left, middle, right of one epoch after the other.
    """
    time_ns = columns["time_ns"]
    point = columns.get("point")
    whole = len(time_ns) % 3 == 0
    if whole:
        epochs = time_ns.reshape(-1, 3)
        whole = bool(np.all(epochs == epochs[:, :1])) and bool(np.all(np.diff(epochs[:, 0]) > 0))
    if whole and point is not None:
        whole = all(bool(np.all(point[i::3] == name)) for i, name in enumerate(POINTS))
    if not whole:
        raise ArtefactError(
            "cutting_edge.parquet does not hold left, middle and right of one epoch after the other; "
            "delete it and run the track stage again"
        )
    n = len(time_ns) // 3
    return CuttingEdge(
        time_ns=np.ascontiguousarray(time_ns[::3]),
        p_grid=_stack(columns, _POINT_AXES).reshape(n, 3, 3),
        seen=np.ascontiguousarray(columns["seen"][::3]),
        cov=_stack(columns, triangle_names("cov", _POINT_AXES)).reshape(n, 3, 6),
        common=_stack(columns, triangle_names("common", _POINT_AXES)).reshape(n, 3, 6),
    )


def _stack(columns: Columns, names: list[str] | tuple[str, ...]) -> np.ndarray:
    out = np.empty((len(columns[names[0]]), len(names)))
    for i, name in enumerate(names):
        out[:, i] = columns[name]
    return out


def _split(rows: np.ndarray, names: list[str] | tuple[str, ...]) -> Columns:
    assert rows.shape[1] == len(names), (rows.shape, names)
    return {name: np.ascontiguousarray(rows[:, i]) for i, name in enumerate(names)}
