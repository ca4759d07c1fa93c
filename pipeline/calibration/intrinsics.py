"""Intrinsics from views of a board: one adjustment over the lens, the board's bend and one pose per view.

Gauss-Newton with Levenberg's damping; the poses are reduced out view by view (Schur complement), so the work grows with
the views and not with their cube:

    [ H_ss  H_sx ] [ds]   [g_s]       S = H_ss - sum_v H_sx,v H_xx,v^-1 H_xs,v       P_ss = sigma0² S^-1
    [ H_xs  H_xx ] [dx] = [g_x]

A board is never flat: two numbers for its bend along x and along y (mrcal's idea) are unknowns beside the lens. Corners
that are off are held down by Huber's loss, then left out, and sigma0² of those that stay scales all covariances: the
residuals tell how much corners scatter, whatever the finder of corners says. What the corners of a view share is
`view_errors`' business.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from pipeline.calibration.view_errors import with_shared_errors
from pipeline.calibration.views import View
from pipeline.errors import CalibrationError
from pipeline.geometry import se3, so3
from pipeline.geometry.lenses import BROWN8, Lens

HUBER = 2.0
"""Residual of a group, in units of what it should be, from which it pulls no stronger."""
OUTLIER = 1e-5
"""Probability of a residual at which a group is left out: in ten thousand good corners there is a tenth of one."""
BAD_VIEW = 0.2
"""Share of outliers from which a whole view is left out: what bends a board in one corner bends the rest of it too. In
a set of twelve, two views with a quarter of such corners moved the principal point by five sigmas."""
HOLD = 10.0
"""Standard deviation of the coefficients below the line of the eight-coefficient model around zero: above and below
they all but cancel, and free they wander off to hundreds without moving a pixel."""
_STEPS = 100
_SETTLED = 1e-4
"""Length of a step in posterior standard deviations."""
_BEND = 2


@dataclass(frozen=True)
class Solution:
    """A lens, and how well it is known."""

    lens: Lens
    intrinsics: np.ndarray
    """(n,) order of ``lens.parameters``."""
    covariance: np.ndarray
    """(n, n)."""
    bend_m: np.ndarray
    """(2,) how far the middle of the board stands out, along x and along y."""
    T_camera_board: np.ndarray
    """(v, 4, 4)."""
    information: np.ndarray
    """(v, n, n) what each view says on the intrinsics, its pose and the scatter of corners taken in."""
    residual_px: list[np.ndarray]
    """Of each view (m, c, 2): observed minus predicted."""
    used: list[np.ndarray]
    """Of each view (m,) bool: groups that were not left out as outliers."""
    sigma0: float
    """Scatter of corners over what their covariances say."""
    shared_factor: float
    """By which the covariance grew on the whole for what the corners of a view share (`view_errors`)."""

    @property
    def rms_px(self) -> float:
        """Of the residuals that were used, per axis."""
        kept = np.concatenate([r[u].ravel() for r, u in zip(self.residual_px, self.used)])
        return float(np.sqrt(np.mean(kept**2)))

    @property
    def sigma(self) -> np.ndarray:
        """(n,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def outliers(self) -> int:
        """Groups left out, those of whole views not counted."""
        return sum(int(np.count_nonzero(~used)) for used in self.used if np.any(used))

    @property
    def views_used(self) -> np.ndarray:
        """(v,) bool: views that were not left out whole."""
        return np.array([bool(np.any(used)) for used in self.used])


class _Rows:
    """All groups of all views, one after the other, whitened."""

    def __init__(self, views: Sequence[View], corners_m: np.ndarray):
        self.view = np.concatenate([np.full(len(v.point), i) for i, v in enumerate(views)])
        self.starts = np.concatenate([[0], np.cumsum([len(v.point) for v in views])[:-1]]).astype(int)
        self.point = np.concatenate([v.point for v in views])
        self.uv = np.concatenate([v.uv for v in views])
        self.white = np.linalg.inv(np.linalg.cholesky(np.concatenate([v.cov for v in views])))
        self.groups, self.each = self.point.shape
        self.p = corners_m[self.point]
        low, high = corners_m.min(axis=0), corners_m.max(axis=0)
        a = (self.p[..., :2] - 0.5 * (low + high)[:2]) / (0.5 * (high - low)[:2])
        self.bulge = 1 - a**2
        """(m, c, 2): how far out a corner stands when the middle does by one."""

    def linearised(
        self, lens: Lens, k: np.ndarray, bend: np.ndarray, T: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (m, c, 2) in px, whitened ones (m, 2c), their Jacobians by statics and by poses."""
        R, t = T[self.view, :3, :3], T[self.view, :3, 3]
        p = self.p.copy()
        p[..., 2] += self.bulge @ bend
        p_camera = np.einsum("mij,mcj->mci", R, p) + t[:, None]
        uv, J_p, J_k = lens.project_with_jacobians(p_camera, k)
        J_body = np.einsum("mcij,mjk->mcik", J_p, R)  # by the point in the board's frame
        J_x = np.concatenate([J_body, -J_body @ so3.hat(p)], axis=-1)
        J_bend = J_body[..., 2:] * self.bulge[..., None, :]
        J_s = np.concatenate([J_k, J_bend], axis=-1)
        residual = self.uv - uv

        def whitened(a: np.ndarray) -> np.ndarray:
            return np.asarray(self.white @ a.reshape(self.groups, 2 * self.each, -1))

        return residual, whitened(residual)[..., 0], whitened(J_s), whitened(J_x)


def solve(
    lens: Lens,
    views: Sequence[View],
    corners_m: np.ndarray,
    intrinsics: np.ndarray,
    T_camera_board: np.ndarray,
    bends: bool = True,
) -> Solution:
    """Adjust a lens to views of a board.

    Parameters
    ----------
    lens : Lens
        Its model.
    views : sequence of View
        At least three.
    corners_m : (n, 3) array
        Corners of the board, metres.
    intrinsics : (n,) array
        Start.
    T_camera_board : (v, 4, 4) array
        Start.
    bends : bool
        Whether the board's bend is an unknown; else it is flat.

    Returns
    -------
    Solution

    Raises
    ------
    CalibrationError
        The views do not tell the lens.
    """
    rows = _Rows(views, corners_m)
    free = np.arange(len(lens) + (_BEND if bends else 0))
    state = np.concatenate([intrinsics, np.zeros(_BEND)]), np.array(T_camera_board, float)
    used = np.ones(rows.groups, bool)
    state, _ = _adjusted(rows, lens, state, used, free, HUBER)
    for _ in range(3):
        _, white, _, _ = rows.linearised(lens, state[0][: len(lens)], state[0][len(lens) :], state[1])
        square = np.sum(white**2, axis=1)
        dof = 2 * rows.each
        sigma2 = float(np.median(square[used])) / chi2.ppf(0.5, dof)
        kept = square <= sigma2 * chi2.isf(OUTLIER, dof)
        count = np.add.reduceat(kept.astype(int), rows.starts)
        of = np.bincount(rows.view)
        # A view of which little stays would hang its pose on it.
        kept &= ((count * rows.each >= 8) & (count >= (1 - BAD_VIEW) * of))[rows.view]
        settled = np.array_equal(kept, used)
        used = kept
        if _redundancy(rows, used, free) < 10:
            raise CalibrationError("the corners do not fit one another in most views; is it this board?")
        state, system = _adjusted(rows, lens, state, used, free, np.inf)
        if settled:
            break
    return _solution(rows, lens, state, system, used, free)


State = tuple[np.ndarray, np.ndarray]
"""Statics (n + 2,) and poses (v, 4, 4)."""


@dataclass(frozen=True)
class _System:
    """The normal equations, whitened and weighted."""

    cost: float
    H_ss: np.ndarray
    H_sx: np.ndarray
    """(v, s, 6)."""
    H_xx: np.ndarray
    g_s: np.ndarray
    g_x: np.ndarray

    def reduced(self, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Per view what it says on the statics (v, s, s), the gradient so reduced (s,), and H_xx^-1 H_xs (v, 6, s)."""
        H_xx = self.H_xx + damping * np.eye(6) * np.einsum("vii->vi", self.H_xx)[:, None]
        solved = np.linalg.solve(
            H_xx, np.concatenate([np.swapaxes(self.H_sx, 1, 2), self.g_x[..., None]], axis=2)
        )
        taken = self.H_sx @ solved
        return taken[..., :-1], self.g_s - taken[..., -1].sum(axis=0), solved


def _assembled(
    rows: _Rows, lens: Lens, state: State, used: np.ndarray, free: np.ndarray, huber: float
) -> _System:
    _, white, J_s, J_x = rows.linearised(lens, state[0][: len(lens)], state[0][len(lens) :], state[1])
    size = np.sqrt(np.mean(white**2, axis=1))
    weight = used.astype(float)
    if np.isfinite(huber):
        scale = max(float(np.median(size[used])), 1e-9)
        weight = weight * np.minimum(1.0, huber * scale / np.maximum(size, 1e-12))
    # Behind the camera there is no pixel: such a state is refused by its cost.
    if not np.all(np.isfinite(white[used])):
        none = np.zeros(0)
        return _System(np.inf, none, none, none, none, none)
    root = np.sqrt(weight)[:, None]
    white, J_s, J_x = white * root, J_s[..., free] * root[..., None], J_x * root[..., None]

    def by_view(a: np.ndarray) -> np.ndarray:
        return np.asarray(np.add.reduceat(a, rows.starts, axis=0))

    flat = J_s.reshape(-1, len(free))
    held = _held(lens, len(free))
    J_st, J_xt = np.swapaxes(J_s, 1, 2), np.swapaxes(J_x, 1, 2)
    return _System(
        cost=float(np.sum(white**2) + held @ state[0][free] ** 2),
        H_ss=flat.T @ flat + np.diag(held),
        H_sx=by_view(J_st @ J_x),
        H_xx=by_view(J_xt @ J_x) + 1e-9 * np.eye(6),
        g_s=flat.T @ white.ravel() - held * state[0][free],
        g_x=by_view((J_xt @ white[..., None])[..., 0]),
    )


def _adjusted(
    rows: _Rows, lens: Lens, state: State, used: np.ndarray, free: np.ndarray, huber: float
) -> tuple[State, _System]:
    """The state where the weighted squares are least, and the normal equations there."""
    damping = 1e-3
    system = _assembled(rows, lens, state, used, free, huber)
    if not np.isfinite(system.cost):
        raise CalibrationError("no lens could be fitted to begin with; is it this board?")
    for _ in range(_STEPS):
        taken, gradient, solved = system.reduced(damping)
        S = system.H_ss + damping * np.diag(np.diag(system.H_ss)) - taken.sum(axis=0)
        try:
            ds = np.linalg.solve(S, gradient)
        except np.linalg.LinAlgError:
            damping = max(10 * damping, 1e-6)
            continue
        dx = solved[..., -1] - solved[..., :-1] @ ds
        statics = state[0].copy()
        statics[free] += ds
        trial = statics, se3.retract(state[1], dx)
        found = _assembled(rows, lens, trial, used, free, huber)
        # Huber's weights move with the residuals: its cost is compared with a little room.
        if found.cost <= system.cost * (1 + (1e-3 if np.isfinite(huber) else 1e-12)):
            redundancy = max(_redundancy(rows, used, free), 1)
            length = np.sqrt(max(ds @ S @ ds, 0.0) * redundancy / max(system.cost, 1e-300))
            state, system, damping = trial, found, damping / 10 if damping > 1e-12 else 0.0
            if length < _SETTLED:
                break
        else:
            damping = max(10 * damping, 1e-9)
            if damping > 1e8:
                break
    return state, system


def _solution(
    rows: _Rows,
    lens: Lens,
    state: State,
    system: _System,
    used: np.ndarray,
    free: np.ndarray,
) -> Solution:
    n = len(lens)
    residual, white, J_s, _ = rows.linearised(lens, state[0][:n], state[0][n:], state[1])
    sigma2 = float(np.sum(white[used] ** 2)) / _redundancy(rows, used, free)
    taken, _, solved = system.reduced()
    kept = J_s[..., free] * used[:, None, None]
    J_st = np.swapaxes(kept, 1, 2)
    own = np.add.reduceat(J_st @ kept, rows.starts, axis=0) - taken
    pull = np.add.reduceat((J_st @ white[..., None])[..., 0], rows.starts, axis=0)
    pull = pull - np.einsum("vsi,vi->vs", system.H_sx, solved[..., -1])
    S = own.sum(axis=0) + np.diag(_held(lens, len(free)))
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    balanced = S * scale[:, None] * scale
    if np.linalg.eigvalsh(balanced)[0] < 1e-14:
        raise CalibrationError(
            "the views do not tell all of the lens; add views of the board tilted by 20 to 40 degrees, near and far, "
            "and in every corner of the picture"
        )
    there = np.logical_or.reduceat(used, rows.starts)
    held = np.diag(_held(lens, len(free))) / max(int(np.count_nonzero(there)), 1)
    covariance, shared = with_shared_errors(
        (own[there] + held) * scale[:, None] * scale / sigma2, pull[there] * scale / sigma2
    )
    covariance = (covariance * scale[:, None] * scale)[:n, :n]
    covariance = 0.5 * (covariance + covariance.T)
    cuts = rows.starts[1:]
    return Solution(
        lens=lens,
        intrinsics=state[0][:n],
        covariance=covariance,
        bend_m=state[0][n:],
        T_camera_board=state[1],
        information=own[:, :n, :n] / sigma2,
        residual_px=np.split(residual, cuts),
        used=np.split(used, cuts),
        sigma0=float(np.sqrt(sigma2)),
        shared_factor=shared,
    )


def _held(lens: Lens, count: int) -> np.ndarray:
    """(count,) weights that draw statics to zero."""
    held = np.zeros(count)
    if lens is BROWN8:
        held[9:12] = HOLD**-2
    return held


def _redundancy(rows: _Rows, used: np.ndarray, free: np.ndarray) -> int:
    """Observations that are used, without as many as there are unknowns."""
    there = int(np.count_nonzero(np.logical_or.reduceat(used, rows.starts)))
    return int(np.count_nonzero(used)) * 2 * rows.each - len(free) - 6 * there
