"""What looking again brings: the own part of a pose after smoothing over many looks, at looks and between them.

In the steady state every look brings the same information H every ``dt``, and between looks the body accelerates as
white noise does (``estimation.motion``: densities q of acceleration and v of a shake). The covariance that a filter
predicts for the next look then no longer changes,

    P = F (P^-1 + H)^-1 F' + Q,

a discrete Riccati equation, solved by doubling (Chu, Fan, Lin 2005): each step is worth twice as many looks. Run
backwards, the motion is the same with the velocity's sign turned, so the same P tells what the future says, and a
smoothed pose is both together. Between looks both are carried as far as the instant lies from theirs.
"""

from __future__ import annotations

import numpy as np

DOUBLINGS = 12
"""4,096 looks; where almost nothing is seen that is where it stops."""


def smoothed(H, dt_s: float, acceleration, shake=0.0, at=(0.0,)):
    """Covariance of poses after smoothing over very many looks of equal information, mean over instants.

    Parameters
    ----------
    H : (n, b, b) array
        Information of one look on the pose, 1/m² and 1/rad².
    dt_s : float
        From look to look.
    acceleration : (b,) or (n, b) array
        Densities of white-noise acceleration, m²/s³ and rad²/s³; positive.
    shake : (b,) or (n, b) array
        Densities of white noise on the velocity, m²/s and rad²/s.
    at : sequence of float
        Instants, as shares of the time from one look to the next, 0 <= at < 1.

    Returns
    -------
    (n, b, b) array
        m² and rad².
    """
    n, b = H.shape[:2]
    acceleration, shake = (np.broadcast_to(np.asarray(x, float), (n, b)) for x in (acceleration, shake))

    def carried(P, share: float):
        F, Q = _motion(share * dt_s, acceleration, shake)
        return F @ P @ F.T + Q

    F, Q = _motion(dt_s, acceleration, shake)
    A, G, X = np.broadcast_to(F.T, (n, 2 * b, 2 * b)), np.zeros((n, 2 * b, 2 * b)), Q
    G[:, :b, :b] = H
    one = np.eye(2 * b)
    for _ in range(DOUBLINGS):
        both = np.linalg.solve(one + G @ X, np.concatenate([A, G], axis=-1))
        WA, WG = both[..., : 2 * b], both[..., 2 * b :]
        A_t = np.swapaxes(A, -1, -2)
        A, G, X = A @ WA, _even(G + A @ WG @ A_t), _even(X + A_t @ X @ WA)
    looked = np.linalg.inv(X)
    looked[:, :b, :b] += H
    filtered = _even(np.linalg.inv(looked))
    turned = np.diag(np.repeat([1.0, -1.0], b))
    out = np.zeros_like(H)
    for share in at:
        before = filtered if share == 0 else carried(filtered, share)
        after = turned @ carried(filtered, 1.0 - share) @ turned
        out += np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(after))[:, :b, :b]
    return out / len(at)


def _even(P):
    return 0.5 * (P + np.swapaxes(P, -1, -2))


def _motion(dt_s: float, acceleration, shake):
    """Transition over ``dt`` of pose and velocity, and the covariance of what happens meanwhile."""
    n, b = acceleration.shape
    F, Q = np.eye(2 * b), np.zeros((n, 2 * b, 2 * b))
    F[:b, b:] = dt_s * np.eye(b)
    k = np.arange(b)
    Q[:, k, k] = acceleration * dt_s**3 / 3 + shake * dt_s
    Q[:, k, b + k] = Q[:, b + k, k] = acceleration * dt_s**2 / 2
    Q[:, b + k, b + k] = acceleration * dt_s
    return F, Q
