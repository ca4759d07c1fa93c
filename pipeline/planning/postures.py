"""Postures of a machine: where its bodies are, for planning before a log tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import PlanningError
from pipeline.geometry import se3, so3
from pipeline.network import frames as fr
from pipeline.network.model import Network


@dataclass(frozen=True, eq=False)
class Postures:
    """The machine at n instants, or as it may stand."""

    T_world: dict[str, np.ndarray]
    """By moving body: (n, 4, 4) ``T_world_body``."""
    angle: dict[str, np.ndarray]
    """By joint that has an angle of its own: (n,) rad."""
    rate: dict[str, np.ndarray]
    """By the same joints: (n,) rad/s. An error of a sensor's clock is felt only while the joint turns."""

    def __len__(self) -> int:
        return len(next(iter([*self.T_world.values(), *self.angle.values()])))

    def take(self, rows) -> Postures:
        """Some of them: a mask, a slice or an index array."""
        parts = ({k: v[rows] for k, v in d.items()} for d in (self.T_world, self.angle, self.rate))
        return Postures(*parts)


def world_poses(network: Network, postures: Postures) -> dict[str, np.ndarray]:
    """``T_world_body`` of every body of the network, and of the tool under ``fr.TOOL``; (n, 4, 4) each.

    Raises
    ------
    PlanningError
        A body has no place in the postures, or one that no file gives.
    """
    n = len(postures)
    out = {fr.WORLD: se3.identity((n,))}

    def place(name: str) -> np.ndarray:
        if name in out:
            return out[name]
        body = network.bodies[name]
        if body.kind == "static":
            assert body.static is not None
            out[name] = np.broadcast_to(surveyed(network, body.static), (n, 4, 4))
        elif body.kind == "moving":
            if name not in postures.T_world:
                raise PlanningError(
                    f"where body '{name}' is cannot be told from the arm's lengths; plan with --log RUN, "
                    "whose poses tell it"
                )
            out[name] = postures.T_world[name]
        else:
            assert body.parent is not None and body.static is not None
            angle = postures.angle[body.follows or name]
            axis = surveyed(network, body.static)
            out[name] = place(body.parent) @ axis @ fr.turn(body.ratio * angle)
        return out[name]

    for name in network.bodies:
        place(name)
    out[fr.TOOL] = out[network.tool_body] @ network.statics[network.tool].value
    return out


def surveyed(network: Network, index: int) -> np.ndarray:
    """The file's value of a static.

    Raises PlanningError where no file gives it: a place that only a log can tell cannot be planned with.
    """
    static = network.statics[index]
    if not static.surveyed:
        raise PlanningError(
            f"nothing can be planned with the {static.name}, which no file gives; write roughly where it will be, "
            "with its sigma"
        )
    return static.value


@dataclass(frozen=True)
class Arm:
    """Boom and stick in the plane of the arm; metres.

    The cab's axes are x forward along the arm, y left, z up. The stick's frame stands at the pin between boom and
    stick, x along the stick to the bucket's pin, y up in the plane of the arm, z to the right.
    """

    foot_x: float = 0.35
    foot_y: float = 0.0
    foot_z: float = 1.70
    """Pin of the boom in the cab."""
    boom: float = 4.60
    stick: float = 2.45


def arm_of(foot: tuple[float, float, float] | None, boom: float | None, stick: float | None) -> Arm:
    """An arm with the given lengths, and a usual one's where none is given."""
    usual = Arm()
    x, y, z = foot or (usual.foot_x, usual.foot_y, usual.foot_z)
    return Arm(x, y, z, boom or usual.boom, stick or usual.stick)


def fitted_arm(T_cab_stick, stick_m: float) -> Arm:
    """The arm that a log shows: the stick's origin goes round the foot of the boom, on a circle.

    Parameters
    ----------
    T_cab_stick : (n, 4, 4) array
        From many epochs.
    stick_m : float
        Between its pins.

    Raises
    ------
    PlanningError
        The boom hardly moved, so that no circle can be told.
    """
    p = T_cab_stick[:, :3, 3]
    x, y, z = p[:, 0], np.median(p[:, 1]), p[:, 2]
    # x² + z² = 2 a x + 2 b z + c is linear in the circle (Kåsa's fit).
    A = np.stack([2 * x, 2 * z, np.ones(len(x))], axis=1)
    if np.linalg.matrix_rank(A - [*A[:, :2].mean(0), 0.0], tol=0.3) < 3 or len(x) < 3:
        raise PlanningError(
            "the boom hardly moved in this log, so its length and foot cannot be told; give them with "
            "--boom-foot and --boom"
        )
    (a, b, c), *_ = np.linalg.lstsq(A, x**2 + z**2, rcond=None)
    return Arm(float(a), float(y), float(b), float(np.sqrt(c + a * a + b * b)), stick_m)


def link(direction_rad, xyz):
    """``T_cab_link`` of a link of the arm, (n, 4, 4): x along it, z to the machine's right."""
    c, s = np.cos(direction_rad), np.sin(direction_rad)
    zero, one = np.zeros_like(c), np.ones_like(c)
    R = np.stack([c, -s, zero, zero, zero, -one, s, c, zero], axis=-1).reshape(*np.shape(c), 3, 3)
    return se3.from_rotation_translation(R, xyz)


