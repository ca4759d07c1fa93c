"""The tree of frames, and paths through it: the edges between a camera and what it looks at.

Every frame hangs on one parent by one edge: a static pose, a moving pose (one per epoch) or the turn of a joint
(one angle per epoch). The path from a camera up to where it meets the marker's own path, and down from
there, holds exactly the unknowns that the observation knows of. An edge's error ``xi`` is felt in its child frame;
seen from the start of the path it counts positive on the way down and negative on the way up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.geometry import se3, so3

WORLD = "world"
TOOL = "tool"


def body_frame(name: str) -> str:
    return WORLD if name == WORLD else f"body {name}"


def camera_frame(name: str) -> str:
    return f"camera {name}"


def marker_frame(name: str) -> str:
    return f"marker {name}"


def axis_frame(name: str) -> str:
    return f"axis {name}"


@dataclass(frozen=True)
class Edge:
    """How a frame hangs on its parent."""

    parent: str
    kind: str
    """static, moving or joint."""
    index: int
    """Of the static, or of the variable."""
    ratio: float = 1.0
    """Of a joint that a belt drives: its turn per turn of the variable's angle."""


@dataclass(frozen=True)
class Step:
    """One edge of a path: that of ``frame`` to its parent."""

    frame: str
    edge: Edge
    sign: int
    """+1 away from the root, -1 towards it."""


@dataclass(frozen=True)
class Variable:
    """A moving body or a joint: what has one value per epoch."""

    body: str
    kind: str
    """moving: pose (6) and velocity (6); joint: angle and rate."""
    motion: tuple[float, float]
    clock: int | None = None
    """Of a joint that a sensor reads: index of that sensor's time offset. The joint's states stand at the sensor's
    times as the file corrects them; whoever uses its angle at another clock's time turns back by rate times the
    error of that correction. So an offset that nothing else can see stays at its prior. With the offset in the sensor's
    own residual, extrapolation was traded against the motion prior: it ran off by 8.6 of its sigmas."""

    @property
    def size(self) -> int:
        """Of its block of the state."""
        return 12 if self.kind == "moving" else 2

    @property
    def half(self) -> int:
        """Of its pose or angle, without the rate."""
        return self.size // 2


@dataclass(frozen=True)
class Frames:
    """All frames that hang, in the end, on the world."""

    edges: dict[str, Edge] = field(default_factory=dict)

    def __contains__(self, frame: str) -> bool:
        return frame == WORLD or frame in self.edges

    def to_root(self, frame: str) -> list[str]:
        """The frame, its parent, and so on, without the world."""
        way = []
        while frame != WORLD:
            way.append(frame)
            frame = self.edges[frame].parent
        return way

    def path(self, start: str, end: str) -> tuple[Step, ...]:
        """The edges from one frame to another."""
        up, down = self.to_root(start), self.to_root(end)
        shared = set(up) & set(down)
        steps = [Step(f, self.edges[f], -1) for f in up if f not in shared]
        steps += [Step(f, self.edges[f], 1) for f in reversed(down) if f not in shared]
        return tuple(steps)


def turn(angle_rad):
    """Pose of a joint's child in its axis frame: a turn about z, (..., 4, 4)."""
    angle_rad = np.asarray(angle_rad, dtype=np.float64)
    R = so3.exp(angle_rad[..., None] * np.array([0.0, 0.0, 1.0]))
    return se3.from_rotation_translation(R, np.zeros(3))


def along(path, edge_pose):
    """Poses along a path, all seen from its start.

    Parameters
    ----------
    path : sequence of Step
        From ``Frames.path``, or a part of one.
    edge_pose : callable
        ``edge_pose(edge)`` gives ``T_parent_child``, (4, 4) or (n, 4, 4).

    Returns
    -------
    T_start_child : list of (..., 4, 4) arrays
        For each step, the child frame of its edge: that frame in which the edge's error is felt.
    T_start_end : (..., 4, 4) array
    """
    T = np.eye(4)
    children = []
    for step in path:
        E = edge_pose(step.edge)
        if step.sign < 0:
            children.append(T)
            T = T @ se3.inverse(E)
        else:
            T = T @ E
            children.append(T)
    return children, T
