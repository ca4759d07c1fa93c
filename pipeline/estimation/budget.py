"""Where the uncertainty of the cutting edge's elevation comes from, by what the machine did, and how long it lasts.

The vertical sigma of one median epoch hides what decides: while the machine swings the own part is twice that of
a machine at rest, and in a gap the motion prior is all there is. So epochs are sorted by how the edge moves, and each
class has a budget of its own; the correlation time says over how long the own part does not average out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.estimation.marginals import BodyTrack, Marginals
from pipeline.estimation.problem import Problem
from pipeline.estimation.repeated import SOURCE as CORNERS
from pipeline.estimation.values import Values
from pipeline.network import frames as fr
from pipeline.network.model import SOURCES

CLASSES = ("digging", "swinging", "parked", "tramming", "bridged")
REST_M_S = 0.02
"""Slower than this the edge is parked: less than the vertical sigma in half a second."""
SWING_RAD_S = 0.1
"""Turning about the vertical faster than this is swinging; digging stays in the plane of the boom."""
TRAM_M_S = 0.15
"""Speed of the carrier, where it does not swing."""
STARTS = 200
"""Epochs whose correlation with later ones is followed."""
HORIZON = 400
"""Epochs it is followed for; an own part that lasts longer is said to last at least that long."""


def epoch_classes(problem: Problem, values: Values, track: BodyTrack, seen):
    """What the machine was doing at each epoch: (E,) int array, index into ``CLASSES``.

    ``track`` is that of the tool; ``seen`` (E,) bool, where every link to the datum was observed.
    """
    R = track.T_world_body[:, :3, :3]
    speed = np.linalg.norm(track.velocity[:, :3], axis=1)
    yaw = np.abs(np.einsum("nj,nj->n", R[:, 2], track.velocity[:, 3:]))
    out = np.zeros(len(R), dtype=np.int64)
    roots = [
        k
        for k in track.variables
        if problem.tie.variables[k].kind == "moving"
        and problem.tie.frames.edges[fr.body_frame(problem.tie.variables[k].body)].parent == fr.WORLD
    ]
    for k in roots:
        out[np.linalg.norm(values.rate[k][:, :3], axis=1) > TRAM_M_S] = 3
    out[yaw > SWING_RAD_S] = 1
    out[speed < REST_M_S] = 2
    out[~seen] = 4
    return out


def groups_of(problem: Problem) -> dict[str, np.ndarray]:
    """Columns of the statics by source, for ``vertical_budget``."""
    sources = [*SOURCES, CORNERS] if any(s.source == CORNERS for s in problem.network.statics) else [*SOURCES]
    return {
        source: np.concatenate(
            [problem.statics.columns[k] for k, s in enumerate(problem.network.statics) if s.source == source]
            or [np.array([], dtype=np.int64)]
        )
        for source in sources
    }


def median_budgets(variances: dict[str, np.ndarray], classes) -> tuple[dict, dict]:
    """Median standard deviation of the elevation of the cutting edge's middle by source, m.

    Parameters
    ----------
    variances : dict of str to (k,) array
        Of ``vertical_budget``, at the published epochs.
    classes : (k,) int array
        Of ``epoch_classes``, there.

    Returns
    -------
    whole : dict of str to float
        Over all observed epochs.
    by_class : dict of str to dict
        The same for each class that occurs, with ``epochs``, how many, and ``sigma``, that of all sources together.
    """
    if len(classes) == 0:
        return {}, {}

    def medians(use):
        return {name: round(float(np.sqrt(np.median(v[use]))), 6) for name, v in variances.items()}

    by_class = {}
    for c, name in enumerate(CLASSES):
        use = classes == c
        if np.any(use):
            whole = np.sqrt(np.median(np.sum([v[use] for v in variances.values()], axis=0)))
            by_class[name] = {"epochs": int(use.sum()), "sigma": round(float(whole), 6)} | medians(use)
    observed = classes != CLASSES.index("bridged")
    return (medians(observed) if np.any(observed) else {}), by_class


class Lasting:
    """How long the own part of the cutting edge's elevation stays the same error, gathered from the last part on.

    The own covariance of two epochs is ``Z_k,k+j = (-G_k) ... (-G_k+j-1) Z_k+j``. The time is that after which their
    correlation has fallen to 1/e, by interpolation; epochs nearer than that are not independent witnesses. An epoch is
    followed for at most ``HORIZON`` others, so that much of the parts that come after is kept.
    """

    def __init__(self, time_s, rows):
        self.time_s, self.last = time_s, rows[-1] if len(rows) else -1
        self.starts = np.array([], dtype=np.int64)
        if len(rows) >= 3:
            self.starts = np.unique(
                np.linspace(rows[0], rows[-1] - 1, min(STARTS, len(rows) - 1)).astype(np.int64)
            )
        self.seconds = np.zeros(len(self.starts))
        self.ahead: dict[int, _Carried] = {}

    def add(self, track: BodyTrack, found: Marginals, start: int, count: int) -> None:
        """A part's ``count`` own epochs from ``start`` on: its track of the tool and its marginals."""
        up = track.T_world_body[:count, 2, :3]
        window = {}
        for c, J_x in track.J_x.items():
            m = np.einsum("ni,nij->nj", up, J_x[:count, :3])
            own = _Carried(m, found.Z[c][:count], found.G[c][:count])
            window[c] = own.before(self.ahead[c]) if c in self.ahead else own
        for i in np.flatnonzero((self.starts >= start) & (self.starts < start + count)):
            self.seconds[i] = self._fall(window, start, int(self.starts[i]))
        self.ahead = {c: part.first(HORIZON + 1) for c, part in window.items()}

    def _fall(self, window: dict[int, _Carried], start: int, k: int) -> float:
        t, end = self.time_s, min(self.last, k + HORIZON)
        carried = {c: part.m[k - start] for c, part in window.items()}
        variance_k = sum(float(a @ window[c].Z[k - start] @ a) for c, a in carried.items())
        at = 1.0
        for j in range(k + 1, end + 1):
            covariance, variance = 0.0, 0.0
            for c, part in window.items():
                carried[c] = -carried[c] @ part.G[j - 1 - start]
                forward = part.Z[j - start] @ part.m[j - start]
                covariance += float(carried[c] @ forward)
                variance += float(part.m[j - start] @ forward)
            before, at = at, covariance / max(np.sqrt(variance_k * variance), 1e-300)
            if at < np.exp(-1.0):
                share = (before - np.exp(-1.0)) / max(before - at, 1e-12)
                return float(t[j - 1] + share * (t[j] - t[j - 1]) - t[k])
        return float(t[end] - t[k])

    def described(self, classes) -> dict:
        """``median`` over all starts, ``longest`` (95 % are shorter), and the median by class; seconds.

        ``classes`` (E,) are those of ``epoch_classes``. Empty where nothing moves.
        """
        if len(self.starts) == 0 or not self.ahead:
            return {}
        here, s = classes[self.starts], self.seconds
        times = {"median": np.median(s), "longest": np.quantile(s, 0.95)}
        times |= {name: np.median(s[here == c]) for c, name in enumerate(CLASSES) if np.any(here == c)}
        return {name: round(float(value), 3) for name, value in times.items()}


@dataclass(frozen=True, eq=False)
class _Carried:
    """One chain over some epochs: how the elevation moves with its states, and how these hang together."""

    m: np.ndarray
    """(n, b)."""
    Z: np.ndarray
    """(n, b, b)."""
    G: np.ndarray
    """(n, b, b), one less at the end of the log."""

    def before(self, other: _Carried) -> _Carried:
        return _Carried(*(np.concatenate([getattr(self, f), getattr(other, f)]) for f in ("m", "Z", "G")))

    def first(self, count: int) -> _Carried:
        return _Carried(self.m[:count].copy(), self.Z[:count].copy(), self.G[:count].copy())
