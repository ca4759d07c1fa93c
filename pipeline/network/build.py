"""From machine.toml and site.toml to a network: which body carries what, and the statics with their priors."""

from __future__ import annotations

import datetime

import numpy as np

from pipeline.config import Machine, Site
from pipeline.config.benchmark import Benchmark
from pipeline.config.machine import JointBody, Motion, StaticBody
from pipeline.config.prints import described_tags
from pipeline.config.quantities import Pose, Print
from pipeline.errors import NetworkError
from pipeline.geometry import camera as camera_model
from pipeline.geometry import linkage, se3, so3
from pipeline.network.model import (
    POSE_COMPONENTS,
    POSE_UNITS,
    Body,
    Camera,
    Marker,
    Network,
    Sensor,
    Static,
)

JOINT_MOTION = Motion(translation=1e-9, rotation=1.0)
"""A bucket goes from rest to 60 deg/s in less than a second, which is ten times what a whole body does."""
UNKNOWN_SIGMA = np.array([1000.0] * 3 + [3.0] * 3)
"""Prior of a pose that no file gives, about the start that the log gives: m and rad."""


def network_of(machine: Machine, site: Site, date: datetime.date | None = None) -> Network:
    """The network that the two files describe.

    Parameters
    ----------
    machine, site : Machine, Site
        Every camera has its intrinsics (those taken from the log are filled in before).
    date : datetime.date, optional
        Day of the log, which decides how worn the teeth are; without it the latest entry counts.

    Returns
    -------
    Network

    Raises
    ------
    NetworkError
        A camera has no intrinsics, or the surveyed corners of a benchmark lie on a line.
    """
    statics: list[Static] = []

    def add(static: Static) -> int:
        statics.append(static)
        return len(statics) - 1

    def add_pose(name: str, source: str, pose: Pose | None) -> int:
        if pose is None:
            return add(_unknown_pose(name, source))
        return add(_pose_static(name, source, pose.transform(), pose.covariance_xi()))

    bodies = {"world": Body("world", "world")}
    for name, body in machine.bodies.items():
        is_joint = isinstance(body, JointBody)
        motion = machine.motion.get(name, JOINT_MOTION if is_joint else Motion())
        densities = (motion.translation, motion.rotation)
        if isinstance(body, JointBody):
            axis = add_pose(f"joint {name} axis", "linkage and sensor", body.axis)
            driver, ratio = (None, 1.0) if body.follows is None else (body.follows.joint, body.follows.ratio)
            bodies[name] = Body(name, "joint", body.parent, axis, densities, driver, ratio)
        elif isinstance(body, StaticBody):
            bodies[name] = Body(name, "static", None, add_pose(f"body {name} pose", "mounts", body.pose))
        else:
            bodies[name] = Body(name, "moving", motion=densities)

    cameras = []
    for name, camera in machine.cameras.items():
        if camera.intrinsics is None:
            raise NetworkError(
                f"camera '{name}' has no intrinsics: give [cameras.{name}.intrinsics] in machine.toml, "
                f"or calibration_topic and intrinsics_sigma if the log carries them"
            )
        mount = add_pose(f"camera {name} mount", "mounts", camera.mount)
        intrinsics = Static(
            f"camera {name} intrinsics",
            "intrinsics",
            False,
            camera.intrinsics.vector(),
            camera.intrinsics.covariance_matrix(),
            camera_model.INTRINSICS,
            ("px",) * 4 + ("",) * 5,
        )
        size = camera.intrinsics.width, camera.intrinsics.height
        cameras.append(Camera(name, camera.body, mount, add(intrinsics), *size))

    markers: list[Marker] = []
    prints: list[Print] = []
    for name, marker in machine.markers.items():
        markers.append(
            Marker(name, marker.body, add_pose(f"marker {name} mount", "mounts", marker.mount), False)
        )
        prints.append(marker)
    for name, mark in site.benchmarks.items():
        if name in machine.markers:
            raise NetworkError(
                f"'{name}' is both a marker of the machine and a benchmark of the site; rename one"
            )
        pose = site.benchmark_pose(name)
        static_name = f"benchmark {name} pose"
        if mark.corners:
            index = add(_pose_static(static_name, "benchmarks", *_fit_corners(name, mark, site)))
        else:
            index = add_pose(static_name, "benchmarks", pose)
        markers.append(Marker(name, "world", index, True))
        prints.append(mark)
    tags = [(k, item.family, tag) for k, item in enumerate(prints) for tag in item.tags]
    described_tags(machine, site)

    sensors = []
    for name, sensor in machine.sensors.items():
        c = sensor.curve
        names = tuple(f"c{i}" for i in range(len(c.coefficients)))
        unit = "m" if c.output == "cylinder_m" else "deg"
        curve = Static(
            f"sensor {name} curve",
            "linkage and sensor",
            False,
            np.array(c.coefficients),
            c.covariance_matrix(),
            names,
            tuple(f"{unit}/raw^{i}" if i else unit for i in range(len(names))),
        )
        drifts = sensor.clock_drift_ppm != 0 or sensor.sigma_clock_drift_ppm > 0
        offset = Static(
            f"sensor {name} time offset",
            "time offset",
            False,
            np.array([sensor.time_offset_s, sensor.clock_drift_ppm][: 1 + drifts]),
            np.diag([sensor.sigma_time_offset_s**2, sensor.sigma_clock_drift_ppm**2][: 1 + drifts]),
            ("offset", "drift")[: 1 + drifts],
            ("s", "ppm")[: 1 + drifts],
        )
        bars = None if sensor.linkage is None else add(_linkage_static(name, sensor.linkage))
        side = 1 if sensor.linkage is None else sensor.linkage.branch
        sensors.append(
            Sensor(
                name,
                sensor.joint,
                c.output,
                add(curve),
                bars,
                add(offset),
                side,
                sensor.noise,
                c.raw_range,
            )
        )

    tool = add(_worn_tool(machine, date))
    return Network(
        bodies=bodies,
        cameras=tuple(cameras),
        markers=tuple(markers),
        tag_marker=np.array([k for k, _, _ in tags], dtype=np.int64),
        tag_family=tuple(family for _, family, _ in tags),
        tag_id=np.array([tag.id for _, _, tag in tags], dtype=np.int64),
        tag_corners=np.array([tag.corners() for _, _, tag in tags]).reshape(-1, 4, 3),
        sensors=tuple(sensors),
        statics=tuple(statics),
        tool_body=machine.cutting_edge.body,
        tool=tool,
        edge_m=machine.cutting_edge.width_m,
    )