def reach_for(arm: Arm, pin_xz):
    """Directions of boom and stick that bring the bucket's pin to places in the plane of the arm.

    Parameters
    ----------
    arm : Arm
        Its lengths.
    pin_xz : (n, 2) array
        In the cab, metres.

    Returns
    -------
    boom_rad, stick_rad : (n,) arrays
        Above the horizontal, the knee upward; nan where it is out of reach.
    """
    d = np.asarray(pin_xz) - [arm.foot_x, arm.foot_z]
    distance = np.hypot(d[:, 0], d[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (arm.boom**2 + distance**2 - arm.stick**2) / (2 * arm.boom * distance)
        boom = np.arctan2(d[:, 1], d[:, 0]) + np.arccos(np.where(np.abs(cosine) < 1, cosine, np.nan))
    knee = arm.boom * np.stack([np.cos(boom), np.sin(boom)], axis=-1)
    return boom, np.arctan2(d[:, 1] - knee[:, 1], d[:, 0] - knee[:, 0])


@dataclass(frozen=True, eq=False)
class Chain:
    """Which body of the network is which link of an excavator, and how the bucket hangs on its pin."""

    cab: str
    stick: str
    joint: str
    tool_xy: np.ndarray
    """(2,) the edge's middle in the bucket's axis frame, metres."""
    lean_rad: float
    """Direction of the axis frame's x in the stick, in the plane of the arm."""
    pin_m: float
    """From the stick's origin to the bucket's pin."""

    @property
    def bucket_m(self) -> float:
        return float(np.hypot(*self.tool_xy))

    @property
    def tool_rad(self) -> float:
        """Direction of the edge's middle from the pin, in the bucket."""
        return float(np.arctan2(self.tool_xy[1], self.tool_xy[0]))


def chain_of(network: Network) -> Chain:
    """The cab, the stick and the bucket of a network.

    The bucket carries the cutting edge and is a joint on the stick, a moving body; the cab is the other moving
    body, the one with the cameras.

    Raises
    ------
    PlanningError
        The machine is another one.
    """
    tool = network.bodies[network.tool_body]
    moving = [name for name, body in network.bodies.items() if body.kind == "moving"]
    carriers = [n for n in moving if n != tool.parent and any(c.body == n for c in network.cameras)]
    if tool.kind != "joint" or tool.parent not in moving or len(carriers) != 1 or tool.follows is not None:
        raise PlanningError(
            "postures are laid out for a moving cab with cameras and a moving stick on which the bucket turns; this "
            "machine.toml describes another machine: plan with --log RUN, whose poses tell how it stands"
        )
    assert tool.static is not None
    axis = surveyed(network, tool.static)
    if axis[2, 2] < 0.9:
        raise PlanningError(
            "the bucket's axis in machine.toml does not lie along z of the stick, so the plane of the arm cannot be "
            "told; plan with --log RUN, whose poses tell how it stands"
        )
    return Chain(
        carriers[0],
        tool.parent,
        tool.name,
        network.statics[network.tool].value[:2, 3],
        float(so3.log(axis[:3, :3])[2]),
        float(np.hypot(*axis[:2, 3])),
    )


def postures_at(
    network: Network, arm: Arm, T_world_cab, edge_xz, bucket_rad, rate_rad_s: float = 0.0
) -> tuple[Postures, np.ndarray]:
    """Postures that bring the middle of the edge to places in the plane of the arm.

    Parameters
    ----------
    network : Network
        Of a machine that ``chain_of`` knows.
    arm : Arm
        Its lengths.
    T_world_cab : (n, 4, 4) array
        Where the machine stands.
    edge_xz : (n, 2) array
        Forward and above the cab's origin, metres.
    bucket_rad : (n,) array
        Direction from the bucket's pin to the edge, above the horizontal.
    rate_rad_s : float
        How fast the bucket turns meanwhile.

    Returns
    -------
    Postures
        Of all n; where out of reach they are nan.
    within : (n,) bool array
        In reach.
    """
    chain = chain_of(network)
    bucket_rad = np.broadcast_to(np.asarray(bucket_rad, float), len(edge_xz))
    tip = np.stack([np.cos(bucket_rad), np.sin(bucket_rad)], axis=-1)
    boom, stick = reach_for(arm, np.asarray(edge_xz) - chain.bucket_m * tip)
    return postures_from(network, arm, T_world_cab, boom, stick, bucket_rad, rate_rad_s), np.isfinite(stick)


def postures_from(
    network: Network, arm: Arm, T_world_cab, boom_rad, stick_rad, bucket_rad, rate_rad_s: float = 0.0
) -> Postures:
    """Postures from the directions of boom, stick and pin-to-edge above the cab's horizontal; (n,) each, rad."""
    chain = chain_of(network)
    n = len(boom_rad)
    knee = np.stack(
        [
            arm.foot_x + arm.boom * np.cos(boom_rad),
            np.full(n, arm.foot_y),
            arm.foot_z + arm.boom * np.sin(boom_rad),
        ],
        axis=-1,
    )
    T_world_stick = T_world_cab @ link(stick_rad, knee)
    turn = bucket_rad - stick_rad - chain.tool_rad - chain.lean_rad
    turn = np.mod(turn + np.pi, 2 * np.pi) - np.pi
    joint = chain.joint
    return Postures(
        {chain.cab: np.broadcast_to(T_world_cab, (n, 4, 4)), chain.stick: T_world_stick},
        {joint: turn},
        {joint: np.full(n, rate_rad_s)},
    )
