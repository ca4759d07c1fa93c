"""The two poses that a planar marker can have in one picture (IPPE), for many pictures at once.

After Collins and Bartoli, Infinitesimal Plane-based Pose Estimation (2014): the homography's first-order behaviour at
the marker's centre fixes the pose up to a flip. Both are kept, because the better reprojection is the wrong one
in up to 0.8 % of views. OpenCV has the same for one picture at a time, at ten times the time a marker.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import homography, se3, so3


def both_poses(p_marker, xy, weight):
    """Both poses of a planar marker from rays to points on it.

    Parameters
    ----------
    p_marker : (n, m, 2) array
        Points in the marker's plane, metres.
    xy : (n, m, 2) array
        Normalised coordinates ``x/z, y/z`` of the rays, free of distortion.
    weight : (n, m) array
        0 for a point that was not seen; at least four others, not three of them on a line.

    Returns
    -------
    T_camera_marker : (n, 2, 4, 4) array
        nan where the points do not fix a homography.
    """
    n = len(xy)
    if n == 0:
        return np.empty((0, 2, 4, 4))
    total = weight.sum(-1)[:, None]
    centre = np.einsum("nm,nmi->ni", weight, p_marker) / total
    q = p_marker - centre[:, None]
    H = homography.from_points(q, xy, weight)
    v = H[:, :2, 2]  # image of the centre
    J = H[:, :2, :2] - v[:, :, None] * H[:, 2:3, :2]
    R = _both_rotations(v, J)
    q3 = np.concatenate([q, np.zeros(q.shape[:-1] + (1,))], axis=-1)
    T = np.empty((n, 2, 4, 4))
    for k in range(2):
        t = _translation(R[:, k], q3, xy, weight)
        T[:, k] = se3.from_rotation_translation(R[:, k], t)
    shift = np.broadcast_to(np.eye(4), (n, 4, 4)).copy()
    shift[:, :2, 3] = -centre
    return T @ shift[:, None]


def _both_rotations(v, J):
    """Rotations whose homography has value ``v`` and slope ``J`` at the centre: (n, 2, 3, 3)."""
    n = len(v)
    tilt = np.hypot(v[:, 0], v[:, 1])
    axis = np.stack([-v[:, 1], v[:, 0], np.zeros(n)], axis=-1) / np.where(tilt > 1e-12, tilt, 1.0)[:, None]
    Rv = so3.exp(axis * np.arctan2(tilt, 1.0)[:, None])  # turns the optical axis onto the ray to the centre
    B = Rv[:, :2, :2] - v[:, :, None] * Rv[:, 2:3, :2]
    A = np.linalg.solve(B, J)
    AA = A @ np.swapaxes(A, -1, -2)
    difference = np.hypot(AA[:, 0, 0] - AA[:, 1, 1], 2 * AA[:, 0, 1])
    gamma = np.sqrt(0.5 * (AA[:, 0, 0] + AA[:, 1, 1] + difference))  # the larger singular value: 1 / depth
    R22 = A / gamma[:, None, None]
    h = np.eye(2) - np.swapaxes(R22, -1, -2) @ R22
    b0 = np.sqrt(np.maximum(h[:, 0, 0], 0))
    b1 = np.sqrt(np.maximum(h[:, 1, 1], 0)) * np.where(h[:, 0, 1] < 0, -1, 1)
    R = np.empty((n, 2, 3, 3))
    for k, sign in enumerate((1, -1)):
        c0 = np.stack([R22[:, 0, 0], R22[:, 1, 0], sign * b0], axis=-1)
        c1 = np.stack([R22[:, 0, 1], R22[:, 1, 1], sign * b1], axis=-1)
        R[:, k] = Rv @ np.stack([c0, c1, np.cross(c0, c1)], axis=-1)
    return _nearest_rotation(R)


def _nearest_rotation(R):
    good = np.isfinite(R).all(axis=(-1, -2))
    U, _, Vt = np.linalg.svd(np.where(good[..., None, None], R, np.eye(3)))
    Vt[..., 2, :] *= np.linalg.det(U @ Vt)[..., None]
    return np.where(good[..., None, None], U @ Vt, np.nan)


def _translation(R, q3, xy, weight):
    """Least-squares origin of the centred points, in the camera, for a given rotation: (n, 3)."""
    y = q3 @ np.swapaxes(R, -1, -2)
    M = np.zeros(xy.shape + (3,))
    M[..., 0, 0] = M[..., 1, 1] = 1.0
    M[..., 2] = -xy
    r = xy * y[..., 2:] - y[..., :2]
    weighed = np.swapaxes((M * weight[..., None, None]).reshape(len(M), -1, 3), -1, -2)
    N = weighed @ M.reshape(len(M), -1, 3)
    b = (weighed @ r.reshape(len(M), -1, 1))[..., 0]
    N = np.where(np.isfinite(N).all(axis=(-1, -2), keepdims=True), N, np.eye(3))
    return np.linalg.solve(N, b[..., None])[..., 0]
