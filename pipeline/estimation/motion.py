"""White noise on acceleration, and on velocity: what a body is likely to do between two epochs.

The prior of continuous-time trajectory estimation (Barfoot, State Estimation for Robotics, ch. 11): over ``dt`` the
velocity changes by integrated white noise of spectral density ``q``, so

    e = [ log(T_1^-1 T_2) - dt w_1 ,  Jr^-1(xi) w_2 - w_1 ],   cov e = q (x) [[dt³/3, dt²/2], [dt²/2, dt]]
                                                                     + v (x) [[dt, 0], [0, 0]]

with ``xi = log(T_1^-1 T_2)``; for an angle the same with plain differences. A state can then be asked for between
epochs too, and two sensors need not tick together.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import se3


def whitening(dt_s, density):
    """Lower triangular ``W`` of every component with ``W' W`` the inverse of its covariance over ``dt``.

    Parameters
    ----------
    dt_s : (n,) array
        Seconds, positive.
    density : (n, h, 2) array
        Of acceleration and of velocity, by component of the residual's first half.

    Returns
    -------
    (n, h, 3) array
        ``w00, w10, w11``.
    """
    dt = np.asarray(dt_s, dtype=np.float64)[:, None]
    a, v = density[..., 0], density[..., 1]
    # Cholesky factor of the covariance, inverted by hand; without v it is a dt³/3, and l22 half the root of a dt.
    l11 = np.sqrt(a * dt**3 / 3 + v * dt)
    l21 = a * dt**2 / 2 / l11
    l22 = np.sqrt(a * dt * (a * dt**2 / 12 + v) / (a * dt**2 / 3 + v))
    return np.stack([1 / l11, -l21 / (l11 * l22), 1 / l22], axis=-1)


def pose_residual(T_1, w_1, T_2, w_2, dt_s, jacobians=True):
    """Unwhitened motion residual of a moving body and its Jacobians.

    Parameters
    ----------
    T_1, T_2 : (n, 4, 4) array
        Pose in the anchor at two neighbouring epochs.
    w_1, w_2 : (n, 6) array
        Velocity in the body, translation first, m/s and rad/s.
    dt_s : (n,) array
        Seconds between the two epochs.
    jacobians : bool
        Whether to compute them; else None comes back in their place.

    Returns
    -------
    e : (n, 12) array
    J_1, J_2 : (n, 12, 12) array
        By ``[xi, dw]`` of the first and of the second state.
    """
    xi = se3.local(T_1, T_2)
    Ji = se3.Jr_inv(xi)
    e = np.concatenate([xi - dt_s[:, None] * w_1, np.einsum("nij,nj->ni", Ji, w_2) - w_1], axis=-1)
    if not jacobians:
        return e, None, None
    G = se3.jr_inv_times_derivative(xi, w_2)
    Jl = se3.Jl_inv(xi)  # d xi = Jr_inv d2 - Jl_inv d1
    J_1, J_2 = np.zeros((len(e), 12, 12)), np.zeros((len(e), 12, 12))
    J_1[:, :6, :6] = -Jl
    J_1[:, :6, 6:] = -dt_s[:, None, None] * np.eye(6)
    J_1[:, 6:, :6] = -G @ Jl
    J_1[:, 6:, 6:] = -np.eye(6)
    J_2[:, :6, :6] = Ji
    J_2[:, 6:, :6] = G @ Ji
    J_2[:, 6:, 6:] = Ji
    return e, J_1, J_2


def angle_residual(a_1, w_1, a_2, w_2, dt_s, jacobians=True):
    """The same for a joint: residual (n, 2), Jacobians (n, 2, 2) by ``[da, dw]`` of each state."""
    e = np.stack([a_2 - a_1 - dt_s * w_1, w_2 - w_1], axis=-1)
    if not jacobians:
        return e, None, None
    J_1 = np.zeros((len(e), 2, 2))
    J_1[:, 0, 0] = J_1[:, 1, 1] = -1.0
    J_1[:, 0, 1] = -dt_s
    return e, J_1, np.broadcast_to(np.eye(2), J_1.shape)


def density_of(kind: str, motion: tuple[float, float]):
    """Densities by component of the first half of the residual, (6, 2) or (1, 2): of acceleration, of velocity (0)."""
    a = (
        np.repeat(np.asarray(motion, dtype=float), 3)
        if kind == "moving"
        else np.asarray(motion[1:], dtype=float)
    )
    return np.stack([a, np.zeros_like(a)], axis=-1)


def whiten(blocks, W):
    """Residuals (n, 2h) or Jacobians (n, 2h, k) in their own standard deviations; `W` is (n, h, 3) of ``whitening``."""
    h = W.shape[1]
    w00, w10, w11 = np.moveaxis(W.reshape(W.shape + (1,) * (blocks.ndim - 2)), 2, 0)
    first, second = blocks[:, :h], blocks[:, h:]
    return np.concatenate([w00 * first, w10 * first + w11 * second], axis=1)
