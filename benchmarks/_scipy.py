"""A problem for SciPy's ``least_squares``: all whitened residuals as one vector, with their sparse Jacobian."""

from __future__ import annotations

import numpy as np
import scipy.optimize
import scipy.sparse

from pipeline.estimation.problem import Problem, first_residual, motion_residual
from pipeline.estimation.residuals import corner_residuals
from pipeline.estimation.values import Values
from pipeline.geometry import se3


class Sparse:
    """Residuals and Jacobian as functions of one vector: steps from the start, then the statics.

    Moving bodies only. The step of a pose is ``first @ exp(x)``, so a Jacobian by right perturbations gets a factor
    ``Jr(x)``.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.E, self.variables = len(problem.epochs.time_ns), len(problem.tie.variables)
        self.size = 12 * self.E * self.variables + problem.statics.size

    def values(self, x) -> Values:
        states = x[: self.size - self.problem.statics.size].reshape(self.variables, self.E, 12)
        return self.problem.first.retract(list(states), x[self.size - self.problem.statics.size :])

    def residuals(self, x):
        p, values = self.problem, self.values(x)
        out = [corner_residuals(g, values, p.statics, jacobians=False)[0].ravel() for g in p.corners]
        for k in range(self.variables):
            out += [
                motion_residual(p, values, k, jacobians=False)[0].ravel(),
                first_residual(p, values, k)[0],
            ]
        return np.concatenate([*out, values.z])

    def jacobian(self, x) -> scipy.sparse.csr_matrix:
        p, values = self.problem, self.values(x)
        states = x[: self.size - p.statics.size].reshape(self.variables, self.E, 12)
        turned = [se3.Jr(s[:, :6]) for s in states]
        rows, columns, entries, at = [], [], [], 0

        def add(J, first_row, column):
            """J (n, r, c) at rows from ``first_row``, columns ``column`` (n, c)."""
            n, r, _ = J.shape
            rows.append(np.broadcast_to((first_row + np.arange(n * r)).reshape(n, r, 1), J.shape).ravel())
            columns.append(np.broadcast_to(column[:, None, :], J.shape).ravel())
            entries.append(J.ravel())

        def add_state(J, first_row, k, epoch):
            J = J.copy()
            J[..., :6] = J[..., :6] @ turned[k][epoch]
            add(J, first_row, 12 * (k * self.E + epoch)[:, None] + np.arange(12))

        z_at = self.size - p.statics.size
        for group in p.corners:
            r, J = corner_residuals(group, values, p.statics)
            for k, block in J.variables.items():
                add_state(block, at, k, group.epoch)
            for static, block in J.statics.items():
                z = z_at + p.statics.columns[static]
                add(block, at, np.broadcast_to(z, (len(r), len(z))))
            at += r.size
        for k in range(self.variables):
            e, J_1, J_2 = motion_residual(p, values, k)
            epoch = np.arange(self.E - 1)
            add_state(J_1, at, k, epoch)
            add_state(J_2, at, k, epoch + 1)
            at += e.size
            e, first = first_residual(p, values, k)
            add_state(first[None], at, k, np.array([0]))
            at += e.size
        add(np.eye(p.statics.size)[None], at, z_at + np.arange(p.statics.size)[None])
        at += p.statics.size
        shape = at, self.size
        parts = np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))
        return scipy.sparse.csr_matrix(parts, shape=shape)


def solve(problem: Problem, steps: int = 200) -> tuple[Values, float, int]:
    """Where trust-region reflective ends: values, cost, and how many Jacobians were asked for.

    ``lsmr`` solves each step, the only choice with a sparse Jacobian; columns are scaled. With its default
    tolerance of 1e-2 SciPy was 1e-4 of the cost above the optimum after 200 steps, at 1,000 epochs; with 1e-10 it is
    there after 21, in the same time.
    """
    sparse = Sparse(problem)
    found = scipy.optimize.least_squares(
        sparse.residuals, np.zeros(sparse.size), sparse.jacobian, method="trf", tr_solver="lsmr", x_scale="jac",
        max_nfev=steps, tr_options={"maxiter": 3000, "atol": 1e-10, "btol": 1e-10},
    )  # fmt: skip
    return sparse.values(found.x), float(found.cost), int(found.njev)
