"""The pinhole camera with Brown's distortion, there and back, with Jacobians.

Points are in the camera frame (x right, y down, z forward, metres). Pixels are ``uv`` with the centre of
the top-left pixel at (0, 0). The intrinsics are one array ``(..., 9)`` in the order of ``INTRINSICS``,
OpenCV's model and OpenCV's order, so that a calibration can be handed over without being touched:

    x = X / Z, y = Y / Z, r² = x² + y², radial = 1 + k1 r² + k2 r⁴ + k3 r⁶
    x_d = x radial + 2 p1 x y + p2 (r² + 2 x²)
    y_d = y radial + p1 (r² + 2 y²) + 2 p2 x y
    u = fx x_d + cx, v = fy y_d + cy

What cannot be seen has no pixel: a point behind the camera projects to nan, and so does a pixel that no ray
reaches. A number there would be a mirrored one, and a solver would believe it.
"""

import numpy as np

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")  # px, px, px, px, then without unit
NEAREST_M = 1e-6  # a point closer than this to the plane of the lens counts as behind it

_NEWTON_STEPS = 60
_HALVINGS = 16
_NEWTON_TOLERANCE = 1e-14
_NEVER_FOLDS_ABOVE = 1e3  # normalised radius, 89.94 degrees off the axis


def in_front(p_camera):
    """Whether points lie in front of the camera, so that they have a pixel at all.

    Parameters
    ----------
    p_camera : (..., 3) array
        Metres.

    Returns
    -------
    (...,) bool array
    """
    return np.asarray(p_camera, dtype=np.float64)[..., 2] > NEAREST_M


def project(p_camera, intrinsics):
    """Pixels of points in the camera frame; nan where ``in_front`` is false.

    Parameters
    ----------
    p_camera : (..., 3) array
        Metres.
    intrinsics : (..., 9) array
        In the order of ``INTRINSICS``; leading axes broadcast against those of the points.

    Returns
    -------
    (..., 2) array
        ``uv`` in pixels.
    """
    p_camera = np.asarray(p_camera, dtype=np.float64)
    z = np.where(in_front(p_camera), p_camera[..., 2], np.nan)
    xy_distorted, _ = _distort(p_camera[..., :2] / z[..., None], intrinsics, jacobian=False)
    return to_pixels(xy_distorted, intrinsics)


def project_with_jacobians(p_camera, intrinsics):
    """Pixels of points, and how they move with the point and with the intrinsics.

    Parameters
    ----------
    p_camera : (..., 3) array
        Metres.
    intrinsics : (..., 9) array
        In the order of ``INTRINSICS``.

    Returns
    -------
    uv : (..., 2) array
        Pixels.
    J_uv_p : (..., 2, 3) array
        Pixels per metre of the point in the camera frame.
    J_uv_intrinsics : (..., 2, 9) array
        Pixels per unit of each intrinsic.
    """
    p_camera = np.asarray(p_camera, dtype=np.float64)
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    z = np.where(in_front(p_camera), p_camera[..., 2], np.nan)
    xy = p_camera[..., :2] / z[..., None]
    xy_distorted, J_distorted_xy = _distort(xy, intrinsics, jacobian=True)
    f = intrinsics[..., :2]
    J_uv_xy = f[..., :, None] * J_distorted_xy
    J_uv_p = np.empty(J_uv_xy.shape[:-1] + (3,))
    J_uv_p[..., :2] = J_uv_xy / z[..., None, None]
    J_uv_p[..., 2] = -np.einsum("...ij,...j->...i", J_uv_p[..., :2], xy)

    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    J_uv_intrinsics = np.zeros(xy_distorted.shape + (9,))
    J_uv_intrinsics[..., 0, 0] = xy_distorted[..., 0]
    J_uv_intrinsics[..., 1, 1] = xy_distorted[..., 1]
    J_uv_intrinsics[..., 0, 2] = 1.0
    J_uv_intrinsics[..., 1, 3] = 1.0
    for column, power in ((4, 1), (5, 2), (8, 3)):
        J_uv_intrinsics[..., :, column] = f * xy * (r2**power)[..., None]
    J_uv_intrinsics[..., 0, 6] = f[..., 0] * 2 * x * y
    J_uv_intrinsics[..., 1, 6] = f[..., 1] * (r2 + 2 * y * y)
    J_uv_intrinsics[..., 0, 7] = f[..., 0] * (r2 + 2 * x * x)
    J_uv_intrinsics[..., 1, 7] = f[..., 1] * 2 * x * y
    return to_pixels(xy_distorted, intrinsics), J_uv_p, J_uv_intrinsics


