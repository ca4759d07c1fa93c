"""What really happened: path of the cutting edge, the floor it left, and what the statics are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import se3
from pipeline.synthetic.cycle import Motion, bucket_pose
from pipeline.synthetic.draws import Uncertainty
from pipeline.synthetic.excavator import Mounts
from pipeline.synthetic.specification import Specification

POINTS = ("left", "middle", "right")
SWEEP_HZ = 1000
RAMP_M = 0.12  # above the floor that was wanted, the edge is on its way in or out and has not dug it


@dataclass(frozen=True)
class Floor:
    """The floor that the edge left, cell by cell."""

    station: np.ndarray
    """(n,) cell centres along the alignment, metres."""
    offset: np.ndarray
    """(m,) cell centres across it, left positive, metres."""
    z: np.ndarray
    """(n, m) lowest height of the edge at each cell's centre, world metres; nan where it never was."""
    finished_s: np.ndarray
    """(n, m) when that was, seconds."""


def edge_points(spec: Specification, mounts: Mounts, motion: Motion, t: np.ndarray) -> np.ndarray:
    """(n, 3, 3) world points left, middle, right of the true cutting edge at times (n,), seconds."""
    p = motion.poses(t)
    T_world_tool = bucket_pose(p.stick(spec), mounts.axis, p.joint_rad()) @ mounts.tool
    half = 0.5 * spec.arm.width_m
    points = np.array([[-half, 0, 0], [0, 0, 0], [half, 0, 0]])
    return se3.transform(T_world_tool[:, None], points)


def dug_floor(
    spec: Specification, mounts: Mounts, motion: Motion, cell_m: float, before_s: float | None = None
) -> Floor:
    """Lower envelope of the edge's sweep over the cells of the design floor.

    The height is taken where the edge crosses the centre of a cell, interpolated along the edge and between two
    instants a millisecond apart; so a slope inside a cell does no harm.
    """
    place = motion.place
    end = motion.duration_s if before_s is None else before_s
    first = np.floor((spec.first_station - 1.0) / cell_m + 1e-6)
    last = np.ceil((spec.first_station + spec.cycles * spec.step_m + spec.sweep_m + 1.0) / cell_m)
    station = (np.arange(first, last) + 0.5) * cell_m
    across = round(spec.arm.width_m / cell_m)
    offset = (np.arange(across) - 0.5 * (across - 1)) * cell_m
    z = np.full((len(station), across), np.nan)
    when = np.full_like(z, np.nan)
    for sweep in motion.sweeps:
        t = np.arange(sweep.start_s - 0.2, min(sweep.start_s + 7.0, end), 1 / SWEEP_HZ)
        if len(t) < 2:
            continue
        points = edge_points(spec, mounts, motion, t)
        s, o = place.station_offset(points[:, [0, 2]])
        height = points[:, [0, 2], 2]
        for column, wanted in enumerate(offset):
            f = (wanted - o[:, 0]) / (o[:, 1] - o[:, 0])
            along = s[:, 0] + f * (s[:, 1] - s[:, 0])
            level = height[:, 0] + f * (height[:, 1] - height[:, 0])
            good = (f >= 0) & (f <= 1) & (level < motion.floor(along) + RAMP_M)
            cell = (along - station[0]) / cell_m
            step = np.flatnonzero(good[:-1] & good[1:] & (np.floor(cell[:-1]) != np.floor(cell[1:])))
            row = np.maximum(np.floor(cell[step]), np.floor(cell[step + 1])).astype(int)
            share = (row - cell[step]) / (cell[step + 1] - cell[step])
            crossing = level[step] + share * (level[step + 1] - level[step])
            instant = t[step] + share * (t[step + 1] - t[step])
            inside = (row >= 0) & (row < len(station))
            for r, c, i in zip(row[inside], crossing[inside], instant[inside]):
                if not z[r, column] <= c:
                    z[r, column], when[r, column] = c, i
    return Floor(station, offset, z, when)


def station_truth(spec: Specification, floor: Floor, step_m: float) -> dict[str, np.ndarray]:
    """Mean true floor of each station: columns of truth/stations.parquet, grid metres.

    A station is a whole multiple of the step and stands for the piece of the alignment half a step to either side.
    """
    from pipeline.synthetic.files import METRES_PER_UNIT

    height = spec.origin[2] * METRES_PER_UNIT[spec.unit]
    index = np.floor(floor.station / step_m + 0.5 + 1e-9).astype(int)
    rows: dict[str, list] = {"station": [], "h": [], "state": [], "cells_cut": [], "cells_floor": []}
    for i in np.unique(index):
        cells = floor.z[index == i]
        cut = np.isfinite(cells)
        rows["station"].append(round(i * step_m, 6))
        rows["h"].append(float(cells[cut].mean() + height) if cut.any() else np.nan)
        rows["state"].append("cut" if cut.all() else "partly cut" if cut.any() else "not reached")
        rows["cells_cut"].append(int(cut.sum()))
        rows["cells_floor"].append(cells.size)
    return {key: np.array(value, dtype=object if key == "state" else None) for key, value in rows.items()}


def statics_truth(spec: Specification, truth: Mounts, files: Mounts, sigma: Uncertainty) -> dict[str, object]:
    """The statics as they are, and how far off the files are in their own sigmas; for truth/statics.json."""

    def pose(T: np.ndarray, T_file: np.ndarray, sigma_xi: np.ndarray) -> dict[str, object]:
        return {"T": T.tolist(), "z": (se3.local(T_file, T) / sigma_xi).tolist()}

    def vector(v: np.ndarray, v_file: np.ndarray, sigma_v: np.ndarray) -> dict[str, object]:
        z = np.divide(v - v_file, sigma_v, out=np.zeros_like(v), where=sigma_v > 0)
        return {"value": v.tolist(), "z": z.tolist()}

    return {
        "cameras": {n: pose(T, files.cameras[n], sigma.camera) for n, T in truth.cameras.items()},
        "intrinsics": {
            n: vector(v, files.intrinsics[n], sigma.intrinsics) for n, v in truth.intrinsics.items()
        },
        "benchmarks": {n: pose(T, files.benchmarks[n], sigma.benchmark) for n, T in truth.benchmarks.items()},
        "stick_marker": pose(truth.stick_marker, files.stick_marker, sigma.stick_marker),
        "axis": pose(truth.axis, files.axis, sigma.axis),
        "tool": pose(truth.tool, files.tool, sigma.tool),
        "linkage": vector(truth.linkage, files.linkage, sigma.linkage),
        "curves": {n: vector(v, files.curves[n], sigma.curves[n]) for n, v in truth.curves.items()},
        "time_offsets_s": dict(truth.time_offsets),
    }
