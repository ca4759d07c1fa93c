"""Poses of printed markers from surveyed corner points, and what is wrong with a survey that does not fit its print.

Three corners give a pose, every further coordinate checks it: three times the corners less six. Where the check fails
the fault is looked for among those that happen: two corners exchanged, all of them named in another order, one
coordinate typed wrong, another size of print.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
import scipy.stats

from pipeline.errors import CalibrationError
from pipeline.geometry import se3, so3

CHANCE = 1e-3
"""A survey that fits worse than chance allows in one of a thousand is faulty."""
CORNER_NAMES = ("TL", "TR", "BR", "BL")
STEPS = 10
MOST_ORDERED = 6
"""Of so many corners every order is tried; of more, every exchange of two."""
UPRIGHT = 0.3
"""A print hangs upright: the height of its up axis, of 1, below which that is not so. Boards lying flat have none."""


@dataclass(frozen=True, eq=False)
class SurveyedMarker:
    """A marker whose corners were shot."""

    name: str
    corners: tuple[str, ...]
    """Names of the corners, as messages call them."""
    p_marker: np.ndarray
    """(n, 3) on the print, metres."""
    p_world: np.ndarray
    """(n, 3) as shot, metres."""
    sigma_m: np.ndarray
    """(n,) of each coordinate."""
    faces: np.ndarray | None = None
    """(3,) a world point before the print: the total station, or where the machine works."""


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """What a survey tells of a marker."""

    name: str
    T_world_marker: np.ndarray
    """(4, 4)."""
    covariance: np.ndarray
    """(6, 6) of ``xi``, m and rad; of the instrument's sigma, scaled by nothing."""
    residual: np.ndarray
    """(n, 3) shot minus fitted, in the marker's axes, metres."""
    chi_square: float
    redundancy: int
    scale: float
    """Size of the print in the survey over its size in the file."""
    sigma_scale: float

    @property
    def out_of_plane_m(self) -> float:
        """Root mean square of the residuals along the print's normal."""
        return float(np.sqrt(np.mean(self.residual[:, 2] ** 2)))

    @property
    def in_plane_m(self) -> float:
        return float(np.sqrt(np.mean(self.residual[:, :2] ** 2)))


def marker_pose(marker: SurveyedMarker) -> MarkerPose:
    """The pose that fits a marker's corners best.

    Raises
    ------
    CalibrationError
        Fewer than three corners, or on one line; corners exchanged or mirrored; one far off; another size.
    """
    if len(marker.p_marker) < 3:
        raise CalibrationError(
            f"marker '{marker.name}': {len(marker.p_marker)} of its corners were shot, at least three are needed"
        )
    found = _fit(marker, np.arange(len(marker.p_marker)))
    if found is None:
        raise CalibrationError(
            f"marker '{marker.name}': the corners that were shot lie on one line, which leaves it free to turn about "
            "that line; shoot one off the line"
        )
    limit = _limit(found.redundancy)
    if found.chi_square > limit:
        raise CalibrationError(_fault(marker, found))
    if _faces_away(marker, found.T_world_marker):
        orders = _best_orders(marker)
        meant = f"; with {_listed(marker, orders[0])} they fit a print that can be seen" if orders else ""
        raise CalibrationError(
            f"marker '{marker.name}': its print would face away from where it is looked at, as if its corners were "
            f"named in mirrored order, or seen from behind{meant}; or northing and easting are exchanged (see --order)"
        )
    return found


def _limit(redundancy: int) -> float:
    return float(scipy.stats.chi2.isf(CHANCE, redundancy))


def _fit(marker: SurveyedMarker, order: np.ndarray, rows: np.ndarray | None = None) -> MarkerPose | None:
    """Weighted least squares with the shots taken in some order; None for points on a line."""
    keep = np.arange(len(order)) if rows is None else rows
    p, q, sigma = marker.p_marker[keep], marker.p_world[order][keep], marker.sigma_m[order][keep]
    spread = np.linalg.svd(p - p.mean(0), compute_uv=False)
    if spread[1] < 1e-9 * max(spread[0], 1e-12):
        return None
    T = _start(p, q)
    weight = np.repeat(1 / sigma**2, 3)
    for _ in range(STEPS):
        J = _jacobian(T, p)
        r = (q - se3.transform(T, p)).reshape(-1)
        step = np.linalg.solve(J.T @ (weight[:, None] * J), J.T @ (weight * r))
        T = se3.retract(T, step)
        if np.abs(step).max() < 1e-12:
            break
    J = _jacobian(T, p)
    covariance = np.linalg.inv(J.T @ (weight[:, None] * J))
    residual = (q - se3.transform(T, p)) @ T[:3, :3]
    # The size of the print is the one thing besides the pose that all corners can agree on being wrong.
    ray = ((p - p.mean(0)) @ T[:3, :3].T).reshape(-1)
    N = ray @ (weight * ray) - (ray * weight) @ J @ covariance @ J.T @ (weight * ray)
    grown = float(ray @ (weight * (residual @ T[:3, :3].T).reshape(-1)) / N)
    return MarkerPose(
        marker.name,
        T,
        covariance,
        residual,
        float(np.sum(residual**2 / sigma[:, None] ** 2)),
        3 * len(p) - 6,
        1 + grown,
        float(N**-0.5),
    )


def _start(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The unweighted optimum (Kabsch); shots in a wrong order may leave it open, and any of its answers will do."""
    U, _, Vt = np.linalg.svd((q - q.mean(0)).T @ (p - p.mean(0)))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return se3.from_rotation_translation(R, q.mean(0) - R @ p.mean(0))


def _jacobian(T: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(3n, 6) world points by ``xi``."""
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -so3.hat(p)], axis=-1)
    return (T[:3, :3] @ J).reshape(-1, 6)


