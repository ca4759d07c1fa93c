"""Where the machine stood while its edge was on a known point, for `calibrate bucket`: stands and touches.

The log goes through the stages up to track with another machine than the file's: one that ends at the bucket's pin.
Its tool is the frame of the pin on the stick, exact, and what hangs on the bucket is left out; so the table of states
gives the pin's frame with its covariance, and the sensitivities give what these have in common.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.calibration.touches import Stand, Touch
from pipeline.config import Machine
from pipeline.config.machine import CuttingEdge as EdgeSection
from pipeline.config.machine import JointBody
from pipeline.config.quantities import Pose
from pipeline.errors import CalibrationError
from pipeline.estimation.sensitivities import COMMON, Sensitivities
from pipeline.geometry import gaussian, se3, so3
from pipeline.surface.parked import KnownPoint
from pipeline.surface.rests import RestRule, Rests, share_left
from pipeline.surface.shots import NO_TIME, Shots
from pipeline.tracks.poses import TOOL, States

STILL_S = 1.0
"""A stand lasts at least so long."""
STILL_READINGS = 5.0
"""A reading further than so many sigmas from the mean so far ends a stand."""
ENDS_S = 0.1
"""At either end of a stand are left out: it is still settling, or about to go."""
AS_WELL = 2.0
"""Epochs of a stand are averaged whose own variance is at most so many times the least."""
RULE = RestRule(still_s=STILL_S)


@dataclass(frozen=True, eq=False)
class Standing:
    """A stand with its place in time."""

    first_ns: int
    last_ns: int
    stand: Stand


def machine_to_the_pin(machine: Machine) -> tuple[Machine, str]:
    """The machine without its bucket, the pin's frame on the stick being the tool; and the bucket's joint.

    Raises
    ------
    CalibrationError
        The cutting edge is on no joint of its own, or the bucket carries what the log would need.
    """
    joint = machine.cutting_edge.body
    body = machine.bodies.get(joint)
    if not isinstance(body, JointBody):
        raise CalibrationError(
            f"machine.toml: cutting_edge.body = '{joint}' is no body of kind 'joint', so it has no angle to calibrate; "
            "describe the bucket as a joint of the stick"
        )
    if body.follows is not None:
        raise CalibrationError(
            f"machine.toml: bodies.{joint} follows '{body.follows.joint}' and has no angle of its own; let the bucket "
            "be the joint and the marker on the belt follow it"
        )
    gone = {joint}
    for _ in machine.bodies:
        for name, other in machine.bodies.items():
            hangs = isinstance(other, JointBody) and (
                other.parent in gone or (other.follows is not None and other.follows.joint in gone)
            )
            if hangs:
                gone.add(name)
    carried = [name for name, camera in machine.cameras.items() if camera.body in gone]
    if carried:
        raise CalibrationError(
            f"camera '{carried[0]}' is carried by the bucket; its angle cannot be told from where it looks"
        )
    exact = Pose(xyz_m=body.axis.xyz_m, rpy_deg=body.axis.rpy_deg, sigma_mm=0.0, sigma_deg=0.0)
    # What epochs share is gathered for the ends of the edge: as far from the pin as the bucket reaches, so that the
    # turns of the stick, which its edge feels so far away, are in there too.
    reach = float(np.hypot(*machine.cutting_edge.mount.xyz_m[:2]))
    edge = EdgeSection(
        body=body.parent, mount=exact, width_m=2 * max(reach, 0.5 * machine.cutting_edge.width_m)
    )
    reduced = machine.model_copy(
        update={
            "bodies": {name: other for name, other in machine.bodies.items() if name not in gone},
            "markers": {name: m for name, m in machine.markers.items() if m.body not in gone},
            "sensors": {name: s for name, s in machine.sensors.items() if s.joint not in gone},
            "motion": {name: m for name, m in machine.motion.items() if name not in gone},
            "cutting_edge": edge,
        }
    )
    return reduced, joint


def standings(
    states: States,
    rests: Rests,
    rest_time_ns: np.ndarray,
    answer: Sensitivities | None,
    correlation_s: float | None,
    time_ns: np.ndarray,
    raw: np.ndarray,
    noise: float,
) -> list[Standing]:
    """Every stretch in which both the pin and the sensor stood still.

    Parameters
    ----------
    states : States
        With the rows of the tool.
    rests : Rests
        Of the pin's frame, indices into ``rest_time_ns``.
    rest_time_ns : (n,) int64 array
        Epochs of the cutting edge.
    answer : Sensitivities, optional
        Of the adjustment.
    correlation_s : float, optional
        Over which the own part of a parked edge stays the same error.
    time_ns, raw : (m,) arrays
        Readings of the sensor at their true times.
    noise : float
        Of one reading.
    """
    tool = states.take(states.body == TOOL)
    tool = tool.take(np.argsort(tool.time_ns, kind="stable"))
    found = []
    for first, stop in zip(rests.first, rests.stop):
        begin, end = rest_time_ns[first], rest_time_ns[stop - 1]
        inside = np.flatnonzero((time_ns >= begin) & (time_ns <= end))
        for rows in _still(time_ns[inside], raw[inside], noise):
            kept = inside[rows]
            low, high = time_ns[kept[0]] + round(ENDS_S * 1e9), time_ns[kept[-1]] - round(ENDS_S * 1e9)
            epochs = np.flatnonzero((tool.time_ns >= low) & (tool.time_ns <= high))
            kept = kept[(time_ns[kept] >= low) & (time_ns[kept] <= high)]
            if len(epochs) < 2 or len(kept) < 2:
                continue
            stand = _stand(tool, epochs, answer, correlation_s, raw[kept], noise)
            found.append(Standing(int(low), int(high), stand))
    return found


def _still(time_ns: np.ndarray, raw: np.ndarray, noise: float) -> list[np.ndarray]:
    """Runs of readings that stay where they began, at least STILL_S long."""
    found, start, total = [], 0, 0.0
    for k in range(len(raw) + 1):
        n = k - start
        if k < len(raw) and (
            n == 0 or abs(raw[k] - total / n) <= STILL_READINGS * noise * np.sqrt(1 + 1 / n)
        ):
            total += raw[k]
            continue
        if n > 1 and time_ns[k - 1] - time_ns[start] >= STILL_S * 1e9:
            found.append(np.arange(start, k))
        start, total = k, raw[k] if k < len(raw) else 0.0
    return found


def _stand(
    tool: States,
    epochs: np.ndarray,
    answer: Sensitivities | None,
    correlation_s: float | None,
    raw: np.ndarray,
    noise: float,
) -> Stand:
    # Between two pictures of the stick its pose rests on the motion prior, which knows of no standing still: an epoch
    # like that has three times the sigma and says nothing that its neighbours do not.
    position = np.trace(gaussian.from_upper_triangle(tool.own[epochs])[:, :3, :3], axis1=1, axis2=2)
    epochs = epochs[position <= AS_WELL * position.min()]
    T = se3.from_rotation_translation(
        so3.from_quaternion(tool.q_world_body[epochs]), tool.p_world[epochs].astype(float)
    )
    mean = T[len(T) // 2]
    for _ in range(2):
        mean = se3.retract(mean, se3.local(mean, T).mean(axis=0))
    own, common = (
        se3.to_grid_covariance(T, gaussian.from_upper_triangle(part[epochs])).mean(axis=0)
        for part in (tool.own, tool.common)
    )
    span_s = (tool.time_ns[epochs[-1]] - tool.time_ns[epochs[0]]) * 1e-9
    own = own * share_left(span_s, correlation_s)
    factors = np.zeros((6, 0))
    if answer is not None:
        middle = (int(tool.time_ns[epochs[0]]) + int(tool.time_ns[epochs[-1]])) // 2
        k = int(np.argmin(np.abs(answer.time_ns - middle)))
        rows = [i for i, source in enumerate(answer.sources) if source.kind == COMMON]
        factors = answer.response[k, rows].T.astype(float)
    # What the factors leave out of the common part is counted as own.
    values, vectors = np.linalg.eigh(common - factors @ factors.T)
    own = own + (vectors * np.maximum(values, 0.0)) @ vectors.T
    return Stand("", mean, own, factors, float(np.mean(raw)), noise / np.sqrt(len(raw)))


@dataclass(frozen=True, eq=False)
class Touched:
    """What the check file and the log together give."""

    stands: list[Stand]
    touches: list[Touch]
    times_ns: list[int]
    """Of each touch."""
    points: list[float]
    """Sigma of each known point, metres."""
    point_names: list[str]
    left_out: dict[str, int]
    """Rows that were not used, by reason."""


def touched(
    found: list[Standing],
    shots: Shots,
    known: Mapping[str, KnownPoint],
    origin_m: np.ndarray,
    reach_m: float,
    width_m: float,
    radius_m: float,
    tolerance_s: float,
    sigma_m: float,
    contact_m: float,
    tooth: str,
) -> Touched:
    """Which stand each row of the file belongs to.

    A row with a time belongs to the stand nearest in time. A known point without times is at every stand whose pin is
    as far from it as the edge is from the pin, within ``radius_m``, and in whose plane it lies, within the width.

    Parameters
    ----------
    found : list of Standing
        Of `standings`.
    shots : Shots
        Of the file; those of the floor are left out.
    known : mapping
        Points by id, grid metres: they replace the coordinates of control rows with their id.
    origin_m : (3,) array
        Of the world, grid metres.
    reach_m : float
        From the pin to the middle of the edge.
    width_m : float
        Of the edge.
    radius_m, tolerance_s : float
        Of site.toml.
    sigma_m : float
        Of a coordinate whose sigma neither file nor site says.
    contact_m : float
        How well a tooth sits on a mark.
    tooth : str
        left, middle, right or empty: what touched a known point whose row does not say.
    """
    out = Touched([], [], [], [], [], {})
    used: dict[int, int] = {}
    number: dict[str, int] = {}

    def add(
        standing: int,
        name: str,
        p_grid: np.ndarray,
        sigma: float,
        point: str | None,
        edge_point: str,
        row_ns: int = NO_TIME,
    ) -> None:
        if standing not in used:
            used[standing] = len(out.stands)
            out.stands.append(replace(found[standing].stand, name=_clock(found[standing])))
        k = -1
        if point is not None:
            k = number.setdefault(point, len(number))
            if k == len(out.points):
                out.points.append(sigma)
                out.point_names.append(point)
        at = Touch(
            f"{name} at {_clock(found[standing]) if row_ns == NO_TIME else _clock_of(row_ns)}",
            used[standing],
            p_grid - origin_m,
            contact_m if k >= 0 else sigma,
            k,
            edge_point,
            row_ns != NO_TIME,
        )
        out.touches.append(at)
        out.times_ns.append((found[standing].first_ns + found[standing].last_ns) // 2)

    taken: set[tuple[int, str, str]] = set()
    for i in range(len(shots)):
        kind, name = str(shots.kind[i]), str(shots.point[i])
        if kind == "floor":
            _count(out, "shot of the floor")
            continue
        point = known.get(name) if kind == "control" else None
        p = shots.p_grid[i] if point is None else point.p_grid
        sigma = float(shots.sigma_m[i]) if point is None else point.sigma_m
        sigma = sigma if np.isfinite(sigma) else sigma_m
        edge_point = str(shots.edge_point[i]) or (tooth if kind == "control" else "")
        if shots.time_ns[i] == NO_TIME:
            if kind == "edge":
                _count(out, "shot of the edge without a time")
                continue
            which = _near(found, p - origin_m, reach_m, width_m, radius_m)
        else:
            which = _at(found, int(shots.time_ns[i]), tolerance_s)
        if not which:
            _count(out, "row at whose time the machine did not stand still")
        for k in which:
            key = (k, name, edge_point)
            if key in taken:
                _count(out, "second row of one touch")
                continue
            taken.add(key)
            add(
                k,
                name,
                p,
                sigma,
                name if kind == "control" else None,
                edge_point,
                int(shots.time_ns[i]),
            )
    named = {str(shots.point[i]) for i in range(len(shots)) if shots.kind[i] == "control"}
    for name, point in known.items():
        for k in () if name in named else _near(found, point.p_grid - origin_m, reach_m, width_m, radius_m):
            add(k, name, point.p_grid, point.sigma_m, name, tooth)
    return out


def _count(out: Touched, reason: str) -> None:
    out.left_out[reason] = out.left_out.get(reason, 0) + 1


def _at(found: list[Standing], time_ns: int, tolerance_s: float) -> list[int]:
    away = [max(s.first_ns - time_ns, time_ns - s.last_ns, 0) for s in found]
    if not away or min(away) > tolerance_s * 1e9:
        return []
    return [int(np.argmin(away))]


def _near(
    found: list[Standing], p_world: np.ndarray, reach_m: float, width_m: float, radius_m: float
) -> list[int]:
    near = []
    for k, standing in enumerate(found):
        p = se3.transform(se3.inverse(standing.stand.T_world_axis), p_world)
        if abs(np.hypot(p[0], p[1]) - reach_m) <= radius_m and abs(p[2]) <= 0.5 * width_m + radius_m:
            near.append(k)
    return near


def _clock(standing: Standing) -> str:
    return _clock_of((standing.first_ns + standing.last_ns) // 2)


def _clock_of(time_ns: int) -> str:
    seconds = time_ns // 10**9 % 86_400
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


__all__ = ["Standing", "Touched", "machine_to_the_pin", "standings", "touched"]
