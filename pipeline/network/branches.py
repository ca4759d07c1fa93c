"""Which of many candidate poses: by what other pictures of the same epoch say, over time, and over all pictures."""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline import threads
from pipeline.geometry import se3
from pipeline.network import frames as fr
from pipeline.network.views import CHUNK, off_px

OWN_SIGMA_PX = 0.3
"""A picture against its own pose: corner noise, and what uncertain intrinsics do."""
OTHER_SIGMA_PX = 3.0
"""A picture against the pose from another: a milliradian of an uncertain mount is a pixel and more. With one sigma for
both, two cameras whose mounts were off by 0.05 deg agreed on a flipped marker."""
AGREE_RAD, DISAGREE_CAP = 0.1, 50.0
"""Two pictures of one body agree on its rotation to about this; a picture that cannot be brought to agree counts no
more than the cap."""
TURN_RAD, TURN_RAD_S = 0.05, 0.5
SHIFT_M, SHIFT_M_S = 0.1, 2.0
"""Between two pictures dt apart a body turns and moves by about the first plus the second times dt. The two branches
of a marker differ by twice its tilt, as a rule tens of degrees."""
STEP_CAP = 50.0
PICTURE_CAP = 4.0
"""Over time one picture counts for no more than this, so that it takes a run of them to turn a body. With 500 here a
marker that was flipped in 5 % of its frames took the body along in each of them, by up to 52 deg."""
TRIALS, WITNESSES = 200, 1000
"""Candidates of an unchanging pose that are tried (those that reproject best), and pictures asked about each."""


def score(candidates, views, around):
    """Reprojection of every candidate in all pictures of its epoch: whitened cost, and the mean corner in px."""
    total = np.zeros(candidates.shape[:2])
    worst = np.zeros(candidates.shape[:2])
    for view, (rows, before, after, step) in zip(views, around, strict=True):

        def chunk(a: int, view=view, rows=rows, before=before, after=after, step=step):
            some = slice(a, a + CHUNK)
            E = candidates[rows[some]]
            if step.edge.ratio != 1.0:
                E = fr.turn(step.edge.ratio * np.arctan2(E[..., 1, 0], E[..., 0, 0]))
            T = before[some, None] @ (se3.inverse(E) if step.sign < 0 else E) @ after[some, None]
            off = off_px(T, view.p_marker, view.xy[some], view.focal_px)
            off = np.where(view.seen[some, None], off, 0.0)
            return np.sum(off**2, axis=-1), np.sum(off, axis=-1) / view.seen[some].sum(-1)[:, None]

        chunks = threads.each(chunk, range(0, len(rows), CHUNK))
        square, middle = (np.concatenate(c) for c in zip(*chunks, strict=True))
        total[rows] += square
        worst[rows] = np.maximum(worst[rows], middle)
    bad = np.isnan(candidates[..., 0, 0])
    return np.where(bad, np.inf, 0.5 * total / OTHER_SIGMA_PX**2), np.where(bad, np.inf, worst)


