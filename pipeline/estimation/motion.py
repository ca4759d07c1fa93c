"""White noise on acceleration: what a body is likely to do between two epochs.

The prior of continuous-time trajectory estimation (Barfoot, State Estimation for Robotics, ch. 11): over ``dt`` the
velocity changes by integrated white noise of spectral density ``q``, so

    e = [ log(T_1^-1 T_2) - dt w_1 ,  Jr^-1(xi) w_2 - w_1 ],   cov e = q (x) [[dt³/3, dt²/2], [dt²/2, dt]]

with ``xi = log(T_1^-1 T_2)``; for an angle the same with plain differences. A state can then be asked for between
epochs too, and two sensors need not tick together.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import se3


def whitening(dt_s):
    """Lower triangular ``W`` with ``W' W`` the inverse of ``[[dt³/3, dt²/2], [dt²/2, dt]]``.

    Parameters
    ----------
    dt_s : (n,) array
        Seconds, positive.

    Returns
    -------
    (n, 2, 2) array
        Divide by the root of the spectral density.
    """
    dt_s = np.asarray(dt_s, dtype=np.float64)
    W = np.zeros(dt_s.shape + (2, 2))
    # Cholesky factor [[dt^1.5/sqrt3, 0], [sqrt3/2 dt^.5, dt^.5/2]], inverted by hand.
    W[..., 0, 0] = np.sqrt(3.0) * dt_s**-1.5
    W[..., 1, 0] = -3.0 * dt_s**-1.5
    W[..., 1, 1] = 2.0 * dt_s**-0.5
    return W


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


def root_density(kind: str, motion: tuple[float, float]):
    """Square roots of the spectral densities, per row of the first half of the residual: (6,) or (1,)."""
    if kind == "moving":
        return np.sqrt(np.repeat(np.asarray(motion), 3))
    return np.sqrt(np.array([motion[1]]))


def whiten(blocks, W, root):
    """``(W (x) 1/root) @ blocks`` for residuals (n, 2h) or Jacobians (n, 2h, k).

    Parameters
    ----------
    blocks : (n, 2h, ...) array
        Unwhitened.
    W : (n, 2, 2) array
        Of ``whitening``.
    root : (h,) or (n, h) array
        Of ``root_density``, for all intervals or for each.
    """
    h = root.shape[-1]
    shape = (slice(None),) + (None,) * (blocks.ndim - 1)
    scale = root.reshape((-1, h) + (1,) * (blocks.ndim - 2))
    first, second = blocks[:, :h] / scale, blocks[:, h:] / scale
    return np.concatenate(
        [W[:, 0, 0][shape] * first, W[:, 1, 0][shape] * first + W[:, 1, 1][shape] * second], axis=1
    )