def _faces_away(marker: SurveyedMarker, T: np.ndarray) -> bool:
    return marker.faces is not None and bool(T[:3, 2] @ (marker.faces - T[:3, 3]) < 0)


def _orders(count: int) -> list[np.ndarray]:
    """Orders in which corners may have been meant: all of them, or exchanges of two and the reverse."""
    if count <= MOST_ORDERED:
        return [np.array(order) for order in permutations(range(count))]
    orders = [np.arange(count)[::-1]]
    for a in range(count):
        for b in range(a):
            order = np.arange(count)
            order[[a, b]] = order[[b, a]]
            orders.append(order)
    return orders


def _best_orders(marker: SurveyedMarker) -> list[np.ndarray]:
    """Orders of the shots that fit the print, seen from before and upright, with fewest corners renamed.

    A square print leaves two of them where nobody says from where it is seen: its left side named wrong, or its right.
    """
    named = np.arange(len(marker.p_marker))
    ranked = []
    for order in _orders(len(named)):
        fit = _fit(marker, order)
        if fit is None or fit.chi_square > _limit(fit.redundancy) or _faces_away(marker, fit.T_world_marker):
            continue
        lying = abs(fit.T_world_marker[2, 2]) > 1 - UPRIGHT
        hangs = lying or fit.T_world_marker[2, 1] > UPRIGHT
        ranked.append((not hangs, int(np.sum(order != named)), fit.chi_square, order))
    best = min((entry[:2] for entry in ranked), default=None)
    return [entry[3] for entry in ranked if entry[:2] == best]


def _listed(marker: SurveyedMarker, order: Sequence[int] | np.ndarray) -> str:
    """``101 is TR, 102 is TL``, of those that are renamed."""
    return ", ".join(
        f"{marker.corners[shot]} is {marker.corners[k]}" for k, shot in enumerate(order) if k != shot
    )


def _fault(marker: SurveyedMarker, found: MarkerPose) -> str:
    """What is most likely wrong, in a sentence."""
    named = np.arange(len(marker.p_marker))
    worst_mm = 1000 * float(np.linalg.norm(found.residual, axis=1).max())
    off = f"marker '{marker.name}': its corners do not fit its print, the worst is {worst_mm:.0f} mm off"
    orders = [order for order in _best_orders(marker) if np.any(order != named)]
    if orders:
        renamed = [np.flatnonzero(order != named) for order in orders]
        if len(renamed[0]) == 2:
            pairs = " or ".join(f"{marker.corners[a]} and {marker.corners[b]}" for a, b in renamed)
            which = (
                ""
                if len(orders) == 1
                else "; say with --station from where it was shot, and one of them remains"
            )
            listed = " or ".join(_listed(marker, order) for order in orders)
            return f"{off}; corners {pairs} are exchanged: with {listed} they fit{which}"
        return f"{off}; they fit in another order: {_listed(marker, orders[0])}"
    if len(named) > 3:
        alone = []
        for k in named:
            rows = np.delete(named, k)
            fit = _fit(marker, named, rows)
            if fit is not None and fit.chi_square <= _limit(fit.redundancy):
                alone.append((fit.chi_square, k, fit))
        if alone:
            _, k, fit = min(alone, key=lambda entry: entry[:2])
            d = marker.p_world[k] - se3.transform(fit.T_world_marker, marker.p_marker[k])
            axis = int(np.argmax(np.abs(d)))
            which = ("easting", "northing", "elevation")[axis]
            return (
                f"marker '{marker.name}': corner {marker.corners[k]} lies {1000 * np.linalg.norm(d):.0f} mm from where "
                f"the others place it, its {which} {1000 * d[axis]:+.0f} mm off: a typing error or a bad shot; mend "
                "it, or leave it out"
            )
    if abs(found.scale - 1) > 4 * found.sigma_scale:
        sizes = _fit_scaled(marker, found)
        if sizes <= _limit(max(found.redundancy - 1, 1)):
            return (
                f"marker '{marker.name}': its corners lie {100 * (found.scale - 1):+.2f} % further apart than its "
                "print is large; check size_m, x_m and y_m of its tags in site.toml, and the unit of the file"
            )
    return (
        f"{off} (sigma {1000 * float(np.median(marker.sigma_m)):g} mm); no order of the corners and no single one of "
        "them explains it: check the print in site.toml, the unit, and shoot it again"
    )


def _fit_scaled(marker: SurveyedMarker, found: MarkerPose) -> float:
    """Chi-square with a print of the size that fits."""
    scaled = SurveyedMarker(
        marker.name, marker.corners, marker.p_marker * found.scale, marker.p_world, marker.sigma_m
    )
    fit = _fit(scaled, np.arange(len(marker.p_marker)))
    return np.inf if fit is None else fit.chi_square


def datum_sigma_m(poses: Sequence[MarkerPose], ahead_m: float) -> float:
    """Standard deviation, in its worst direction, of a point that all markers together carry into the grid.

    Each marker pins the site's frame with its own covariance; independent as they are, their information adds up. The
    point lies ahead of the middle of the markers, along their mean normal.
    """
    centre = np.mean([pose.T_world_marker[:3, 3] for pose in poses], axis=0)
    normal = np.mean([pose.T_world_marker[:3, 2] for pose in poses], axis=0)
    length = np.linalg.norm(normal)
    point = centre + ahead_m * (normal / length if length > 0.1 else np.array([0.0, 0.0, 0.0]))
    T_world_point = se3.from_rotation_translation(np.eye(3), point)
    information = np.zeros((6, 6))
    for pose in poses:
        A = se3.Ad(se3.inverse(pose.T_world_marker) @ T_world_point)
        information += A.T @ np.linalg.solve(pose.covariance, A)
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information)[:3, :3])[-1]))
