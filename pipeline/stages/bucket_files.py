"""What `calibrate bucket` takes from the two files and the surveyor's, and what it puts into machine.toml."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration import curve_fit
from pipeline.calibration.belt import ToldBelt
from pipeline.calibration.touches import Rig
from pipeline.config import Machine, Site
from pipeline.config.machine import JointBody
from pipeline.config.quantities import Pose
from pipeline.errors import CalibrationError
from pipeline.geometry import so3
from pipeline.network import network_of
from pipeline.report.bucket_sheet import BucketFacts
from pipeline.stages.calibrated import pose_table, provenance
from pipeline.surface.parked import KnownPoint
from pipeline.surface.shots import Shots, order_of, read_shots

COMMAND = "gradetrace calibrate bucket"
WEAR_SIGMA_M = 0.2


def rig_of(machine: Machine, site: Site, name: str, date: datetime.date, wear: bool) -> Rig:
    """Priors of the adjustment, as the network has them; with `wear` the curve is held and the wear is free."""
    network = network_of(machine, site, date)
    sensor = next(s for s in network.sensors if s.name == name)
    curve = network.statics[sensor.curve]
    bars = None if sensor.linkage is None else network.statics[sensor.linkage]
    tool = network.statics[network.tool]
    axis_index = network.bodies[sensor.joint].static
    assert axis_index is not None
    axis = network.statics[axis_index].covariance.copy()
    bars_covariance = np.zeros((9, 9)) if bars is None else bars.covariance.copy()
    if not wear:
        # Where the axis frame's x points is what angle zero means; what is not known of it is the curve's to absorb.
        bars_covariance[7, 7] += axis[5, 5]
        axis[5, :] = axis[:, 5] = 0.0
    tool_covariance = tool.covariance.copy()
    if wear:
        tool_covariance[2, 2] += WEAR_SIGMA_M**2
    return Rig(
        axis,
        tool.value,
        tool_covariance,
        network.edge_m,
        sensor.output,
        len(curve.value),
        np.zeros(9) if bars is None else bars.value,
        bars_covariance,
        sensor.side,
        (curve.value, curve.covariance) if wear else None,
    )


def values_of(
    machine: Machine, joint: str, name: str, kept: curve_fit.Written, facts: BucketFacts
) -> dict[str, Any]:
    """Dotted keys and values for machine.toml."""
    body = machine.bodies[joint]
    assert isinstance(body, JointBody)
    by = {"by": COMMAND, "sha256": facts.log_sha256}
    source = provenance(facts.date, COMMAND, Path(facts.log), by["sha256"])
    curve = machine.sensors[name].curve
    values: dict[str, Any] = {
        f"sensors.{name}.curve": {
            "output": curve.output,
            "coefficients": kept.coefficients,
            "covariance": kept.covariance,
            "raw_range": list(kept.raw_range),
            "calibrated": {**source, "raw_range": list(kept.stroke)},
        },
        "cutting_edge.mount": {
            "xyz_m": kept.T_bucket_tool[:3, 3],
            "rpy_deg": so3.to_rpy_deg(kept.T_bucket_tool[:3, :3]),
            "covariance": kept.tool,
            "calibrated": source,
        },
        f"bodies.{joint}.axis": _without_turn(body.axis),
    }
    if machine.sensors[name].linkage is not None:
        values[f"sensors.{name}.linkage.sigma_mm"] = 0.0
        values[f"sensors.{name}.linkage.sigma_horn_angle_deg"] = 0.0
    if machine.cutting_edge.wear:
        values["cutting_edge.wear"] = None  # what was touched with were the teeth as they are now
    return values


def belt_values(machine: Machine, told: ToldBelt, stamp: dict[str, Any]) -> dict[str, Any]:
    """Dotted keys and values for machine.toml of a belt: its phase, the edge, and the bucket's zero held."""
    joint = machine.cutting_edge.body
    body = machine.bodies[joint]
    assert isinstance(body, JointBody)
    values: dict[str, Any] = {
        f"bodies.{told.joint}.axis": pose_table(told.T_parent_axis, told.axis, stamp),
        f"bodies.{joint}.axis": _without_turn(body.axis),
        "cutting_edge.mount": pose_table(told.T_bucket_tool, told.tool, stamp),
    }
    if machine.cutting_edge.wear:
        values["cutting_edge.wear"] = None
    return values


def wear_values(machine: Machine, facts: BucketFacts) -> dict[str, Any]:
    """The wear of the day of the log, with those before and after.

    Raises
    ------
    CalibrationError
        The teeth are longer than the file's mount says.
    """
    assert facts.wear_m is not None
    sigma_m = facts.wear_sigma_m
    if facts.wear_m < -2 * sigma_m:
        raise CalibrationError(
            f"the teeth reach {-1000 * facts.wear_m:.1f} mm further than cutting_edge.mount says (sigma "
            f"{1000 * sigma_m:.1f} mm), which is no wear; calibrate the bucket without --wear"
        )
    entries = [
        {"date": w.date, "wear_mm": w.wear_mm, "sigma_mm": w.sigma_mm}
        for w in machine.cutting_edge.wear
        if w.date != facts.date
    ]
    entries.append(
        {
            "date": facts.date,
            "wear_mm": round(max(1000 * facts.wear_m, 0.0), 2),
            "sigma_mm": round(1000 * sigma_m, 2),
        }
    )
    return {"cutting_edge.wear": sorted(entries, key=lambda entry: str(entry["date"]))}


