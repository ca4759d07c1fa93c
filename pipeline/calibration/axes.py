"""The axis of a joint from the motion of what turns about it: circles in planes.

A marker on the child, seen from a marker on the parent, moves on circles about one line: its turns have one direction
in common, and every point of it keeps its distance from the line and its plane across it. That is what

    T_parent_marker(i) = T_parent_axis Rz(angle_i) T_axis_marker

says of rigid poses, all at once. The pictures tell four of the axis's six components: where it pierces the plane of the
circles, and its direction. Where along the line the axis frame lies is told only where the marker's place on the
child is known, and where the angle is zero by nothing: both stay as the file has them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import CalibrationError
from pipeline.geometry import se3, so3

LEAST_TURN_DEG = 20.0
"""A joint that turned by less leaves its axis far off along the bisector: sigma falls with the turn squared."""
LEAST_POSES = 4
MOST_POSES = 120
STEPS, SETTLED = 30, 1e-10
TOLD = (0, 1, 3, 4)
"""Components of the axis's ``xi`` that motion tells: x, y and the turns about them."""


@dataclass(frozen=True, eq=False)
class Axis:
    """A joint's axis as motion tells it."""

    T_parent_axis: np.ndarray
    """(4, 4); its z is the line, its origin lies on the line where the file's is nearest, its x as near the file's as
    can be."""
    covariance: np.ndarray
    """(4, 4) of x, y, rx, ry of its ``xi``: m and rad."""
    T_axis_marker: np.ndarray
    """(4, 4) of the marker where the angle is zero."""
    angle_rad: np.ndarray
    """(n,) of each pose."""
    residual: np.ndarray
    """(n, 6) of each pose in its marker's axes, m and rad."""
    chi_square: float
    redundancy: int

    @property
    def turn_rad(self) -> float:
        """From the first to the last place of the joint."""
        return float(np.ptp(self.angle_rad))

    @property
    def circle_m(self) -> float:
        """Root mean square of what the marker's centre is off its circle, in its plane."""
        return float(np.sqrt(np.mean(np.sum(self._about_axis()[:, :2] ** 2, axis=1))))

    @property
    def plane_m(self) -> float:
        """The same across its plane."""
        return float(np.sqrt(np.mean(self._about_axis()[:, 2] ** 2)))

    def _about_axis(self) -> np.ndarray:
        return self.residual[:, :3] @ self.T_axis_marker[:3, :3].T


