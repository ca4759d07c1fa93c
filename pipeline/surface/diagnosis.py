"""Which one cause would explain the differences of the check shots: proposed, and never applied.

With the differences ``d ~ N(0, V)`` if nothing is wrong, and ``a`` the signature of a cause, its value by least
squares is ``b = a' V^-1 d / a' V^-1 a`` with ``sigma_b² = 1 / a' V^-1 a``, and ``w = b / sigma_b`` is standard normal
if nothing is wrong (Baarda's test of data snooping, with any signature in place of a single outlier). Of c causes the
largest w passes ``w_crit``, at which all of them together speak falsely in 5 of 100 jobs (Šidák). The global test
``d' V^-1 d`` is told beside it and decides nothing: it looks in as many directions as there are components, and of a
cause that w sees in 80 of 100 jobs (of 12 causes) it sees 47 with 30 shots and 24 with 100.

Two causes with the correlation ``r = a_i' V^-1 a_j sigma_i sigma_j`` are told apart by what the second does not
explain of the first, ``u = (w_i - r w_j) / sqrt(1 - r²)``: standard normal if the second is the cause. A cause is named
if it is the most significant one, passes ``w_crit``, and ``|u|`` passes 1.96 against every cause of another name. So a
job whose cause is j is given the name i in less than 5 of 100.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, ndtr, ndtri

from pipeline.surface.shot_errors import Cause, Differences

LEVEL = 0.05
"""Of false alarms, for all causes together; and of a false choice between two."""
POWER = 0.80
NONE, NAMED, UNSURE, UNEXPLAINED = "none", "named", "cannot tell", "unexplained"


@dataclass(frozen=True)
class Candidate:
    """One cause, as the differences see it. Values in its unit."""

    cause: Cause
    value: float
    """By which the true value exceeds that of the files."""
    sigma: float
    w: float
    p_value: float
    """Of w, for this cause alone."""
    left_p_value: float
    """Of the global test of what this cause leaves."""
    seen_from: float
    """Size that its own test sees in 80 of 100 jobs."""
    told_from: float
    """Size at which it is also told from every cause of another name in 80 of 100; infinite where it never is."""
    plausible: bool
    """Whether the value is one that such a thing can have."""


@dataclass(frozen=True)
class Diagnosis:
    """What the differences say about causes."""

    state: str
    """none: the shots agree; named; cannot tell: two causes or more would do; unexplained: no cause does."""
    candidates: tuple[Candidate, ...]
    """The most significant first."""
    rivals: tuple[int, ...]
    """Candidates that the first cannot be told from; none unless `cannot tell`."""
    statistic: float
    """``d' V^-1 d``."""
    components: int
    p_value: float
    critical: float
    """``w_crit``."""

    @property
    def named(self) -> Candidate | None:
        """The one cause, if there is one."""
        return self.candidates[0] if self.state == NAMED else None


def diagnose(differences: Differences) -> Diagnosis | None:
    """The one cause that would explain the differences, if there is one; None without any difference.

    Parameters
    ----------
    differences : Differences
        With their covariance and the signatures.
    """
    d, V, A = differences.value, differences.covariance, differences.signature
    m = len(d)
    if m == 0:
        return None
    root = np.linalg.cholesky(V)
    y, B = np.linalg.solve(root, d), np.linalg.solve(root, A)
    statistic, _, p_value = global_test(differences, np.ones(m, bool))
    length = np.linalg.norm(B, axis=0)
    told = np.flatnonzero(length > 1e-9)  # a time offset, where nothing moved at the pass, has no signature
    if not len(told):
        return Diagnosis(_without(p_value), (), (), statistic, m, p_value, critical_w(1))
    unit = B[:, told] / length[told]
    w = unit.T @ y
    r = unit.T @ unit
    critical = critical_w(len(told))
    causes = [differences.causes[k] for k in told]
    other = np.array([[a.what != b.what for b in causes] for a in causes])
    apart = np.sqrt(np.maximum(1.0 - r**2, 0.0))
    reach = float(ndtri(POWER))
    seen = critical + reach
    needed = np.where(other, (_two_sided() + reach) / np.maximum(apart, 1e-6), 0.0)
    told_from = np.maximum(seen, needed.max(axis=1))
    value = w / length[told]
    plausible = np.array([abs(value[i]) <= c.most for i, c in enumerate(causes)])
    order = np.lexsort((np.arange(len(told)), -np.abs(w), ~plausible))
    candidates = tuple(
        Candidate(
            cause=causes[i],
            value=float(value[i]),
            sigma=float(1.0 / length[told[i]]),
            w=float(w[i]),
            p_value=float(2.0 * ndtr(-abs(w[i]))),
            left_p_value=float(chdtrc(m - 1, max(statistic - w[i] ** 2, 0.0))) if m > 1 else 1.0,
            seen_from=float(seen / length[told[i]]),
            told_from=float(told_from[i] / length[told[i]])
            if apart[i][other[i]].min(initial=1.0) > 1e-3
            else np.inf,
            plausible=bool(plausible[i]),
        )
        for i in order
    )
    best = order[0]
    if not plausible[best] or abs(w[best]) <= critical:
        return Diagnosis(_without(p_value), candidates, (), statistic, m, p_value, critical)
    rivals = []
    for place, j in enumerate(order):
        if other[best, j] and plausible[j]:
            u = abs(w[best] - r[best, j] * w[j]) / max(apart[best, j], 1e-9)
            # Two that are one and the same direction differ by rounding only.
            if apart[best, j] < 1e-3 or u <= _two_sided():
                rivals.append(place)
    return Diagnosis(UNSURE if rivals else NAMED, candidates, tuple(rivals), statistic, m, p_value, critical)


def global_test(differences: Differences, use: np.ndarray) -> tuple[float, int, float]:
    """``d' V^-1 d`` of some components with all the errors that they share, how many they are, and its p-value."""
    rows = np.flatnonzero(use)
    if not len(rows):
        return float("nan"), 0, float("nan")
    root = np.linalg.cholesky(differences.covariance[np.ix_(rows, rows)])
    y = np.linalg.solve(root, differences.value[rows])
    statistic = float(y @ y)
    return statistic, len(rows), float(chdtrc(len(rows), statistic))


def critical_w(causes: int) -> float:
    """Size of the largest of so many w that is passed by chance in 5 of 100 jobs, by Šidák: a little less often."""
    each = 1.0 - (1.0 - LEVEL) ** (1.0 / causes)
    return float(-ndtri(0.5 * each))


def _two_sided() -> float:
    return float(-ndtri(0.5 * LEVEL))


def _without(p_value: float) -> str:
    return UNEXPLAINED if p_value < LEVEL else NONE
