"""How a belt was put on, and the cutting edge, told by points that the edge touched: the flip marker of Fig. 5.

A joint that `follows` the bucket's carries the marker that cameras see, so the log has the bucket's angle but for one
constant: the turn of the marker's axis about its z at which the belt happened to be put on. While the machine stands
with its edge on a surveyed point, or a tooth is shot,

    r = T_world_tool(t)^-1 p - p_tool  =  0      (without x, along the edge, where nobody says which part of it touched)

An angle of this chain shows only as a sum: of the phase, of where the bucket's axis frame has its zero, and of the
direction from pin to edge. As in `calibrate bucket` the other two are held, and all that is not known is the phase's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.calibration.adjusted import Adjusted, adjusted
from pipeline.calibration.contradiction import refuse_contradiction
from pipeline.calibration.curve_fit import azimuth_of
from pipeline.calibration.held_points import PointFits, Residual, held_point, with_points
from pipeline.calibration.pins import axis_static
from pipeline.config import Machine, Site
from pipeline.config.machine import JointBody
from pipeline.errors import CalibrationError
from pipeline.geometry import se3, so3
from pipeline.network import frames as fr
from pipeline.network import network_of
from pipeline.network.model import Network

LEAST_TOUCHES = 3
PHASE_RAD = np.deg2rad(20.0)
"""Prior of the phase about what the file says."""
MOST_MOVED = 3.0
"""Times its prior, beyond which the file describes another belt."""
RESTARTS = 6
"""A phase that is off by degrees moves the edge on a circle: the log is adjusted again from where it was found."""
MOVED_RAD = np.deg2rad(0.02)


@dataclass(frozen=True)
class EdgeTouch:
    """A point of the edge whose coordinates are known at one time."""

    name: str
    time_ns: int
    p_world: np.ndarray
    """(3,) m."""
    sigma_m: float
    """Of this touch alone."""
    known: int
    """Index of the known point that was touched; -1 for a shot."""
    edge_point: str
    """left, middle, right, or empty for anywhere along the edge."""


@dataclass(frozen=True, eq=False)
class ToldBelt:
    """A calibrated belt."""

    joint: str
    """That follows the bucket's."""
    ratio: float
    T_parent_axis: np.ndarray
    """(4, 4) of its axis; its turn about z is the phase."""
    axis: np.ndarray
    """(6, 6) covariance."""
    moved_rad: float
    """Phase against the file's."""
    T_bucket_tool: np.ndarray
    tool: np.ndarray
    """(6, 6), nothing across the line from the pin."""
    edge_sigma_m: float
    """Of the middle of the edge in the bucket's plane, as seen from the pin, in its worst direction."""
    fits: PointFits
    whole: Adjusted

    @property
    def phase_sigma_rad(self) -> float:
        """Of the bucket's angle."""
        return float(np.sqrt(self.axis[5, 5])) / abs(self.ratio)


def belt_on(machine: Machine, joint: str) -> str | None:
    """The joint that follows another one and carries a marker; None where there is none."""
    carriers = {marker.body for marker in machine.markers.values()}
    for name, body in machine.bodies.items():
        follows = body.follows if isinstance(body, JointBody) else None
        if follows is not None and follows.joint == joint and name in carriers:
            return name
    return None


def calibrate_belt(
    machine: Machine,
    site: Site,
    belt: str,
    detections: Mapping[str, Mapping[str, np.ndarray]],
    touches: Sequence[EdgeTouch],
    known: Mapping[str, float],
) -> ToldBelt:
    """Phase of a belt and the cutting edge.

    Parameters
    ----------
    machine, site : Machine, Site
        As loaded, every camera with its intrinsics.
    belt : str
        Of `belt_on`.
    detections : mapping
        By camera: columns of the table ``detections``.
    touches : sequence of EdgeTouch
        At least `LEAST_TOUCHES`.
    known : mapping
        Known points in the order of their indices: name -> sigma of each coordinate, m.

    Raises
    ------
    CalibrationError
        Too few touches, the machine moved, a touch contradicts the others, or all of them what the files say.
    """
    from pipeline.estimation.table import observations_of

    if len(touches) < LEAST_TOUCHES:
        raise CalibrationError(
            f"{len(touches)} touches with a time, at least {LEAST_TOUCHES} are needed: set the edge on the point, hold "
            "it for two seconds before and after, and write down when"
        )
    body = machine.bodies[belt]
    assert isinstance(body, JointBody) and body.follows is not None
    bare = machine.model_copy(update={"sensors": {}})
    seen = {name: rows for name, rows in detections.items() if name in machine.cameras}
    first = network_of(bare, site)
    observations = observations_of(first, seen)
    network = _opened(first, belt, machine.cutting_edge.body)
    for _ in range(RESTARTS):
        whole = adjusted(network, observations, settings=site.estimation)
        told, fits = with_points(whole, _held(whole, touches), list(known.values()))
        turn = _turned(network, told, belt)
        network = _from(network, belt, turn)
        if abs(turn) < MOVED_RAD:
            break
    else:
        raise CalibrationError(
            f"the phase of '{belt}' finds no end: it still moves by {np.rad2deg(abs(turn)):.2g} deg; bring the turn of "
            f"bodies.{belt}.axis about its z within {np.rad2deg(PHASE_RAD):.0f} deg of how the belt is on; nothing was "
            "written"
        )
    refuse_contradiction(whole)
    moved = _turned(first, told, belt)
    if abs(moved) > MOST_MOVED * PHASE_RAD:
        raise CalibrationError(
            f"the phase of '{belt}' is {np.rad2deg(abs(moved)):.0f} deg from where machine.toml has it: bring "
            f"bodies.{belt}.axis within {np.rad2deg(PHASE_RAD):.0f} deg, or see whether its marker is upside down; "
            "nothing was written"
        )
    off = fits.culprit
    if off is not None:
        raise CalibrationError(
            f"touch '{off.name}' does not go with the others: {1000 * off.off_m:.0f} mm off "
            f"({off.normalised:.0f} sigma); check how it was typed, or that the edge did not slip, and mend or "
            "delete its row; nothing was written"
        )
    if fits.wrong:
        raise CalibrationError(
            f"the touches together do not go with machine.toml and site.toml ({fits.normalised:.0f} sigma): check "
            "the coordinates of the touched point, the benchmarks and the length from the bucket's pin to its edge; "
            "nothing was written"
        )
    tool = network.statics[network.tool].name
    ratio = body.follows.ratio
    return ToldBelt(
        belt,
        ratio,
        told.value(axis_static(belt)),
        told.covariance(axis_static(belt)),
        moved,
        told.value(tool),
        told.covariance(tool),
        _edge_sigma(told, belt, tool, ratio),
        fits,
        told,
    )