def axis_of_motion(T_parent_marker, covariance, T_parent_axis_file, joint: str) -> Axis:
    """The axis about which a marker turned, by Gauss-Newton steps from a closed form.

    Parameters
    ----------
    T_parent_marker : (n, 4, 4) array
        Poses of the marker on the child, in the parent.
    covariance : (n, 6, 6) array
        Of their ``xi``, independent of each other.
    T_parent_axis_file : (4, 4) array
        Says which way the axis points, where along it the frame lies, and how the frame is turned about it.
    joint : str
        Name of the joint, for messages.

    Raises
    ------
    CalibrationError
        Too few poses, or the joint turned by less than ``LEAST_TURN_DEG``.
    """
    T, P = np.asarray(T_parent_marker, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    if len(T) < LEAST_POSES:
        raise CalibrationError(
            f"joint '{joint}': its marker and its parent were seen together {len(T)} times, at least {LEAST_POSES} are "
            "needed; turn it slowly before a camera that sees both"
        )
    if len(T) > MOST_POSES:
        keep = np.linspace(0, len(T) - 1, MOST_POSES).round().astype(int)
        T, P = T[keep], P[keep]
    turns = so3.log(T[:, :3, :3] @ T[0, :3, :3].T)
    # What a joint that hardly moves has for an axis is noise; so its turn is measured before there is one.
    turned_deg = float(np.rad2deg(np.linalg.norm(turns[:, None] - turns[None], axis=-1).max()))
    if turned_deg < LEAST_TURN_DEG:
        raise CalibrationError(
            f"joint '{joint}' turned by {turned_deg:.1f} degrees only, its axis needs at least {LEAST_TURN_DEG:g}; "
            "move it over its whole stroke"
        )
    A = _first_axis(T, T_parent_axis_file)
    angle = _angles(A, T)
    zero = int(np.argmin(np.abs(angle - 0.5 * (angle.min() + angle.max()))))
    angle = angle - angle[zero]
    M = se3.inverse(A) @ T[zero]
    root = np.linalg.inv(np.linalg.cholesky(P))
    n = len(T)
    free = np.array([i for i in range(n) if i != zero])
    for _ in range(STEPS):
        r, J = _linearised(A, M, angle, T, root)
        J = np.delete(J, 10 + zero, axis=1)
        step = -np.linalg.lstsq(J, r, rcond=None)[0]
        a = np.zeros(6)
        a[list(TOLD)] = step[:4]
        A, M = se3.retract(A, a), se3.retract(M, step[4:10])
        angle[free] += step[10:]
        if np.abs(step).max() < SETTLED:
            break
    r, J = _linearised(A, M, angle, T, root)
    J = np.delete(J, 10 + zero, axis=1)
    cov = np.linalg.inv(J.T @ J)
    predicted = A @ _turned(angle) @ M
    return Axis(A, cov[:4, :4], M, angle, se3.local(predicted, T), float(r @ r), 6 * n - (10 + n - 1))


def _turned(angle) -> np.ndarray:
    R = so3.exp(np.asarray(angle)[..., None] * np.array([0.0, 0.0, 1.0]))
    return se3.from_rotation_translation(R, np.zeros(3))


def _first_axis(T: np.ndarray, T_file: np.ndarray) -> np.ndarray:
    """Direction from the turns' common eigenvector, a point from ``(I - R) c = t``; both least squares."""
    relative = T @ se3.inverse(T[0])
    gap = relative[:, :3, :3] - np.eye(3)
    d = np.linalg.eigh(np.einsum("nki,nkj->ij", gap, gap))[1][:, 0]
    d = d * (1.0 if d @ T_file[:3, 2] >= 0 else -1.0)
    # Along the line nothing is told; there it stays at the file's origin.
    rows = np.concatenate([-gap.reshape(-1, 3), d[None]])
    right = np.concatenate([relative[:, :3, 3].reshape(-1), [d @ T_file[:3, 3]]])
    c = np.linalg.lstsq(rows, right, rcond=None)[0]
    x = T_file[:3, 0] - d * (d @ T_file[:3, 0])
    x /= np.linalg.norm(x)
    return se3.from_rotation_translation(np.stack([x, np.cross(d, x), d], axis=-1), c)


def _angles(A: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Turn of each pose about the axis against the first, unwrapped in their order."""
    R = A[:3, :3].T @ T[:, :3, :3] @ T[0, :3, :3].T @ A[:3, :3]
    return np.unwrap(np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1]))


def _linearised(A, M, angle, T, root):
    """Whitened residuals (6n,) of the poses and their Jacobian by axis (4), marker (6) and angles (n)."""
    n = len(T)
    Z = _turned(angle)
    predicted = A @ Z @ M
    xi = se3.local(predicted, T)
    # T = predicted exp(e): a right perturbation b of the prediction takes it to exp(-b) exp(e).
    back = -se3.Jl_inv(xi)
    J = np.zeros((n, 6, 10 + n))
    J[:, :, :4] = (back @ se3.Ad(se3.inverse(Z @ M)))[:, :, list(TOLD)]
    J[:, :, 4:10] = back
    J[np.arange(n), :, 10 + np.arange(n)] = (back @ se3.Ad(np.broadcast_to(se3.inverse(M), (n, 4, 4))))[
        :, :, 5
    ]
    return (root @ xi[..., None]).reshape(-1), (root @ J).reshape(6 * n, 10 + n)
