"""Which tags a camera will see from where, and how well: field of view, size, angle, and what stands in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import camera as camera_model
from pipeline.geometry import se3
from pipeline.network.model import Network
from pipeline.planning.postures import Arm, surveyed

SEEN, OUTSIDE, TURNED_AWAY, TOO_SMALL, HIDDEN = range(5)
REASONS = ("seen", "outside the picture", "turned away", "too small", "hidden by the arm")


@dataclass(frozen=True)
class CornerNoise:
    """Sigma of a corner: ``at_40_px * (40 / side)^power``, isotropic, px; side is the root of the tag's area in px².

    The Cramer-Rao bound of a known print falls about so: information grows with the length of its edges, and cells
    narrower than the blur lose some. The values are the medians of what the detector states in rendered logs (blur 0.6
    to 1 px, JPEG 85). ``--log`` takes those of the log.
    """

    at_40_px: float = 0.020
    power: float = 0.9
    least_px: float = 0.002

    def sigma(self, side_px):
        """(...,) px."""
        side_px = np.maximum(np.asarray(side_px, float), 1e-3)
        return np.maximum(self.at_40_px * (40.0 / side_px) ** self.power, self.least_px)


def fitted_noise(side_px, sigma_px) -> CornerNoise:
    """The noise model that stated sigmas tell, by least squares of the logarithms; (n,) each."""
    x, y = np.log(40.0 / np.asarray(side_px)), np.log(np.asarray(sigma_px))
    power = float(np.polyfit(x, y, 1)[0]) if np.ptp(x) > np.log(2.0) else CornerNoise().power
    return CornerNoise(float(np.exp(np.mean(y - power * x))), power)


@dataclass(frozen=True)
class SightRules:
    """When a tag counts as seen."""

    least_px: float = 20.0
    """Side, the root of its area. The detector reads smaller ones, yet one in ten is lost at 14 px."""
    steepest_deg: float = 75.0
    """Between the line of sight and the normal of the print. Beyond, a cell is narrower than a pixel's blur."""
    margin_px: float = 4.0
    """Of the picture's border: a corner needs what is around it."""
    arm_radius_m: float = 0.25
    """Boom and stick as round rods."""
    furthest_m: float = 60.0


@dataclass(frozen=True, eq=False)
class Sight:
    """What every camera sees of every tag, (n, C, M) unless said."""

    reason: np.ndarray
    """Index into ``REASONS``."""
    uv: np.ndarray
    """(n, C, M, 4, 2) px; nan behind the camera."""
    side_px: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Bool."""
        return self.reason == SEEN


def sight(network: Network, T_world, rules: SightRules, arm: Arm | None = None, arm_bodies=("", "")) -> Sight:
    """Who sees what.

    Parameters
    ----------
    network : Network
        Of cameras and tags.
    T_world : dict of str to (n, 4, 4) array
        Of ``world_poses``.
    rules : SightRules
        What counts as seen.
    arm : Arm, optional
        Hides what lies behind boom and stick; without it nothing is hidden.
    arm_bodies : two of str
        The cab and the stick. A marker on the stick is not hidden by the stick.
    """
    n, C, M = len(T_world["world"]), len(network.cameras), len(network.tag_marker)
    reason = np.zeros((n, C, M), np.int8)
    uv = np.full((n, C, M, 4, 2), np.nan)
    side = np.zeros((n, C, M))
    T_marker = [T_world[m.body] @ surveyed(network, m.mount) for m in network.markers]
    rods = None if arm is None else _rods(arm, T_world, arm_bodies)
    for c, camera in enumerate(network.cameras):
        T_world_camera = T_world[camera.body] @ surveyed(network, camera.mount)
        intrinsics = network.statics[camera.intrinsics].value
        widest = float(np.min(camera_model.fold_radius(intrinsics)))
        T_camera = [se3.inverse(T_world_camera) @ T for T in T_marker]
        for t in range(M):
            k = int(network.tag_marker[t])
            T = T_camera[k]
            p = np.einsum("nij,kj->nki", T[:, :3, :3], network.tag_corners[t]) + T[:, None, :3, 3]
            xy = p[..., :2] / np.where(p[..., 2:] > 1e-6, p[..., 2:], np.nan)
            with np.errstate(invalid="ignore"):
                inside = np.hypot(xy[..., 0], xy[..., 1]) < widest
            pixels = camera_model.project(np.where(inside[..., None], p, np.nan), intrinsics)
            uv[:, c, t] = pixels
            low, high = rules.margin_px, np.array([camera.width, camera.height]) - 1 - rules.margin_px
            with np.errstate(invalid="ignore"):
                within = np.all((pixels > low) & (pixels < high), axis=(-1, -2))
            middle = p.mean(axis=1)
            far = np.linalg.norm(middle, axis=-1)
            cosine = -np.einsum("ni,ni->n", T[:, :3, 2], middle) / far
            side[:, c, t] = np.where(within, np.sqrt(_area(pixels)), 0.0)
            why = np.full(n, SEEN, np.int8)
            why[(side[:, c, t] < rules.least_px) | (far > rules.furthest_m)] = TOO_SMALL
            why[cosine < np.cos(np.deg2rad(rules.steepest_deg))] = TURNED_AWAY
            why[~within] = OUTSIDE
            if rods is not None:
                corners = se3.transform(T_marker[k][:, None], network.tag_corners[t][None])
                rows = np.flatnonzero(why == SEEN)
                eye = T_world_camera[rows, :3, 3]
                on_stick = network.markers[k].body == arm_bodies[1]
                for a, b in rods[:1] if on_stick else rods:
                    near = _between(
                        eye[:, None], corners[rows], a[rows][:, None], b[rows][:, None], rules.arm_radius_m
                    )
                    why[rows[np.any(near, axis=1)]] = HIDDEN
            reason[:, c, t] = why
    return Sight(reason, uv, side)


def _area(uv):
    """(n,) px² of quadrilaterals (n, 4, 2)."""
    x, y = uv[..., 0], uv[..., 1]
    return 0.5 * np.abs(np.sum(x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1), axis=-1))


def _rods(arm: Arm, T_world, arm_bodies):
    """Ends of boom and stick in the world, (n, 3) each."""
    cab, stick = arm_bodies
    foot = se3.transform(T_world[cab], np.array([arm.foot_x, arm.foot_y, arm.foot_z]))
    knee = T_world[stick][:, :3, 3]
    end = se3.transform(T_world[stick], np.array([arm.stick, 0.0, 0.0]))
    return [(foot, knee), (knee, end)]


def _between(eye, target, a, b, radius_m: float):
    """Whether a rod from a to b comes within a radius of the line of sight; (..., 3) each -> (...,).

    Least distance of two segments, clamped one after the other (Ericson, Real-Time Collision Detection, 5.1.9).
    """
    d, e, r = target - eye, b - a, eye - a
    dd, ee, de = np.sum(d * d, -1), np.sum(e * e, -1), np.sum(d * e, -1)
    dr, er = np.sum(d * r, -1), np.sum(e * r, -1)
    det = dd * ee - de * de
    s = np.clip((de * er - dr * ee) / np.where(det > 1e-12, det, 1.0), 0.0, 1.0)
    t = np.clip((de * s + er) / np.maximum(ee, 1e-12), 0.0, 1.0)
    s = np.clip((de * t - dr) / np.maximum(dd, 1e-12), 0.0, 1.0)
    gap = r + s[..., None] * d - t[..., None] * e
    return np.linalg.norm(gap, axis=-1) < radius_m
