"""The arrow written out as one dense matrix: what the block algebra must agree with."""

import numpy as np

from pipeline.estimation.problem import first_residual, motion_residual
from pipeline.estimation.residuals import corner_residuals, sensor_residuals


def assemble(chains, C, g_z):
    """Dense normal matrix and gradient; order: chains, epoch by epoch, then the statics."""
    sizes = [c.g.size for c in chains]
    starts = np.cumsum([0, *sizes])
    n, p = starts[-1], len(g_z)
    H, g = np.zeros((n + p, n + p)), np.zeros(n + p)
    for chain, start in zip(chains, starts, strict=False):
        E, b = chain.g.shape
        for k in range(E):
            a = start + k * b
            H[a : a + b, a : a + b] = chain.D[k]
            if k + 1 < E:
                H[a : a + b, a + b : a + 2 * b] = chain.A[k]
                H[a + b : a + 2 * b, a : a + b] = chain.A[k].T
            H[a : a + b, n + chain.columns] = chain.B[k]
            H[n + chain.columns, a : a + b] = chain.B[k].T
            g[a : a + b] = chain.g[k]
    H[n:, n:], g[n:] = C, g_z
    return H, g, starts


def inverse(H):
    """Inverse of a positive definite matrix, balanced first so that units do not cost digits."""
    d = 1 / np.sqrt(np.diagonal(H))
    return np.linalg.inv(H * d[:, None] * d[None]) * d[:, None] * d[None]


def jacobian(problem, values):
    """All whitened residuals of a plain problem and their Jacobian as one dense matrix, columns as in ``assemble``.

    Row by row from the residuals' own functions: neither the compiled kernels nor any block has a part in it.
    """
    E, places, at = len(problem.epochs.time_ns), {}, 0
    for c, members in enumerate(problem.chains):
        b = problem.chain_size(c)
        for k in members:
            places[k] = at + b * np.arange(E) + problem.place(k)[1].start
        at += E * b
    n, p = at, problem.statics.size
    rows, residuals = [], []

    def add(r, by_state, by_static=()):
        """One block of rows: ``by_state`` of (variable, epoch, (m, size))."""
        J = np.zeros((len(r), n + p))
        for k, epoch, block in by_state:
            J[:, places[k][epoch] : places[k][epoch] + block.shape[-1]] += block
        for s, block in by_static:
            J[:, n + problem.statics.columns[s]] += block
        rows.append(J)
        residuals.append(r)

    for function, groups in ((corner_residuals, problem.corners), (sensor_residuals, problem.sensors)):
        for group in groups:
            r, J = function(group, values, problem.statics)
            for i, epoch in enumerate(group.epoch):
                add(
                    r[i],
                    [(k, epoch, block[i]) for k, block in J.variables.items()],
                    [(s, block[i]) for s, block in J.statics.items()],
                )
    for k in range(len(problem.tie.variables)):
        e, J_1, J_2 = motion_residual(problem, values, k)
        for i in range(E - 1):
            add(e[i], [(k, i, J_1[i]), (k, i + 1, J_2[i])])
        e, J = first_residual(problem, values, k)
        add(e, [(k, 0, J)])
    add(values.z, [], [(s, np.eye(p)[:, c]) for s, c in enumerate(problem.statics.columns) if len(c)])
    return np.concatenate(residuals), np.concatenate(rows), n


def own_and_common(J, n):
    """Both parts of the states' covariance, by an orthogonal factor of the Jacobian: no normal equations.

    With ``Q' J = [[R_xx, R_xz], [0, R_zz]]``: own ``(R_xx' R_xx)^-1``, ``P_zz = (R_zz' R_zz)^-1``, and the states
    follow the statics by ``-R_xx^-1 R_xz``.

    Returns
    -------
    own : (n, n) array
    Y : (n, p) array
    P_zz : (p, p) array
    """
    scale = np.linalg.norm(J, axis=0)
    R = np.linalg.qr(J / scale, mode="r")
    own_root = np.linalg.solve(R[:n, :n], np.eye(n)) / scale[:n, None]
    Y = np.linalg.solve(R[:n, :n], R[:n, n:]) / scale[:n, None] * scale[n:]
    zz_root = np.linalg.solve(R[n:, n:], np.eye(J.shape[1] - n)) / scale[n:, None]
    return own_root @ own_root.T, Y, zz_root @ zz_root.T
