"""The four-bar linkage between a bucket's cylinder and the bucket, in the plane of the stick.

    A  anchor of the cylinder on the stick            cylinder  A-E, the length that is measured
    P  pivot of the rocker on the stick               rocker    P-E
    O  pin of the bucket on the stick, the origin     coupler   E-H, the H-link
    E  where cylinder, rocker and coupler meet        horn      O-H, fixed to the bucket
    H  where the coupler holds the bucket

The plane's x and y are those of the stick's frame as the caller lays it out, seen so that the bucket's
angle is counter-clockwise about O. The bucket's own x axis is the direction at angle 0; ``horn_angle`` is
that of O-H against it. Two circles meet twice, so the sizes alone allow eight assemblies. Excavators are
built in one of two: rocker, coupler, horn and stick form a quadrilateral P E H O that is convex at E and at
H, with the cylinder on the outside of the rocker; ``side = +1`` if P E H O runs clockwise, ``-1`` for its
mirror image. A longer cylinder turns the bucket clockwise for ``+1``, counter-clockwise for ``-1``. Leaving
that shape means passing a dead centre, where the angle is no longer a function of the length: nan comes
back there, and beyond the reach of the bars.
"""

from itertools import pairwise

import numpy as np

PARAMETERS = (
    "anchor_x",  # m, A in the stick's plane
    "anchor_y",
    "pivot_x",  # m, P in the stick's plane
    "pivot_y",
    "rocker",  # m, P-E
    "coupler",  # m, E-H
    "horn",  # m, O-H
    "horn_angle",  # rad, direction of O-H in the bucket's frame
    "cylinder_zero",  # m, added to the sensor's length to give A-E
)


def bucket_angle(length_m, params, side=1):
    """Angle of the bucket about its pin, from the length of the cylinder.

    Parameters
    ----------
    length_m : (...,) array
        Sensor's length; ``cylinder_zero`` is added to it.
    params : (..., 9) array
        In the order of ``PARAMETERS``; leading axes broadcast against those of the length.
    side : {1, -1}
        Which way round the linkage is built.

    Returns
    -------
    (...,) array
        Radians in (-pi, pi]; nan outside the stroke.
    """
    return _solve_forward(length_m, params, side)[0]


def bucket_angle_with_jacobians(length_m, params, side=1):
    """Angle of the bucket, and how it moves with the length and with the parameters.

    From the two closures ``|E - A| = length`` and ``|H - E| = coupler``, differentiated as they stand: the
    chain of arc cosines would say the same in three times the lines.

    Parameters
    ----------
    length_m : (...,) array
        Sensor's length.
    params : (..., 9) array
        In the order of ``PARAMETERS``.
    side : {1, -1}
        Which way round the linkage is built.

    Returns
    -------
    angle_rad : (...,) array
        Radians; nan outside the stroke.
    J_angle_length : (...,) array
        rad/m.
    J_angle_params : (..., 9) array
        Radians per metre or per radian.
    """
    angle_rad, A, E, H, P = _solve_forward(length_m, params, side)
    params = np.asarray(params, dtype=np.float64)
    cylinder, coupler = E - A, H - E
    length = _norm(cylinder)
    rocker_m, coupler_m, horn_m = params[..., 4], params[..., 5], params[..., 6]
    along_rocker = (E - P) / rocker_m[..., None]
    along_horn = H / horn_m[..., None]
    # d|E-A|: cylinder . (dE - dA) = length dlength, with dE = dP + along_rocker drocker + left(E - P) dpsi.
    dE_psi = _left(E - P)
    psi_by = 1 / _dot(cylinder, dE_psi)
    dpsi = np.zeros(angle_rad.shape + (9,))
    dpsi[..., 0:2] = psi_by[..., None] * cylinder
    dpsi[..., 2:4] = -dpsi[..., 0:2]
    dpsi[..., 4] = -psi_by * _dot(cylinder, along_rocker)
    dpsi[..., 8] = psi_by * length
    dE = dE_psi[..., :, None] * dpsi[..., None, :]
    dE[..., 0, 2] += 1.0
    dE[..., 1, 3] += 1.0
    dE[..., :, 4] += along_rocker
    # d|H-E|: coupler . (dH - dE) = coupler_m dcoupler, with dH = along_horn dhorn + left(H) deta.
    eta_by = 1 / _dot(coupler, _left(H))
    deta = eta_by[..., None] * np.einsum("...i,...ij->...j", coupler, dE)
    deta[..., 5] += eta_by * coupler_m
    deta[..., 6] -= eta_by * _dot(coupler, along_horn)
    deta[..., 7] = np.where(np.isnan(angle_rad), np.nan, -1.0)  # angle = eta - horn_angle
    return angle_rad, deta[..., 8].copy(), deta