def worn_m(machine: Machine, date: datetime.date) -> float:
    entries = sorted((w for w in machine.cutting_edge.wear if w.date <= date), key=lambda w: w.date)
    return entries[-1].wear_mm / 1000 if entries else 0.0


def _without_turn(axis: Pose) -> dict[str, Any]:
    """The same axis, exact about its own z."""
    same: dict[str, Any] = {"xyz_m": list(axis.xyz_m), "rpy_deg": list(axis.rpy_deg)}
    if axis.covariance is not None:
        covariance = np.array(axis.covariance)
        covariance[5, :] = covariance[:, 5] = 0.0
        same["covariance"] = covariance
    else:
        assert axis.sigma_mm is not None and axis.sigma_deg is not None
        sigma = np.broadcast_to(axis.sigma_deg, 3)
        same["sigma_mm"] = (
            list(axis.sigma_mm) if isinstance(axis.sigma_mm, Sequence) else float(axis.sigma_mm)
        )
        same["sigma_deg"] = [float(sigma[0]), float(sigma[1]), 0.0]
    if axis.calibrated is not None:
        same["calibrated"] = axis.calibrated.model_dump(mode="python", exclude_defaults=True)
    return same


def points_of(
    checks_file: Path | None, point_text: str | None, site: Site
) -> tuple[Shots, dict[str, KnownPoint]]:
    """Rows of the file, and known points of site.toml; those of one point where the option names it.

    Raises
    ------
    CalibrationError
        The option names no point, or no row is a touch.
    """
    scale = site.grid.metres_per_unit
    checks = site.checks
    sigma_m = (2.0 if checks is None else checks.sigma_mm) / 1000
    known = {
        key: KnownPoint(np.array(point.enh) * scale, point.sigma_mm / 1000)
        for key, point in (checks.control.items() if checks is not None else ())
    }
    shots = Shots(np.zeros(0, object), np.zeros(0, object), np.zeros((0, 3)))
    if checks_file is not None:
        shots = read_shots(
            checks_file,
            "named" if checks is None else order_of(checks_file, checks.order),
            scale,
            site.report.time_zone,
            None if checks is None else checks.codes,
        )
    if point_text is not None:
        shots, known = _of_one_point(point_text, shots, known, scale, sigma_m)
    elif len(shots) and not np.isin(shots.kind.astype(str), ("control", "edge")).any():
        raise CalibrationError(
            f"no row of {checks_file.name if checks_file else 'the file'} is said to be a touch or a shot of the edge: "
            "add a column kind with control or edge, or name the point that was touched with --point ID"
        )
    if not len(shots) and not known:
        raise CalibrationError(
            "no point is known that the edge touched: give a check file, --point E,N,H, or [checks.control] in "
            "site.toml"
        )
    return shots, known


def _of_one_point(
    text: str, shots: Shots, known: dict[str, KnownPoint], scale: float, sigma_m: float
) -> tuple[Shots, dict[str, KnownPoint]]:
    """What `--point` leaves: touches of that point, whatever their rows say they are, and shots of the edge."""
    kinds, names = shots.kind.astype(str), shots.point.astype(str)
    if text.count(",") == 2:
        try:
            enh = np.array([float(part) for part in text.split(",")])
        except ValueError:
            enh = np.full(3, np.nan)
        if not np.isfinite(enh).all():
            raise CalibrationError(f"--point {text}: write E,N,H as three numbers")
        touched = sorted(set(names[kinds == "control"]))
        if len(touched) > 1:
            raise CalibrationError(
                f"--point {text}: the file has touches of several points ({', '.join(touched[:5])}); name one by its id"
            )
        return shots, {touched[0] if touched else "point": KnownPoint(enh * scale, sigma_m)}
    rows = np.flatnonzero(names == text)
    if text not in known and not len(rows):
        raise CalibrationError(
            f"--point {text}: no such point among the known points of site.toml, and no such row in "
            f"the file; give E,N,H in the grid unit, or one of {', '.join(sorted({*known, *names})[:9]) or 'none'}"
        )
    if text in known:
        point = known[text]
    else:
        sigma = float(shots.sigma_m[rows[0]])
        point = KnownPoint(shots.p_grid[rows[0]], sigma if np.isfinite(sigma) else sigma_m)
    kind = shots.kind.copy()
    kind[rows] = "control"
    return replace(shots, kind=kind).take((names == text) | (kinds == "edge")), {text: point}
