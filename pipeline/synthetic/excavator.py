"""The machine as it really is: bodies, pins, mounts, and the pose of each at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import linkage, se3, so3
from pipeline.synthetic.specification import Arm, BoardPlan, CameraPlan, Specification


def arm_frame(direction_rad: np.ndarray, xz: np.ndarray) -> np.ndarray:
    """``T_cab_link`` of a link in the plane of the arm.

    The cab's axes are x forward, y left, z up; a link's are x along it, y up in the plane of the arm, z to the
    right, so that a turn about z is counter-clockwise for one who looks at the machine from its right side.

    Parameters
    ----------
    direction_rad : (...,) array
        Of the link above the horizontal.
    xz : (..., 2) array
        Its origin in the cab frame, metres.

    Returns
    -------
    (..., 4, 4) array
    """
    c, s = np.cos(direction_rad), np.sin(direction_rad)
    T = np.zeros(np.shape(direction_rad) + (4, 4))
    T[..., 0, 0], T[..., 2, 0] = c, s
    T[..., 0, 1], T[..., 2, 1] = -s, c
    T[..., 1, 2] = -1.0
    T[..., 0, 3], T[..., 2, 3] = xz[..., 0], xz[..., 1]
    T[..., 3, 3] = 1.0
    return T


def along(direction_rad: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 2) in the plane of the arm."""
    return np.stack([np.cos(direction_rad), np.sin(direction_rad)], axis=-1)


