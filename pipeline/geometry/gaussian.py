"""Covariances: how they are stored, carried to points and other frames, and how a claimed one is judged.

A covariance is ``(..., n, n)``, symmetric, in the squared units of its errors. The functions that say where
it came from live elsewhere; that of a published pose is ``se3.to_grid_covariance``.
"""

import numpy as np

from pipeline.geometry import so3


def upper_triangle(cov):
    """Upper triangle of a symmetric matrix, row by row: the order of the columns in the tables.

    Parameters
    ----------
    cov : (..., n, n) array
        For a pose, n = 6 and 21 elements come back.

    Returns
    -------
    (..., n (n + 1) / 2) array
    """
    cov = np.asarray(cov, dtype=np.float64)
    rows, columns = np.triu_indices(cov.shape[-1])
    return cov[..., rows, columns]


def from_upper_triangle(triangle):
    """Symmetric matrix of its upper triangle, the inverse of ``upper_triangle``.

    Parameters
    ----------
    triangle : (..., n (n + 1) / 2) array
        Row by row.

    Returns
    -------
    (..., n, n) array
    """
    triangle = np.asarray(triangle, dtype=np.float64)
    n = (int(np.sqrt(8 * triangle.shape[-1] + 1)) - 1) // 2
    assert n * (n + 1) // 2 == triangle.shape[-1], triangle.shape
    rows, columns = np.triu_indices(n)
    cov = np.empty(triangle.shape[:-1] + (n, n))
    cov[..., rows, columns] = triangle
    cov[..., columns, rows] = triangle
    return cov


def tool_point_covariance(T_world_body, cov_xi, p_body):
    """Covariance of a body-fixed point, in the world frame.

    First-order propagation through ``p_world = T_world_body @ exp(xi) @ p_body``, after eq. (3) of the
    paper, which stops at the state; the step to a body-fixed point is ours. The point itself counts as
    exact here: add ``rotate_covariance(R_world_body, cov_p_body)`` for an edge that was measured.

    Parameters
    ----------
    T_world_body : (..., 4, 4) array
        Only its rotation is used.
    cov_xi : (..., 6, 6) array
        Covariance of ``xi = [rho, phi]``, in m² and rad².
    p_body : (..., 3) array
        Metres.

    Returns
    -------
    (..., 3, 3) array
        Covariance of the world point, in m².
    """
    J_p_xi = tool_point_jacobian(T_world_body, p_body)
    return J_p_xi @ cov_xi @ np.swapaxes(J_p_xi, -1, -2)


def tool_point_jacobian(T_world_body, p_body):
    """How a body-fixed point moves in the world with the error of its body: ``R [I, -hat(p_body)]``.

    Parameters
    ----------
    T_world_body : (..., 4, 4) array
        Only its rotation is used.
    p_body : (..., 3) array
        Metres.

    Returns
    -------
    (..., 3, 6) array
        ``J_p_xi``: metres in the world per unit of ``xi = [rho, phi]``.
    """
    R = np.asarray(T_world_body, dtype=np.float64)[..., :3, :3]
    by_rotation = -R @ so3.hat(p_body)
    return np.concatenate([np.broadcast_to(R, by_rotation.shape), by_rotation], axis=-1)


def rotate_covariance(R, cov):
    """Covariance of the same vector along the axes of another frame: ``R cov R^T``.

    Parameters
    ----------
    R : (..., m, n) array
        ``R_target_source``, or any Jacobian.
    cov : (..., n, n) array
        Along the axes of the source.

    Returns
    -------
    (..., m, m) array
    """
    R = np.asarray(R, dtype=np.float64)
    return R @ cov @ np.swapaxes(R, -1, -2)


def nees(error, cov):
    """Normalised estimation error squared, ``error^T cov^-1 error``: n on average if ``cov`` is honest.

    Parameters
    ----------
    error : (..., n) array
        Estimate minus truth.
    cov : (..., n, n) array
        The covariance the estimate claims.

    Returns
    -------
    (...,) array
    """
    error = np.asarray(error, dtype=np.float64)
    whitened = np.linalg.solve(np.asarray(cov, dtype=np.float64), error[..., None])[..., 0]
    return np.einsum("...i,...i->...", error, whitened)


def nees_band(n, runs, level=0.95):
    """Interval in which the mean NEES of independent runs falls if the covariance is honest.

    Parameters
    ----------
    n : int
        Dimension of the error.
    runs : int
        Independent simulations over which the mean is taken.
    level : float
        Probability of falling inside, the rest shared by both sides.

    Returns
    -------
    low, high : float
    """
    from scipy.stats import chi2  # 0.3 s to import, and only simulations ask

    low, high = chi2.ppf([0.5 * (1 - level), 0.5 * (1 + level)], n * runs) / runs
    return float(low), float(high)


def is_covariance(cov, tolerance=1e-9):
    """Whether matrices are finite, symmetric and positive semi-definite.

    Judged after scaling the diagonal to one: a pose holds m² and rad², and a tolerance on the raw numbers
    would see only the larger unit.

    Parameters
    ----------
    cov : (..., n, n) array
        In any mixture of units.
    tolerance : float
        On the asymmetry, and on the most negative eigenvalue, of the correlation matrix.

    Returns
    -------
    (...,) bool array
    """
    cov = np.asarray(cov, dtype=np.float64)
    finite = np.all(np.isfinite(cov), axis=(-1, -2))
    cov = np.where(finite[..., None, None], cov, 0.0)
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    # A variance of zero is allowed (something held fixed); its covariances must then be zero too.
    sigma = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = cov / sigma[..., :, None] / sigma[..., None, :]
    symmetric = np.all(np.abs(correlation - np.swapaxes(correlation, -1, -2)) <= tolerance, axis=(-1, -2))
    least = np.linalg.eigvalsh(0.5 * (correlation + np.swapaxes(correlation, -1, -2)))[..., 0]
    return finite & symmetric & np.all(variance >= 0, axis=-1) & (least >= -tolerance)
