"""One camera and one marker, as section 3.3.2 of the paper has them; then two cameras, and several tags.

Eq. (3) with nothing else uncertain: ``P = sigma_u² (J'J)^-1`` for the pose of the marker in the camera. A second camera
that is rigidly beside the first adds its own ``J'J``, carried into the same six unknowns.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import camera as camera_model
from pipeline.geometry import se3, so3

SIGMA_U_PX = 0.2
"""The paper's Fig. 11."""


def square(side_m: float):
    """Corners of one tag in its marker frame, (4, 3) metres."""
    return 0.5 * side_m * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def board(side_m: float, pitch_m: float, rows: int, columns: int):
    """Corners of a board of tags in its marker frame, (4 rows columns, 3) metres."""
    x = (np.arange(columns) - 0.5 * (columns - 1)) * pitch_m
    y = (np.arange(rows) - 0.5 * (rows - 1)) * pitch_m
    places = np.array([[a, b, 0.0] for b in y for a in x])
    return (places[:, None] + square(side_m)).reshape(-1, 3)


def pinhole(focal_px: float, width: int = 1280, height: int = 960):
    """Intrinsics (9,) without distortion, the principal point in the middle."""
    return np.array([focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0.0])


def facing(distance_m, tilt_deg=30.0, about_deg=0.0, ray=(0.0, 0.0, 1.0)):
    """``T_camera_marker`` of a marker on a ray, turned to the camera and then tilted about an axis in its plane.

    Parameters
    ----------
    distance_m, tilt_deg, about_deg : (...,) arrays
        From the camera; between its normal and the optical axis; direction of the axis in the print.
    ray : (..., 3) array
        Towards the marker.

    Returns
    -------
    (..., 4, 4) array
    """
    distance, tilt, about = np.broadcast_arrays(
        *(np.asarray(a, float) for a in (distance_m, tilt_deg, about_deg))
    )
    ray = np.asarray(ray, float) / np.linalg.norm(ray, axis=-1, keepdims=True)
    about = np.deg2rad(about)
    axis = np.stack([np.cos(about), np.sin(about), np.zeros_like(about)], axis=-1)
    R = so3.exp(np.pi * np.array([1.0, 0, 0])) @ so3.exp(np.deg2rad(tilt)[..., None] * axis)
    return se3.from_rotation_translation(R, distance[..., None] * ray)


def pose_covariance(T_camera_marker, p_marker, intrinsics, sigma_px=SIGMA_U_PX, T_camera_others=()):
    """Covariance of the marker's pose in the camera, eq. (3).

    Parameters
    ----------
    T_camera_marker : (..., 4, 4) array
        In the first camera.
    p_marker : (k, 3) array
        Corners in the marker frame, metres.
    intrinsics : (9,) array
        Of every camera.
    sigma_px : float
        Of each coordinate of a corner.
    T_camera_others : sequence of (4, 4) arrays
        Where further cameras are in the first one.

    Returns
    -------
    (..., 6, 6) array
        Of ``xi = [rho, phi]``, the right perturbation; m² and rad². nan where a corner has no pixel.
    """
    information = 0.0
    for T_camera_other in (np.eye(4), *T_camera_others):
        T = se3.inverse(np.asarray(T_camera_other, float)) @ T_camera_marker
        p = np.einsum("...ij,kj->...ki", T[..., :3, :3], p_marker) + T[..., None, :3, 3]
        _, J_uv_p, _ = camera_model.project_with_jacobians(p, intrinsics)
        R = T[..., None, :3, :3]
        J_p_xi = np.concatenate(np.broadcast_arrays(R, R @ -so3.hat(p_marker)), axis=-1)
        J = J_uv_p @ J_p_xi
        information = information + np.einsum("...kai,...kaj->...ij", J, J) / sigma_px**2
    return np.linalg.inv(information)


def position_sigmas(T_camera_marker, p_marker, intrinsics, sigma_px=SIGMA_U_PX, T_camera_others=()):
    """Standard deviations of the marker's origin along its principal axes, and the direction of the largest.

    Returns
    -------
    sigmas : (..., 3) array
        m, smallest first.
    direction : (..., 3) array
        In the first camera.
    """
    cov = pose_covariance(T_camera_marker, p_marker, intrinsics, sigma_px, T_camera_others)[..., :3, :3]
    R = np.asarray(T_camera_marker)[..., :3, :3]
    values, vectors = np.linalg.eigh(R @ cov @ np.swapaxes(R, -1, -2))
    return np.sqrt(values), vectors[..., 2]


def off_the_ray_deg(T_camera_marker, direction):
    """Angle between a direction and the line of sight to the marker, (...,) degrees: what Fig. 7 shows to be small."""
    t = np.asarray(T_camera_marker)[..., :3, 3]
    cosine = np.abs(np.sum(t * direction, axis=-1)) / np.linalg.norm(t, axis=-1)
    return np.rad2deg(np.arccos(np.minimum(cosine, 1.0)))


def power(x, y) -> float:
    """Exponent of ``y ~ x^power``, by least squares of the logarithms."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


DISTANCES_M = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0)


def by_distance(p_marker, intrinsics, sigma_of, distances_m=DISTANCES_M, tilt_deg=30.0, factor=1.0):
    """Figs. 7 to 9 for a camera and a marker of one's own: sigmas of the marker's origin over its distance.

    Parameters
    ----------
    p_marker : (m, 4, 3) array
        Tags of the marker, metres.
    intrinsics : (9,) array
        Of the camera.
    sigma_of : callable
        Sigma of a corner, px, from the side of its tag, px.
    distances_m : sequence of float
        On the optical axis.
    tilt_deg : float
        Of the marker away from the camera.
    factor : float
        Of the focal length: another lens.

    Returns
    -------
    sigmas : (k, 3) array
        m, smallest first.
    side_px : (k,) array
        Of the largest tag.
    off_deg : (k,) array
        Between the largest error and the line of sight.
    """
    lens = np.array(intrinsics, float)
    lens[:2] *= factor
    side = np.linalg.norm(p_marker[:, 1] - p_marker[:, 0], axis=-1).max()
    sigmas, sides, off = [], [], []
    for z in distances_m:
        T = facing(z, tilt_deg)
        pixels = float(lens[0] * side / z * np.sqrt(np.cos(np.deg2rad(tilt_deg))))
        found, direction = position_sigmas(T, p_marker.reshape(-1, 3), lens, float(sigma_of(pixels)))
        sigmas.append(found)
        sides.append(pixels)
        off.append(float(off_the_ray_deg(T, direction)))
    return np.array(sigmas), np.array(sides), np.array(off)