def joint_directions(arm: Arm, tip_xz: np.ndarray, bucket_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions of boom and stick that bring the edge to a point with a wanted direction of the bucket.

    Parameters
    ----------
    arm : Arm
        Lengths and foot.
    tip_xz : (..., 2) array
        Cutting edge in the plane of the arm, cab frame, metres.
    bucket_rad : (...,) array
        Direction from the bucket's pin to the edge, above the horizontal.

    Returns
    -------
    boom_rad, stick_rad : (...,) arrays
        Above the horizontal; the boom's end is the upper of the two solutions.
    """
    pin = tip_xz - arm.bucket_m * along(bucket_rad) - np.array(arm.foot)
    distance = np.hypot(pin[..., 0], pin[..., 1])
    reach = arm.boom_m + arm.stick_m
    assert np.all(distance < reach - 0.02), f"out of reach: {distance.max():.2f} m of {reach:.2f} m"
    cosine = (arm.boom_m**2 + distance**2 - arm.stick_m**2) / (2 * arm.boom_m * distance)
    boom = np.arctan2(pin[..., 1], pin[..., 0]) + np.arccos(cosine)
    knee = arm.boom_m * along(boom)
    stick = np.arctan2(pin[..., 1] - knee[..., 1], pin[..., 0] - knee[..., 0])
    return boom, stick


def looking(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """``R_cab_camera`` of a camera (x right, y down, z forward) that looks along a yaw and a pitch."""
    yaw, pitch = np.deg2rad(yaw_deg), np.deg2rad(pitch_deg)
    z = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    x = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    R = np.stack([x, np.cross(z, x), z], axis=-1)
    return R @ so3.exp(np.array([0.0, 0.0, np.deg2rad(roll_deg)]))


def facing(normal: np.ndarray, up: np.ndarray) -> np.ndarray:
    """``R_parent_marker`` of a marker (x right, y up, z out of the print) with a normal and an upward hint."""
    z = normal / np.linalg.norm(normal)
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=-1)


@dataclass(frozen=True)
class Board:
    """A printed board: tags in the marker frame."""

    name: str
    family: str
    ids: np.ndarray
    """(n,) int."""
    centres: np.ndarray
    """(n, 2) metres in the marker frame."""
    tag_m: float
    size: tuple[float, float]
    """Width and height of the panel, metres."""

    def corners(self) -> np.ndarray:
        """(n, 4, 3) corners of the black borders, TL TR BR BL, metres in the marker frame."""
        signs = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
        xy = self.centres[:, None] + 0.5 * self.tag_m * signs
        return np.concatenate([xy, np.zeros(xy.shape[:-1] + (1,))], axis=-1)


def board(plan: BoardPlan, family: str) -> Board:
    """The board that a plan describes."""
    pitch = plan.tag_m + plan.gap_m
    x = (np.arange(plan.columns) - 0.5 * (plan.columns - 1)) * pitch
    y = (0.5 * (plan.rows - 1) - np.arange(plan.rows)) * pitch
    centres = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1).reshape(-1, 2)
    size = tuple(n * plan.tag_m + (n - 1) * plan.gap_m + 2 * plan.margin_m for n in (plan.columns, plan.rows))
    ids = plan.first_id + np.arange(plan.rows * plan.columns)
    return Board(plan.name, family, ids, centres, plan.tag_m, (size[0], size[1]))


@dataclass(frozen=True)
class Mounts:
    """Everything on the machine and the site that does not move; the truth, or what a file says."""

    cameras: dict[str, np.ndarray]
    """``T_cab_camera``."""
    intrinsics: dict[str, np.ndarray]
    """(9,) fx fy cx cy k1 k2 p1 p2 k3."""
    benchmarks: dict[str, np.ndarray]
    """``T_world_marker``."""
    stick_marker: np.ndarray
    """``T_stick_marker``."""
    axis: np.ndarray
    """``T_stick_axis`` of the bucket."""
    tool: np.ndarray
    """``T_bucket_tool``."""
    linkage: np.ndarray
    """(8,) anchor x y, pivot x y, rocker, coupler, horn, metres; horn angle, radians."""
    curves: dict[str, np.ndarray]
    """Coefficients by sensor."""
    time_offsets: dict[str, float]
    """Seconds by sensor."""


def true_mounts(spec: Specification, rng: np.random.Generator) -> Mounts:
    """The machine and site as built: the plan, with mounts that nobody put exactly square."""

    def uneven(T: np.ndarray, metres: float, degrees: float) -> np.ndarray:
        return se3.retract(T, rng.normal(size=6) * np.repeat([metres, np.deg2rad(degrees)], 3))

    cameras = {
        c.name: uneven(_pose(looking(c.yaw_deg, c.pitch_deg, c.roll_deg), c.position), 0.01, 0.5)
        for c in spec.cameras
    }
    f = spec.focal
    intrinsics = {
        c.name: np.array(
            [
                f + rng.normal(0, 2e-3 * f),
                f + rng.normal(0, 2e-3 * f),
                0.5 * (spec.width - 1) + rng.normal(0, 0.004 * spec.width),
                0.5 * (spec.height - 1) + rng.normal(0, 0.004 * spec.width),
                *c.distortion,
            ]
        )
        for c in spec.cameras
    }
    for vector in intrinsics.values():
        vector[1] = vector[0] + rng.normal(0, 3e-4 * f)
    place = Place(spec)
    benchmarks = {}
    for plan in spec.benchmarks:
        middle = spec.first_station + spec.axis_reach + 0.5 * (spec.cycles - 1) * spec.step_m
        position = place.point(middle + plan.station, plan.offset, spec.ground + plan.height)
        normal = place.direction(-90.0 * spec.side + plan.turn_deg)
        normal = normal + np.array([0, 0, np.tan(np.deg2rad(plan.lean_deg))])
        askew = so3.exp(np.array([0.0, 0.0, np.deg2rad(plan.roll_deg)]))
        T = _pose(facing(normal, np.array([0.0, 0, 1])) @ askew, position)
        benchmarks[plan.board.name] = uneven(T, 0.01, 0.7)
    turn, tilt = np.deg2rad(spec.stick_marker_turn_deg), np.deg2rad(spec.stick_marker_tilt_deg)
    normal = np.array([-np.sin(tilt), -np.cos(tilt), 0.0]) * np.cos(turn) - np.array([0, 0, np.sin(turn)])
    up = np.array([-np.cos(tilt), np.sin(tilt), 0.0])
    stick_marker = uneven(_pose(facing(normal, up), spec.stick_marker), 0.003, 0.4)
    arm = spec.arm
    axis = uneven(_pose(np.eye(3), (arm.stick_m, 0.0, 0.0)), 0.0005, 0.02)
    link = np.array(arm.linkage) + np.append(rng.normal(0, 0.001, 7), 0.0)
    link[7] = np.deg2rad(link[7])
    return Mounts(
        cameras=cameras,
        intrinsics=intrinsics,
        benchmarks=benchmarks,
        stick_marker=stick_marker,
        axis=axis,
        tool=_pose(tool_rotation(arm), (arm.bucket_m, 0.0, 0.0)),
        linkage=link,
        curves={s.name: true_curve(s.kind) for s in spec.sensors},
        time_offsets={s.name: s.time_offset_s for s in spec.sensors},
    )


def true_curve(kind: str) -> np.ndarray:
    """Coefficients from raw reading to cylinder length (m) or joint angle (deg), of each kind of sensor."""
    if kind == "potentiometer":
        return np.array([0.7874, 0.1846, 0.0004])
    if kind == "encoder":
        return np.array([-2.35, np.rad2deg(1.0)])
    assert kind == "card", kind
    return np.array([-171.3, 360.0 / 8192.0])


def tool_rotation(arm: Arm) -> np.ndarray:
    """``R_bucket_tool``: x along the edge to the operator's right, z along the teeth outward."""
    teeth = np.deg2rad(arm.teeth_deg)
    z = np.array([np.cos(teeth), np.sin(teeth), 0.0])
    x = np.array([0.0, 0.0, 1.0])
    return np.stack([x, np.cross(z, x), z], axis=-1)


def raw_reading(kind: str, angle_rad: np.ndarray, mounts: Mounts, side: int, name: str) -> np.ndarray:
    """Noiseless reading of a sensor at angles of the bucket joint, raw unit."""
    c = mounts.curves[name]
    if kind == "potentiometer":
        y = linkage.cylinder_length(angle_rad, np.append(mounts.linkage, 0.0), side)
        assert np.isfinite(y).all(), "the bucket is outside the stroke of its linkage"
    else:
        y = np.rad2deg(angle_rad)
    if len(c) == 2:
        return (y - c[0]) / c[1]
    return (-c[1] + np.sqrt(c[1] ** 2 - 4 * c[2] * (c[0] - y))) / (2 * c[2])


class Place:
    """The alignment in the plan: stations and offsets to world points."""

    def __init__(self, spec: Specification):
        self.start_station = spec.start_station
        self.start = np.array(spec.start)
        bearing = np.deg2rad(spec.bearing_deg)
        self.bearing_rad = bearing
        self.u = np.array([np.cos(bearing), np.sin(bearing)])
        self.left = np.array([-self.u[1], self.u[0]])

    def point(
        self, station: np.ndarray | float, offset: np.ndarray | float, z: np.ndarray | float
    ) -> np.ndarray:
        """World point (..., 3) at a station (m), an offset (m, left positive) and a height."""
        station, offset, z = np.broadcast_arrays(*(np.asarray(v, float) for v in (station, offset, z)))
        en = self.start + (station - self.start_station)[..., None] * self.u + offset[..., None] * self.left
        return np.concatenate([en, z[..., None]], axis=-1)

    def station_offset(self, p_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Station and offset (...,) of world points (..., 2 or 3), metres."""
        d = np.asarray(p_world)[..., :2] - self.start
        return d @ self.u + self.start_station, d @ self.left

    def direction(self, angle_deg: float) -> np.ndarray:
        """Horizontal unit vector at an angle, counter-clockwise from the alignment's direction."""
        a = self.bearing_rad + np.deg2rad(angle_deg)
        return np.array([np.cos(a), np.sin(a), 0.0])


def _pose(R: np.ndarray, t: object) -> np.ndarray:
    return se3.from_rotation_translation(R, np.asarray(t, float))


__all__ = [
    "Board",
    "CameraPlan",
    "Mounts",
    "Place",
    "board",
    "joint_directions",
    "raw_reading",
    "true_mounts",
]
