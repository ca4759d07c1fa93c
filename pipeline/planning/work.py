"""Where the machine will stand and dig: postures along the trench, in the plane of the arm and around a stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import se3
from pipeline.network.model import Network
from pipeline.planning.postures import Arm, Postures, postures_at


@dataclass(frozen=True, eq=False)
class Trench:
    """The floor along the alignment, in the world."""

    station: np.ndarray
    """(k,) metres."""
    floor: np.ndarray
    """(k, 3) middle of the designed floor."""
    forward: np.ndarray
    """(k, 2) unit vector towards higher stations."""
    ground_m: float
    """Elevation that the tracks stand on."""


@dataclass(frozen=True)
class Habits:
    """How the operator works."""

    reach_m: float = 6.0
    """From the swing centre to the edge while it cuts."""
    sweep_m: float = 1.5
    """Of one pass towards the machine, half before and half behind ``reach_m``."""
    faces: int = -1
    """-1: the machine looks towards lower stations and retreats to higher ones; 1 the other way round."""
    bucket_deg: float = -100.0
    """Direction from the bucket's pin to the edge while it cuts, above the horizontal."""
    bucket_deg_s: float = 10.0
    """How fast the bucket turns meanwhile."""


PASSES = 5
"""Postures over one sweep."""


def cab_pose(xy, heading, z_m):
    """``T_world_cab`` of a level machine, (n, 4, 4); heading (n, 2) unit vectors of the cab's x."""
    x, y = heading[:, 0], heading[:, 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    R = np.stack([x, -y, zero, y, x, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    return se3.from_rotation_translation(R, np.column_stack([xy, np.broadcast_to(z_m, len(xy))]))


def along_trench(
    network: Network, arm: Arm, trench: Trench, habits: Habits
) -> tuple[Postures, np.ndarray, np.ndarray]:
    """Postures that cut the floor at every station, several per station over one sweep.

    Returns
    -------
    Postures
        k ``PASSES`` of them, station by station.
    within : (k PASSES,) bool array
        In reach.
    station : (k PASSES,) int array
        Index of the station.
    """
    k = np.repeat(np.arange(len(trench.station)), PASSES)
    reach = habits.reach_m + habits.sweep_m * np.tile(np.linspace(-0.5, 0.5, PASSES), len(trench.station))
    heading = habits.faces * trench.forward[k]
    T = cab_pose(trench.floor[k, :2] - reach[:, None] * heading, heading, trench.ground_m)
    edge = np.column_stack([reach, trench.floor[k, 2] - trench.ground_m])
    return *_at(network, arm, T, edge, habits), k


def stand_at(trench: Trench, station_m: float, habits: Habits):
    """``T_world_cab``, (4, 4), of the machine that cuts at a station, and the floor below its tracks, m."""
    k = int(np.argmin(np.abs(trench.station - station_m)))
    heading = habits.faces * trench.forward[k : k + 1]
    T = cab_pose(trench.floor[k : k + 1, :2] - habits.reach_m * heading, heading, trench.ground_m)
    return T[0], float(trench.floor[k, 2] - trench.ground_m)


def in_the_arms_plane(network: Network, arm: Arm, T_world_cab, reach_m, height_m, habits: Habits):
    """Postures over a grid of reach and height above the tracks; as ``along_trench``, without stations."""
    reach, height = (g.ravel() for g in np.meshgrid(reach_m, height_m))
    T = np.broadcast_to(T_world_cab, (len(reach), 4, 4))
    return _at(network, arm, T, np.column_stack([reach, height]), habits)


def around(network: Network, arm: Arm, T_world_cab, forward_m, left_m, height_m: float, habits: Habits):
    """Postures that put the edge at one height on a grid forward and left of a stand: the machine swings to each."""
    x, y = (g.ravel() for g in np.meshgrid(forward_m, left_m))
    R = T_world_cab[:2, :2]
    heading = np.column_stack([x, y]) / np.maximum(np.hypot(x, y), 1e-9)[:, None] @ R.T
    T = cab_pose(np.broadcast_to(T_world_cab[:2, 3], (len(x), 2)), heading, T_world_cab[2, 3])
    return _at(network, arm, T, np.column_stack([np.hypot(x, y), np.full(len(x), height_m)]), habits)


def _at(network: Network, arm: Arm, T, edge, habits: Habits) -> tuple[Postures, np.ndarray]:
    return postures_at(network, arm, T, edge, np.deg2rad(habits.bucket_deg), np.deg2rad(habits.bucket_deg_s))