def _opened(network: Network, belt: str, bucket: str) -> Network:
    """The network with an open phase, and the rest of the angle held."""
    statics = list(network.statics)
    index = {static.name: k for k, static in enumerate(statics)}
    phase, zero, tool = index[axis_static(belt)], index[axis_static(bucket)], network.tool
    opened, held = statics[phase].covariance.copy(), statics[zero].covariance.copy()
    opened[5, :] = opened[:, 5] = 0.0
    opened[5, 5] = PHASE_RAD**2
    held[5, :] = held[:, 5] = 0.0
    T = statics[tool].value
    _, J_azimuth = azimuth_of(T)
    about_pin = se3.Ad(se3.inverse(T))[:, 5]
    M = np.eye(6) - np.outer(about_pin, J_azimuth)
    statics[phase] = replace(statics[phase], covariance=opened)
    statics[zero] = replace(statics[zero], covariance=held)
    statics[tool] = replace(statics[tool], covariance=M @ statics[tool].covariance @ M.T)
    return replace(network, statics=tuple(statics))


def _turned(network: Network, told: Adjusted, belt: str) -> float:
    """Turn of the phase that was found, against the one about which the network has it."""
    k = told.index(axis_static(belt))
    return float(se3.local(network.statics[k].value, told.value(axis_static(belt)))[5])


def _from(network: Network, belt: str, turn: float) -> Network:
    """The network with a phase turned further, as wide as before."""
    statics = list(network.statics)
    k = next(k for k, static in enumerate(statics) if static.name == axis_static(belt))
    statics[k] = replace(statics[k], value=statics[k].value @ fr.turn(turn))
    return replace(network, statics=tuple(statics))


def _held(whole: Adjusted, touches: Sequence[EdgeTouch]):
    half = 0.5 * whole.network.edge_m
    at = {"left": -half, "middle": 0.0, "right": half}
    return [
        held_point(
            whole,
            fr.TOOL,
            touch.name,
            touch.time_ns,
            touch.p_world,
            touch.sigma_m,
            _off_edge(at.get(touch.edge_point)),
            touch.known,
        )
        for touch in touches
    ]


def _off_edge(x_m: float | None) -> Residual:
    """Residual of a point of the edge, at x along it; None for anywhere."""
    rows = [1, 2] if x_m is None else [0, 1, 2]

    def residual(T_world_tool: np.ndarray, p_world: np.ndarray, z: np.ndarray):
        p = se3.transform(se3.inverse(T_world_tool), p_world)
        by_pose = -np.hstack([np.eye(3), -so3.hat(p)])
        r = p - [x_m or 0.0, 0.0, 0.0]
        return r[rows], by_pose[rows], T_world_tool[:3, :3].T[rows], np.zeros((len(rows), len(z)))

    return residual


def _edge_sigma(told: Adjusted, belt: str, tool: str, ratio: float) -> float:
    """Of the middle of the edge: across the line from the pin by the phase, along it by the tool."""
    T = told.value(tool)
    r = float(np.hypot(*T[:2, 3]))
    along = np.array([*T[:2, 3] / r, 0.0]) @ T[:3, :3]
    P = np.zeros((2, 2))
    P[0, 0] = (r / ratio) ** 2 * told.covariance(axis_static(belt))[5, 5]
    P[1, 1] = along @ told.covariance(tool)[:3, :3] @ along
    P[0, 1] = P[1, 0] = -r / ratio * told.covariance(axis_static(belt), tool)[5, :3] @ along
    return float(np.sqrt(np.linalg.eigvalsh(P)[-1]))
