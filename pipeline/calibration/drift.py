"""How calibrated quantities moved from one dated machine file to the next: in sigmas, and millimetres at the edge."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.config import Machine
from pipeline.config.machine import JointBody, StaticBody
from pipeline.config.quantities import Calibrated, Pose
from pipeline.geometry import se3


@dataclass(frozen=True, eq=False)
class Quantity:
    """One calibrated quantity of one machine file."""

    key: str
    is_pose: bool
    value: np.ndarray
    """(4, 4) pose or (n,) vector."""
    covariance: np.ndarray
    calibrated: Calibrated | None
    focal_px: float = float("nan")
    """Of a lens."""


@dataclass(frozen=True, eq=False)
class Change:
    """A quantity in one file against the one before it."""

    key: str
    date: datetime.date | None
    by: str
    sigmas: float | None
    """Length of the change over its standard deviation, per component; None in the first file."""
    edge_mm: float | None
    """What the change moves at the cutting edge; None where that is not geometry of a pose or a lens."""
    age_days: int | None
    """Until the day of asking."""


def quantities(machine: Machine) -> Iterator[Quantity]:
    """The calibrated quantities of a machine file, in its order."""

    def pose(key: str, item: Pose | None) -> Iterator[Quantity]:
        if item is not None:
            yield Quantity(key, True, item.transform(), item.covariance_xi(), item.calibrated)

    for name, body in machine.bodies.items():
        if isinstance(body, JointBody):
            yield from pose(f"bodies.{name}.axis", body.axis)
        elif isinstance(body, StaticBody):
            yield from pose(f"bodies.{name}.pose", body.pose)
    for name, camera in machine.cameras.items():
        yield from pose(f"cameras.{name}.mount", camera.mount)
        lens = camera.intrinsics
        if lens is not None:
            yield Quantity(
                f"cameras.{name}.intrinsics",
                False,
                lens.vector(),
                lens.covariance_matrix(),
                lens.calibrated,
                lens.fx,
            )
    for name, marker in machine.markers.items():
        yield from pose(f"markers.{name}.mount", marker.mount)
    for name, sensor in machine.sensors.items():
        curve = sensor.curve
        yield Quantity(
            f"sensors.{name}.curve",
            False,
            np.array(curve.coefficients),
            curve.covariance_matrix(),
            curve.calibrated,
        )
        if (bars := sensor.linkage) is not None:
            values = np.array(
                [*bars.cylinder_anchor_m, *bars.rocker_pivot_m, bars.rocker_m, bars.coupler_m, bars.horn_m,
                 np.deg2rad(bars.horn_angle_deg)]
            )  # fmt: skip
            sigma = np.append(np.full(7, bars.sigma_mm / 1000), np.deg2rad(bars.sigma_horn_angle_deg))
            yield Quantity(f"sensors.{name}.linkage", False, values, np.diag(sigma**2), bars.calibrated)
    yield from pose("cutting_edge.mount", machine.cutting_edge.mount)


def history(machines: Sequence[Machine], today: datetime.date, distance_m: float) -> dict[str, list[Change]]:
    """Every quantity through dated files, oldest first.

    Parameters
    ----------
    machines : sequence of Machine
        Oldest first.
    today : datetime.date
        Against which ages are counted.
    distance_m : float
        From the quantity to the cutting edge; the pin of the body with the edge, and the edge itself, know better.

    Returns
    -------
    dict of str to list of Change
        By key; a file in which a quantity is as before adds nothing.
    """
    found: dict[str, list[Change]] = {}
    last: dict[str, Quantity] = {}
    for machine in machines:
        for now in quantities(machine):
            before = last.get(now.key)
            if before is not None and _same(before, now):
                continue
            lever_m = _lever_m(machine, now.key, distance_m)
            sigmas, edge_mm = (None, None) if before is None else _moved(before, now, lever_m)
            date = now.calibrated.date if now.calibrated else None
            by = now.calibrated.by if now.calibrated else ""
            age = None if date is None else (today - date).days
            found.setdefault(now.key, []).append(Change(now.key, date, by, sigmas, edge_mm, age))
            last[now.key] = now
    return found


def _lever_m(machine: Machine, key: str, distance_m: float) -> float:
    edge = machine.cutting_edge
    if key == "cutting_edge.mount":
        return 0.5 * edge.width_m
    if key == f"bodies.{edge.body}.axis":
        return float(np.linalg.norm(edge.mount.xyz_m))
    return distance_m


def _same(before: Quantity, now: Quantity) -> bool:
    return before.value.shape == now.value.shape and bool(np.allclose(before.value, now.value, rtol=0, atol=1e-9)) and (
        before.calibrated == now.calibrated
    )  # fmt: skip


def _moved(before: Quantity, now: Quantity, distance_m: float) -> tuple[float | None, float | None]:
    if before.value.shape != now.value.shape:
        return None, None
    change = se3.local(before.value, now.value) if now.is_pose else now.value - before.value
    # Two calibrations are two independent measurements of what should be one thing.
    covariance = before.covariance + now.covariance
    sigma = np.sqrt(np.diagonal(covariance))
    unit = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    told = values > 1e-12
    if not np.any(told):
        return None, _edge_mm(before, change, distance_m)
    length = (vectors[:, told].T @ (change / unit)) ** 2 / values[told]
    return float(np.sqrt(np.sum(length) / np.sum(told))), _edge_mm(before, change, distance_m)


def _edge_mm(before: Quantity, change: np.ndarray, distance_m: float) -> float | None:
    if before.is_pose:
        # In whichever direction the edge lies: the turn counts with its whole lever.
        return 1000 * float(np.linalg.norm(change[:3]) + distance_m * np.linalg.norm(change[3:]))
    if np.isfinite(before.focal_px):
        # The principal point turns the ray, the focal length stretches what is a third of it off the axis.
        turned = (
            np.hypot(change[2], change[3]) / before.focal_px + np.abs(change[:2]).max() / before.focal_px / 3
        )
        return 1000 * distance_m * float(turned)
    return None