def rigid_fit(p_marker, p_world, sigma_m):
    """Pose that carries points of a marker onto their surveyed places, with its covariance.

    The least-squares rotation by the singular values of the cross-covariance (Kabsch), which is the optimum for
    equal, independent noise; the covariance is eq. (3) of the paper with total-station shots as measurements.

    Parameters
    ----------
    p_marker, p_world : (n, 3) array
        Metres; not all on one line.
    sigma_m : float
        Standard deviation of each coordinate of ``p_world``.

    Returns
    -------
    T_world_marker : (4, 4) array
    cov_xi : (6, 6) array
        Singular information (points on a line) raises numpy.linalg.LinAlgError.
    """
    p_marker, p_world = np.asarray(p_marker, dtype=np.float64), np.asarray(p_world, dtype=np.float64)
    a, b = p_marker - p_marker.mean(0), p_world - p_world.mean(0)
    U, s, Vt = np.linalg.svd(b.T @ a)
    if s[1] < 1e-9 * max(s[0], 1e-12):
        raise np.linalg.LinAlgError("points on a line")
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    T = se3.from_rotation_translation(R, p_world.mean(0) - R @ p_marker.mean(0))
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(a), 3, 3)), -so3.hat(p_marker)], axis=-1)
    return T, np.linalg.inv(np.einsum("nki,nkj->ij", J, J)) * sigma_m**2


def _pose_static(name, source, T, covariance) -> Static:
    return Static(name, source, True, T, covariance, POSE_COMPONENTS, POSE_UNITS)


def _unknown_pose(name: str, source: str) -> Static:
    cov = np.diag(UNKNOWN_SIGMA**2)
    return Static(name, source, True, np.eye(4), cov, POSE_COMPONENTS, POSE_UNITS, False)


def _fit_corners(name: str, mark: Benchmark, site: Site):
    corners = {tag.id: tag.corners() for tag in mark.tags}
    p_marker = np.array([corners[shot.tag][shot.corner] for shot in mark.corners])
    p_world = site.grid.to_world(np.array([shot.enh for shot in mark.corners]))
    assert mark.sigma_corner_mm is not None
    try:
        T, cov = rigid_fit(p_marker, p_world, mark.sigma_corner_mm / 1000.0)
    except np.linalg.LinAlgError:
        raise NetworkError(
            f"the surveyed corners of benchmark '{name}' lie on one line, which leaves it free to turn about "
            f"that line; survey a corner off the line"
        ) from None
    misfit = np.abs(se3.transform(T, p_marker) - p_world).max() * 1000
    if misfit > max(10 * mark.sigma_corner_mm, 20.0):
        raise NetworkError(
            f"the surveyed corners of benchmark '{name}' do not fit its print: {misfit:.0f} mm off "
            f"(sigma_corner_mm {mark.sigma_corner_mm:g}); check size_m, the corner numbers and the grid unit"
        )
    return T, cov


def _linkage_static(name: str, bars) -> Static:
    values = [
        *bars.cylinder_anchor_m,
        *bars.rocker_pivot_m,
        bars.rocker_m,
        bars.coupler_m,
        bars.horn_m,
        np.deg2rad(bars.horn_angle_deg),
        0.0,  # the curve's own offset does this one's work
    ]
    sigma = [bars.sigma_mm / 1000.0] * 7 + [np.deg2rad(bars.sigma_horn_angle_deg), 0.0]
    units = ("m",) * 7 + ("rad", "m")
    return Static(
        f"sensor {name} linkage",
        "linkage and sensor",
        False,
        np.array(values),
        np.diag(np.square(sigma)),
        linkage.PARAMETERS,
        units,
    )


def _worn_tool(machine: Machine, date: datetime.date | None) -> Static:
    edge = machine.cutting_edge
    entries = sorted((w for w in edge.wear if date is None or w.date <= date), key=lambda w: w.date)
    wear_m, sigma_m = (entries[-1].wear_mm / 1000, entries[-1].sigma_mm / 1000) if entries else (0.0, 0.0)
    T_mount_tool = se3.from_rotation_translation(np.eye(3), np.array([0.0, 0.0, -wear_m]))
    A = se3.Ad(se3.inverse(T_mount_tool))
    cov = A @ edge.mount.covariance_xi() @ A.T
    cov[2, 2] += sigma_m**2
    return _pose_static("cutting edge mount", "cutting edge", edge.mount.transform() @ T_mount_tool, cov)