def undistort(uv, intrinsics):
    """Normalised coordinates ``x/z, y/z`` of pixels: the ray through each, with ``z = 1``.

    Newton steps from the distorted point, never past ``fold_radius`` and halved while they do not help. OpenCV's
    five fixed-point rounds are 0.4 px off at 45 degrees (f = 1000 px, k1 = -0.3).

    Parameters
    ----------
    uv : (..., 2) array
        Pixels.
    intrinsics : (..., 9) array
        In the order of ``INTRINSICS``.

    Returns
    -------
    (..., 2) array
        Good to 1e-12; nan where no ray inside the fold radius leads to the pixel.
    """
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    target = (np.asarray(uv, dtype=np.float64) - intrinsics[..., 2:4]) / intrinsics[..., :2]
    limit = np.broadcast_to(fold_radius(intrinsics), target.shape[:-1])
    # Not from the fold itself, where the slope vanishes and a step leads anywhere: started there, one pixel in
    # ten near the rim of lenses with pincushion was given up. A bracketed solve of the radius first, in three
    # times the lines, saved one in 5,000 more, for lenses that nobody sells.
    xy = _shorten(target, 0.9 * limit)
    residual, J = _residual(xy, target, intrinsics)
    for _ in range(_NEWTON_STEPS):
        step = _solve_2x2(J, residual)
        if np.all(~(np.abs(step) > _NEWTON_TOLERANCE)):
            break
        better = np.zeros(target.shape[:-1], dtype=bool)
        trial, trial_residual, trial_J = xy, residual, J
        for halving in range(_HALVINGS):
            candidate = _shorten(xy - step * 0.5**halving, limit)
            candidate_residual, candidate_J = _residual(candidate, target, intrinsics)
            now = ~better & (_norm(candidate_residual) < _norm(residual))
            trial = np.where(now[..., None], candidate, trial)
            trial_residual = np.where(now[..., None], candidate_residual, trial_residual)
            trial_J = np.where(now[..., None, None], candidate_J, trial_J)
            better |= now
            if np.all(better | ~(_norm(residual) > _NEWTON_TOLERANCE)):
                break
        xy, residual, J = trial, trial_residual, trial_J
        if not np.any(better):
            break
    reached = _norm(residual) < 1e-13 * (1 + _norm(target))
    return np.where(reached[..., None], xy, np.nan)


def fold_radius(intrinsics):
    """Normalised radius ``r = hypot(x, y)`` at which the radial distortion turns back.

    Up to there ``r radial(r)`` grows with ``r``; beyond it the polynomial puts points from far outside the
    picture back into it, so callers refuse rays, and starting values, that lie outside. The tangential
    terms are left out: they are small where a lens is any good.

    Parameters
    ----------
    intrinsics : (..., 9) array
        In the order of ``INTRINSICS``.

    Returns
    -------
    (...,) array
        Without unit (tangent of the angle off the axis); ``inf`` if it never folds.
    """
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    # d/dr (r radial) = 1 + 3 k1 s + 5 k2 s² + 7 k3 s³ with s = r². In 1/s this cubic is monic whatever
    # vanishes, so the eigenvalues of its companion matrix need no cases; its largest root is the fold.
    companion = np.zeros(intrinsics.shape[:-1] + (3, 3))
    companion[..., 0, 0] = -3 * intrinsics[..., 4]
    companion[..., 0, 1] = -5 * intrinsics[..., 5]
    companion[..., 0, 2] = -7 * intrinsics[..., 8]
    companion[..., 1, 0] = companion[..., 2, 1] = 1.0
    roots = np.linalg.eigvals(companion)
    # A double root, where the slope only touches zero, comes out with an imaginary part of sqrt(eps).
    real = np.abs(roots.imag) <= 1e-7 * np.max(np.abs(roots), axis=-1, keepdims=True)
    largest = np.max(np.where(real, roots.real, 0.0), axis=-1)
    folds = largest > _NEVER_FOLDS_ABOVE**-2
    return np.where(folds, 1 / np.sqrt(np.where(folds, largest, 1.0)), np.inf)


def to_pixels(xy_distorted, intrinsics):
    """Pixels of distorted normalised coordinates: the last line of the model, ``uv = f xy + c``; (..., 2)."""
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    return intrinsics[..., :2] * xy_distorted + intrinsics[..., 2:4]


def _distort(xy, intrinsics, jacobian):
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    k1, k2, p1, p2, k3 = (intrinsics[..., i] for i in range(4, 9))
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xy_distorted = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    if not jacobian:
        return xy_distorted, None
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / d x = slope x
    mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
    J = np.empty(xy_distorted.shape + (2,))
    J[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    J[..., 0, 1] = J[..., 1, 0] = mixed
    J[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return xy_distorted, J


def _residual(xy, target, intrinsics):
    xy_distorted, J = _distort(xy, intrinsics, jacobian=True)
    return xy_distorted - target, J


def _solve_2x2(J, b):
    determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
    determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)  # on the fold: a long step, cut off
    x = J[..., 1, 1] * b[..., 0] - J[..., 0, 1] * b[..., 1]
    y = J[..., 0, 0] * b[..., 1] - J[..., 1, 0] * b[..., 0]
    return np.stack([x, y], axis=-1) / determinant[..., None]


def _norm(xy):
    return np.hypot(xy[..., 0], xy[..., 1])


def _shorten(xy, limit):
    """The points pulled radially inside ``limit``."""
    r = _norm(xy)
    outside = r > limit
    scale = np.where(outside, limit, 1.0) / np.where(outside, r, 1.0)
    return xy * scale[..., None]