def cylinder_length(angle_rad, params, side=1):
    """Length of the cylinder that brings the bucket to an angle: the inverse of ``bucket_angle``.

    Parameters
    ----------
    angle_rad : (...,) array
        Of the bucket about its pin; whole turns do not matter.
    params : (..., 9) array
        In the order of ``PARAMETERS``.
    side : {1, -1}
        Which way round the linkage is built.

    Returns
    -------
    (...,) array
        Sensor's length in metres; nan where the bucket cannot be.
    """
    params = np.asarray(params, dtype=np.float64)
    A, P = params[..., 0:2], params[..., 2:4]
    rocker_m, coupler_m, horn_m, horn_angle, zero_m = (params[..., i] for i in range(4, 9))
    H = horn_m[..., None] * _direction(np.asarray(angle_rad, dtype=np.float64) + horn_angle)
    PH = H - P
    opening = _angle_between_sides(rocker_m, _norm(PH), coupler_m)
    E = P + rocker_m[..., None] * _direction(np.arctan2(PH[..., 1], PH[..., 0]) + side * opening)
    built = _as_built(A, P, E, H, side)
    return np.where(built, _norm(E - A) - zero_m, np.nan)


def stroke(params, side=1):
    """Lengths between which the bucket's angle is a monotone function of the length.

    It ends where two bars stretch into a line (cylinder and rocker, rocker and coupler, or coupler and horn)
    or fold onto each other; what the hydraulics allow is, on a real machine, well inside.

    Parameters
    ----------
    params : (9,) array
        In the order of ``PARAMETERS``.
    side : {1, -1}
        Which way round the linkage is built.

    Returns
    -------
    low_m, high_m : float
        Sensor's lengths, the widest such interval; nan, nan if the bars cannot be assembled.
    """
    params = np.asarray(params, dtype=np.float64)
    assert params.shape == (9,), params.shape
    A, P, O = params[0:2], params[2:4], np.zeros(2)
    rocker_m, coupler_m, horn_m, zero_m = params[4], params[5], params[6], params[8]
    ends = [np.hypot(*(A - P)) + rocker_m, abs(np.hypot(*(A - P)) - rocker_m)]
    for reach in (horn_m + coupler_m, abs(horn_m - coupler_m)):  # coupler and horn in line: |E| = reach
        ends += [np.hypot(*(E - A)) for E in _meet(P, rocker_m, O, reach)]
    for reach in (rocker_m + coupler_m, rocker_m - coupler_m):  # those two in line: |H - P| = |reach|
        for H in _meet(P, abs(reach), O, horn_m):
            E = P + rocker_m * (H - P) / reach
            ends.append(np.hypot(*(E - A)))
    ends = np.unique(np.array(ends)[np.isfinite(ends)]) - zero_m
    best, run = (np.nan, np.nan), None
    for low, high in pairwise(ends):
        # An end may belong to another assembly: then both neighbours are good and the run goes on.
        if np.isfinite(bucket_angle(0.5 * (low + high), params, side)):
            run = (run[0] if run else low, high)
            if not run[1] - run[0] <= best[1] - best[0]:
                best = run
        else:
            run = None
    return float(best[0]), float(best[1])


def _solve_forward(length_m, params, side):
    assert side in (1, -1), side
    params = np.asarray(params, dtype=np.float64)
    A, P = params[..., 0:2], params[..., 2:4]
    rocker_m, coupler_m, horn_m, horn_angle, zero_m = (params[..., i] for i in range(4, 9))
    length = np.asarray(length_m, dtype=np.float64) + zero_m
    PA = A - P
    at_pivot = _angle_between_sides(rocker_m, _norm(PA), length)
    E = P + rocker_m[..., None] * _direction(np.arctan2(PA[..., 1], PA[..., 0]) - side * at_pivot)
    at_pin = _angle_between_sides(horn_m, _norm(E), coupler_m)
    eta = np.arctan2(E[..., 1], E[..., 0]) - side * at_pin
    H = horn_m[..., None] * _direction(eta)
    built = _as_built(A, P, E, H, side) & (length > 0)
    angle_rad = np.pi - np.mod(np.pi - (eta - horn_angle), 2 * np.pi)
    return np.where(built, angle_rad, np.nan), A, np.where(built[..., None], E, np.nan), H, P


def _as_built(A, P, E, H, side):
    """Whether the pins lie as on a machine: cylinder outside the rocker, P E H O folded neither at E nor H."""
    return (side * _cross(A - P, E - P) < 0) & (side * _cross(E, H) < 0) & (side * _cross(H - P, E - P) > 0)


def _angle_between_sides(a, b, opposite):
    """Angle in a triangle between sides ``a`` and ``b``, by the law of cosines; nan if it cannot close."""
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (a * a + b * b - opposite * opposite) / (2 * a * b)
        return np.arccos(np.where(np.abs(cosine) <= 1, cosine, np.nan))


def _meet(centre_1, radius_1, centre_2, radius_2):
    """The points, none or two, where two circles meet."""
    across = centre_2 - centre_1
    opening = _angle_between_sides(radius_1, np.hypot(*across), radius_2)
    if not np.isfinite(opening):
        return []
    return [centre_1 + radius_1 * _direction(np.arctan2(*across[::-1]) + sign * opening) for sign in (1, -1)]


def _direction(angle):
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _left(v):
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)


def _dot(a, b):
    return np.einsum("...i,...i->...", a, b)


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _norm(v):
    return np.hypot(v[..., 0], v[..., 1])