def disagreement(candidates, misfit):
    """How badly each candidate goes with the pictures of its epoch: its own by reprojection, the others by rotation.

    Another picture chooses the branch that suits the candidate, at the price of that branch's own reprojection. So
    uncertain mounts, which shift whole pictures by pixels, do not decide between branches; corners do.
    """
    n, k = misfit.shape
    R = np.where(np.isfinite(candidates), candidates, np.eye(4))[..., :3, :3]
    cosine = 0.5 * (np.einsum("naij,nbij->nab", R, R) - 1)
    angle = np.arccos(np.clip(cosine, -1, 1))
    own = 0.5 * misfit / OWN_SIGMA_PX**2
    price = np.where(np.isnan(own)[:, None], np.inf, own[:, None] + 0.5 * (angle / AGREE_RAD) ** 2)
    price = np.where(np.isnan(price), np.inf, price).reshape(n, k, k // 2, 2)
    best = np.min(np.where(np.isnan(own), np.inf, own).reshape(n, k // 2, 2), axis=-1)[:, None]
    total = np.minimum(price.min(axis=-1), best + DISAGREE_CAP)
    for j in range(k):  # of its own picture a candidate is one branch and cannot choose
        total[:, j, j // 2] = np.minimum(own[:, j], best[:, 0, j // 2] + DISAGREE_CAP)
    return np.sum(np.where(np.isfinite(total), total, 0.0), axis=-1)  # inf: that picture is of another epoch


def viterbi(candidates, cost, time_s):
    """The cheapest way through the candidates: reprojection, plus how far a body turns and moves in the time."""
    best = np.min(cost, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        unary = np.where(np.isfinite(cost), np.minimum(cost - best, PICTURE_CAP), 1e6)
    # What is no candidate is priced out above; as the identity it cannot overflow here.
    rows = np.where(np.isfinite(candidates), candidates, np.eye(4))
    return _cheapest(rows, unary, np.diff(time_s))


@njit(cache=True, error_model="numpy", nogil=True)
def _cheapest(poses, unary, dt_s):
    """The cheapest way through poses (n, k, 4, 4) with prices of their own (n, k), (n,)."""
    n, k = unary.shape
    value, new = unary[0].copy(), np.empty(k)
    back = np.zeros((n, k), dtype=np.int64)
    for i in range(1, n):
        turn, way = TURN_RAD + TURN_RAD_S * dt_s[i - 1], SHIFT_M + SHIFT_M_S * dt_s[i - 1]
        for b in range(k):
            T_b = poses[i, b]
            new[b] = np.inf
            for a in range(k):
                T_a = poses[i - 1, a]
                trace = square = 0.0
                for u in range(3):
                    for v in range(3):
                        trace += T_a[u, v] * T_b[u, v]
                    square += (T_b[u, 3] - T_a[u, 3]) ** 2
                angle = np.arccos(min(max(0.5 * (trace - 1), -1.0), 1.0))
                step = 0.5 * (angle / turn) ** 2 + 0.5 * square / way**2
                total = value[a] + min(step, STEP_CAP)
                if total < new[b]:
                    new[b], back[i, b] = total, a
        for b in range(k):
            value[b] = new[b] + unary[i, b]
    chosen = np.empty(n, dtype=np.int64)
    chosen[n - 1] = value.argmin()
    for i in range(n - 1, 0, -1):
        chosen[i - 1] = back[i, chosen[i]]
    return chosen


def most_agreed(candidates, misfit, cost):
    """That candidate of one unchanging pose which goes best with all pictures, each by its branch that suits it better.

    A branch has its price in its own reprojection. By distance alone the most central candidate may lie in the midst of
    flipped ones, where a marker was seen from one side only: so a tag on stairs started 125 deg off, and all beyond it.
    """
    flat, price = candidates.reshape(-1, 4, 4), cost.ravel()
    good = np.flatnonzero(np.isfinite(price))
    if len(good) == 0:
        return np.eye(4)
    trial = flat[np.sort(good[np.argsort(price[good], kind="stable")[:TRIALS]])]
    pairs, own = candidates.reshape(-1, 2, 4, 4), 0.5 * misfit.reshape(-1, 2) / OWN_SIGMA_PX**2
    seen = np.flatnonzero(np.isfinite(own).any(axis=1))
    seen = seen[np.linspace(0, len(seen) - 1, min(len(seen), WITNESSES)).astype(int)]
    pairs, own = pairs[seen], np.where(np.isfinite(own[seen]), own[seen], np.inf)
    own = own - own.min(axis=1, keepdims=True)
    T = np.where(np.isfinite(pairs), pairs, np.eye(4))
    cosine = 0.5 * (np.einsum("aij,nbij->anb", trial[:, :3, :3], T[..., :3, :3]) - 1)
    angle = np.arccos(np.clip(cosine, -1, 1))
    shift = np.linalg.norm(trial[:, None, None, :3, 3] - T[..., :3, 3], axis=-1)
    each = own + 0.5 * (angle / AGREE_RAD) ** 2 + 0.5 * (shift / SHIFT_M) ** 2
    return trial[np.argmin(np.sum(np.minimum(each.min(axis=-1), DISAGREE_CAP), axis=1))]
