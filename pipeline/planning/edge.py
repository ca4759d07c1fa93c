"""The predicted covariance of the cutting edge: own part, common part, and where the common part comes from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.estimation.repeated import SOURCE as CORNERS
from pipeline.geometry import se3
from pipeline.network import frames as fr
from pipeline.network.model import SOURCES
from pipeline.planning.looks import Looking, Looks
from pipeline.planning.smoothing import smoothed

MEASUREMENTS = "statics from measurements"
BETWEEN_LOOKS = (0.0, 0.25, 0.5, 0.75)
"""The edge is asked for whenever the bucket's sensor is read, so mostly between two pictures."""
UNSEEN_M = 1.0
"""An edge less sure than this is not seen."""


@dataclass(frozen=True, eq=False)
class EdgePlan:
    """Of the middle of the cutting edge at n postures; easting, northing, elevation, m²."""

    p_world: np.ndarray
    """(n, 3)."""
    one_look: np.ndarray
    """(n, 3, 3) own part of one look; nan where the edge is not seen, as everywhere below."""
    own: np.ndarray
    """(n, 3, 3) own part after smoothing over many looks, mean over the time from one to the next."""
    common: np.ndarray
    """(n, 3, 3)."""
    by_source: dict[str, np.ndarray]
    """(n,) variance of the elevation through the priors of each source; ``MEASUREMENTS`` is the common part's rest."""

    @property
    def total(self) -> np.ndarray:
        """(n, 3, 3) own after smoothing, and common."""
        return self.own + self.common

    def sigma_h(self, part: str = "total") -> np.ndarray:
        """(n,) standard deviation of the elevation, m; part is total, own, common or one_look."""
        return np.sqrt(getattr(self, part)[:, 2, 2])


def edge_plan(found: Looks, S, looking: Looking, densities: dict[str, tuple] | None = None) -> EdgePlan:
    """What the edge's covariance will be, with statics of information S.

    Parameters
    ----------
    found : Looks
        One at each posture.
    S : (p, p) array
        Of ``Looks.statics_information``, over the looks of the whole shift or of one.
    looking : Looking
        How often is looked.
    densities : dict of str to (acceleration, shake), optional
        By body: densities of its half state, (h,) each, m²/s³ and rad²/s³ (m²/s and rad²/s); where a body is missing,
        those of machine.toml.
    """
    T, L_x, L_s = _edge_maps(found)
    n = len(found.H_xx)
    P_zz = np.linalg.inv(S)  # never worse conditioned than its priors: S >= I
    groups = {
        source: np.concatenate(
            [found.statics.columns[k] for k, s in enumerate(found.network.statics) if s.source == source]
            or [np.array([], np.int64)]
        )
        for source in (*SOURCES, CORNERS)
    }
    one, own, common = (np.full((n, 3, 3), np.nan) for _ in range(3))
    by_source = {name: np.full(n, np.nan) for name in (*groups, MEASUREMENTS)}
    Z_smooth = _smoothed(found, looking, densities or {})
    for k in range(0, n, 1000):
        part = slice(k, min(k + 1000, n))
        Z = np.linalg.inv(found.H_xx[part])
        J = L_x[part]
        J_t = np.swapaxes(J, -1, -2)
        one[part], own[part] = J @ Z @ J_t, J @ Z_smooth[part] @ J_t
        M = L_s[part] - (J @ Z) @ found.H_xz[part]
        MP = M @ P_zz
        common[part] = MP @ np.swapaxes(M, -1, -2)
        for name, columns in groups.items():
            by_source[name][part] = np.sum(MP[:, 2][:, columns] ** 2, axis=1)
        rest = common[part][:, 2, 2] - np.sum(MP[:, 2] ** 2, axis=1)
        by_source[MEASUREMENTS][part] = np.maximum(rest, 0.0)
    lost = ~found.seen | (np.trace(one, axis1=1, axis2=2) > UNSEEN_M**2)
    for array in (one, own, common, *by_source.values()):
        array[lost] = np.nan
    return EdgePlan(T[:, :3, 3], one, own, common, by_source)


def _edge_maps(found: Looks):
    """The edge's pose, and how its place in the world moves with the state and the statics: (n, 3, b), (n, 3, p)."""
    path = found.tie.frames.path(fr.WORLD, fr.TOOL)
    children, T = fr.along(path, lambda edge: found.values.edge_pose(found.statics, edge))
    n, b = found.H_xx.shape[:2]
    T = np.broadcast_to(T, (n, 4, 4))
    L_x, L_s = np.zeros((n, 3, b)), np.zeros((n, 3, found.statics.size))
    for step, T_world_child in zip(path, children, strict=True):
        J = T[:, :3, :3] @ se3.Ad(se3.inverse(T) @ T_world_child)[:, :3]
        index = step.edge.index
        if step.edge.kind == "static":
            L_s[:, :, found.statics.columns[index]] += J @ found.statics.sensitivity(index, found.values.z)
        elif step.edge.kind == "moving":
            L_x[:, :, found.at[index]] += J
        else:
            J_turn = step.edge.ratio * J[..., 5]
            L_x[:, :, found.at[index].start] += J_turn
            clock = found.statics.clocks[index]
            if clock is not None and len(found.statics.columns[clock]):
                late = found.statics.lateness_by(clock, found.values.z, found.values.time_s)
                turned = -J_turn * found.values.rate[index][:, None]
                L_s[:, :, found.statics.columns[clock]] += turned[..., None] * late[:, None]
    return T, L_x, L_s


def _smoothed(found: Looks, looking: Looking, densities) -> np.ndarray:
    out = np.zeros_like(found.H_xx)
    for chain in found.chains:
        index = np.concatenate([np.arange(found.H_xx.shape[1])[found.at[k]] for k in chain])
        acceleration, shake = [], []
        for k in chain:
            variable = found.tie.variables[k]
            half = np.repeat(variable.motion, 3) if variable.kind == "moving" else [variable.motion[1]]
            a, v = densities.get(variable.body, (half, np.zeros(len(half))))
            acceleration.append(a)
            shake.append(v)
        H = found.H_xx[:, index[:, None], index]
        dt_s = looking.frame_s
        at: tuple[float, ...] = BETWEEN_LOOKS
        if all(found.tie.variables[k].kind == "joint" for k in chain) and not _pictured(found, chain):
            # Read by its sensor alone: so often is it looked at.
            H, dt_s, at = H / looking.readings_per_look, dt_s / looking.readings_per_look, (0.0,)
        out[:, index[:, None], index] = smoothed(
            H, dt_s, np.concatenate(acceleration), np.concatenate(shake), at
        )
    return out


def _pictured(found: Looks, chain) -> bool:
    told = [J.variables for _, J in found.groups if J.variables.keys() & set(chain)]
    return any(next(iter(by.values())).shape[1] == 8 for by in told)  # of eight residuals: a tag's corners
