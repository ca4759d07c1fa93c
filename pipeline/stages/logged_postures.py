"""What a run folder tells for planning: how the machine stood, how often was looked, how well corners were found."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import tables
from pipeline.config import Machine, Site
from pipeline.errors import ArtefactError
from pipeline.estimation.repeated import Repeated
from pipeline.geometry import se3
from pipeline.network.model import Network
from pipeline.planning.looks import Looking
from pipeline.planning.postures import Postures
from pipeline.planning.sight import fitted_noise
from pipeline.runs import RunFolder
from pipeline.stages.job import table_file

SAID = (
    "{run} is not the run folder of a finished log ({what} is missing); give one such as runs/shift, after "
    "'gradetrace report' has made its page"
)


@dataclass(frozen=True, eq=False)
class LoggedRun:
    """One log, as planning needs it."""

    name: str
    postures: Postures
    """At the frames of the first camera at which the edge was observed."""
    time_ns: np.ndarray
    looking: Looking
    densities: dict[str, tuple]
    looks: float
    reported_own: float
    """Median sigma of the edge's elevation over observed epochs as the report has it, m; own part and whole."""
    reported: float
    solution: dict[str, Any]


def with_lenses_of(run: Path, machine: Machine, source: str) -> Machine:
    """The machine with the intrinsics that stand in the log, where its file has none."""
    return machine.with_calibrations(_json(run, "log.json").get("calibrations", {}), source)


def read_run(run: Path, network: Network, site: Site) -> LoggedRun:
    """A run folder.

    Raises
    ------
    ArtefactError
        It is not one, or of another machine.
    """
    solution = _json(run, "solution.json")
    table = _table(run, "poses")
    moving = [n for n, b in network.bodies.items() if b.kind == "moving"]
    joints = [n for n, b in network.bodies.items() if b.kind == "joint" and b.follows is None]
    present = set(np.unique(table["body"].astype(str)))
    if missing := [n for n in (*moving, *joints, "tool") if n not in present]:
        raise ArtefactError(f"{run} has no poses of '{missing[0]}'; it is the run of another machine.toml")
    rows = {name: np.flatnonzero(table["body"] == name) for name in (*moving, *joints, "tool")}
    time_ns = np.unique(table["time_ns"][rows["tool"]])
    for name in (*moving, *joints):
        time_ns = np.intersect1d(time_ns, table["time_ns"][rows[name]])
    at = {name: r[np.searchsorted(table["time_ns"][r], time_ns)] for name, r in rows.items()}
    seen = table["seen"][at["tool"]].astype(bool)
    origin = site.grid.to_grid_metres(np.zeros(3))
    T = {
        name: _poses(
            np.column_stack([table[c][at[name]] for c in ("e", "n", "h")]) - origin,
            np.column_stack([table[c][at[name]] for c in ("qx", "qy", "qz", "qw")]),
        )
        for name in moving
    }
    angle = {name: np.unwrap(table["angle_rad"][at[name]]) for name in joints}
    seconds = (time_ns - time_ns[0]) * 1e-9
    rate = {name: np.gradient(a, seconds) for name, a in angle.items()}
    frames = _table(run, "frames")
    stamps = np.sort(frames["time_ns"][frames["camera"] == network.cameras[0].name])
    # The epoch nearest to each picture, where the edge was observed.
    near = np.clip(np.searchsorted(time_ns, stamps), 0, len(time_ns) - 1)
    chosen = np.unique(near[np.abs(time_ns[near] - stamps) < 2e7])
    chosen = chosen[seen[chosen]]
    if len(chosen) < 10:
        raise ArtefactError(f"the cutting edge was hardly ever observed in {run}; plan with another run")
    total = np.sqrt(table["cov_h_h"][at["tool"]])
    own = np.sqrt(np.maximum(table["cov_h_h"][at["tool"]] - table["common_h_h"][at["tool"]], 0.0))
    frame_s = float(np.median(np.diff(stamps))) * 1e-9
    looking = Looking(
        frame_s, _readings_per_look(run, network, frame_s), _repeated(solution), _noise(run, network)
    )
    everything = Postures(T, angle, rate)
    return LoggedRun(
        run.name,
        everything.take(chosen),
        time_ns[chosen],
        looking,
        _densities(solution, network),
        float(len(chosen)),
        float(np.median(own[seen])),
        float(np.median(total[seen])),
        solution,
    )


def _json(run: Path, name: str) -> dict[str, Any]:
    file = RunFolder(run).file(name)
    if not file.is_file():
        raise ArtefactError(SAID.format(run=run, what=name))
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return found


def _table(run: Path, name: str) -> dict[str, np.ndarray]:
    file = RunFolder(run).file(table_file(name))
    if not file.is_file():
        raise ArtefactError(SAID.format(run=run, what=file.name))
    return tables.read_table(file, name)


def _poses(p, q):
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    R = np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        ],
        axis=-1,
    ).reshape(-1, 3, 3)
    return se3.from_rotation_translation(R, p)


def _readings_per_look(run: Path, network: Network, frame_s: float) -> float:
    if not network.sensors:
        return 1.0
    sensors = _table(run, "sensors")
    stamps = np.sort(sensors["time_ns"][sensors["sensor"] == network.sensors[0].name])
    if len(stamps) < 2:
        return 1.0
    return max(frame_s / (float(np.median(np.diff(stamps))) * 1e-9), 1.0)


def _repeated(solution: dict[str, Any]) -> Repeated:
    learned = solution.get("learned", {}).get("repeated")
    return Repeated(learned["constant"], learned["resting"]) if learned else Repeated()


def _noise(run: Path, network: Network):
    side, sigma = [], []
    for camera in network.cameras:
        found = _table_of(run, camera.name)
        good = found["status"] == "accepted"
        variance = sum(found[f"cov{k}_{a}"][good] for k in range(4) for a in ("uu", "vv")) / 8
        u, v = (np.stack([found[f"{a}{k}"][good] for k in range(4)], axis=-1) for a in "uv")
        area = 0.5 * np.abs(np.sum(u * np.roll(v, -1, axis=1) - v * np.roll(u, -1, axis=1), axis=1))
        use = (variance > 0) & (area > 25)
        side.append(np.sqrt(area[use]))
        sigma.append(np.sqrt(variance[use]))
    return fitted_noise(np.concatenate(side), np.concatenate(sigma))


def _table_of(run: Path, camera: str) -> dict[str, np.ndarray]:
    file = RunFolder(run).file(table_file("detections", camera))
    if not file.is_file():
        raise ArtefactError(SAID.format(run=run, what=f"detections/{file.name}"))
    return tables.read_table(file, "detections")


def _densities(solution: dict[str, Any], network: Network) -> dict[str, tuple]:
    """Learned densities of what the machine did for longest, by body."""
    out = {}
    for body, entry in solution.get("learned", {}).get("motion", {}).items():
        classes = [c for name, c in entry.items() if name != "configured"]
        if not classes:
            continue
        longest = max(classes, key=lambda c: c["seconds"])
        parts = [longest[p] for p in ("translation", "rotation") if p in longest]
        a = np.concatenate([p["density"] for p in parts])
        v = np.concatenate([p["shake"] for p in parts])
        out[body] = (a, v)
    return out
