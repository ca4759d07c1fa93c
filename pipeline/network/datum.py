"""Tying the network to the datum: which frame each moving body's pose is kept in, and what is not tied at all.

A moving body's pose is kept relative to what sees it: to the world if its own cameras look at surveyed markers,
else to the camera (or marker) it shares most observations with. Kept in any other frame, an uncertain
mount between the two would be a gauge of the whole trajectory: it was tried, the step length fell to 0.03 and thirty
iterations did not converge.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import NetworkError
from pipeline.network import frames as fr
from pipeline.network.model import Camera, Marker, Network, Observations, Readings


@dataclass(frozen=True, eq=False)
class Tie:
    """A network as one log ties it: every frame that hangs on the datum, and by which variables."""

    frames: fr.Frames
    variables: tuple[fr.Variable, ...]
    """What is estimated per epoch; ``Edge.index`` of moving and joint edges points in here."""
    used: np.ndarray
    """(n,) bool, the observations that bear on these frames."""
    warnings: tuple[str, ...]


def tie(network: Network, observations: Observations, readings: dict[str, Readings]) -> Tie:
    """How this log ties the network to the datum.

    Raises
    ------
    NetworkError
        The body with the cutting edge, or one it hangs on, is tied to nothing surveyed.
    """
    pairs = Counter(
        zip(observations.camera.tolist(), network.tag_marker[observations.tag].tolist(), strict=True)
    )
    read = {
        s.joint: s.offset
        for s in reversed(network.sensors)
        if s.name in readings and len(readings[s.name].time_ns)
    }
    anchors = _anchors(network, pairs)
    warnings = _unseen(network, pairs) + _adrift(network, pairs, anchors)

    variables: list[fr.Variable] = []
    edges: dict[str, fr.Edge] = {}
    angles: dict[str, int] = {}
    left_out: list[str] = []
    for name in _parents_first(network):
        body = network.bodies[name]
        frame = fr.body_frame(name)
        if body.kind == "static":
            if anchors.get(name) is None:
                left_out.append(name)
                continue
            assert body.static is not None
            edges[frame] = fr.Edge(fr.WORLD, "static", body.static)
        elif body.kind == "moving":
            if anchors.get(name) is None:
                left_out.append(name)
                continue
            edges[frame] = fr.Edge(anchors[name], "moving", len(variables))
            variables.append(fr.Variable(name, "moving", body.motion))
        elif body.kind == "joint":
            assert body.static is not None and body.parent is not None
            angle = body.follows or name
            turned = [n for n, b in network.bodies.items() if n == angle or b.follows == angle]
            if set(_lineage(network, name)) & set(left_out) or not (
                angle in read or any(_joint_in_view(network, n, pairs) for n in turned)
            ):
                left_out.append(name)
                continue
            edges[fr.axis_frame(name)] = fr.Edge(fr.body_frame(body.parent), "static", body.static)
            if angle not in angles:
                angles[angle] = len(variables)
                motion = network.bodies[angle].motion
                variables.append(fr.Variable(angle, "joint", motion, read.get(angle)))
            edges[frame] = fr.Edge(fr.axis_frame(name), "joint", angles[angle], body.ratio)
    # A joint hangs on its parent: where the parent is left out, so are its children.
    gone = {n for n in network.bodies if set(_lineage(network, n)) & set(left_out)}
    needed = [n for n in _needed(network, anchors) if n in gone]
    if needed:
        raise NetworkError(_why_not_tied(network, needed[0], pairs, set(network.bodies) - gone))
    for name in gone:
        edges.pop(fr.body_frame(name), None)
        edges.pop(fr.axis_frame(name), None)
        warnings.append(
            _why_not_tied(network, name, pairs, set(network.bodies) - gone).split("; ")[0]
            + ": left out of the adjustment"
        )
    kept = sorted({e.index for e in edges.values() if e.kind != "static"})
    renumbered = {old: new for new, old in enumerate(kept)}
    edges = {f: e if e.kind == "static" else replace(e, index=renumbered[e.index]) for f, e in edges.items()}
    for camera in network.cameras:
        if camera.body not in gone and _camera_end(network, camera) in anchors:
            edges[fr.camera_frame(camera.name)] = fr.Edge(fr.body_frame(camera.body), "static", camera.mount)
    for marker in network.markers:
        if marker.body not in gone and _marker_end(network, marker) in anchors:
            edges[fr.marker_frame(marker.name)] = fr.Edge(fr.body_frame(marker.body), "static", marker.mount)
    edges[fr.TOOL] = fr.Edge(fr.body_frame(network.tool_body), "static", network.tool)
    frames = fr.Frames(edges)
    known_camera = np.array([fr.camera_frame(c.name) in frames for c in network.cameras], dtype=bool)
    known_marker = np.array([fr.marker_frame(m.name) in frames for m in network.markers], dtype=bool)
    used = known_camera[observations.camera] & known_marker[network.tag_marker[observations.tag]]
    return Tie(frames, tuple(variables[k] for k in kept), used, tuple(warnings))


def _root(network: Network, name: str) -> str:
    """The body that carries a joint's whole chain: the first ancestor that is no joint."""
    return _lineage(network, name)[-1]


def _lineage(network: Network, name: str) -> list[str]:
    line = [name]
    while network.bodies[line[-1]].kind == "joint":
        parent = network.bodies[line[-1]].parent
        assert parent is not None
        line.append(parent)
    return line


def _parents_first(network: Network) -> list[str]:
    return sorted(
        network.bodies, key=lambda n: len(_lineage(network, n)) if network.bodies[n].kind == "joint" else 0
    )


def _camera_end(network: Network, camera: Camera) -> str:
    """What a camera's observations tie: the body that carries it, or, where its mount is unknown, only itself."""
    if network.statics[camera.mount].surveyed:
        return _root(network, camera.body)
    return fr.camera_frame(camera.name)


def _marker_end(network: Network, marker: Marker) -> str:
    if network.statics[marker.mount].surveyed:
        return _root(network, marker.body)
    return fr.marker_frame(marker.name)


def _is_datum(network: Network, root: str) -> bool:
    body = network.bodies.get(root)
    if body is None:
        return False  # a camera or marker whose own mount is unknown
    if body.kind == "world":
        return True
    return body.kind == "static" and body.static is not None and network.statics[body.static].surveyed


def _anchors(network: Network, pairs: Counter) -> dict[str, str]:
    """For each root body that can be tied: the frame its pose is kept in (for a static one, the world).

    A camera or marker of unknown mount is an end of its own, found once its body and what it shares pictures with are.
    """
    roots = [n for n, b in network.bodies.items() if b.kind != "joint"]
    reached = {n for n in roots if _is_datum(network, n)}
    anchors = dict.fromkeys(reached, fr.WORLD)
    links = []
    carriers: dict[str, str] = {}
    for (c, m), count in pairs.items():
        camera, marker = network.cameras[c], network.markers[m]
        a, b = _camera_end(network, camera), _marker_end(network, marker)
        host_a, host_b = _root(network, camera.body), _root(network, marker.body)
        if a != b:
            links.append((count, a, b, camera, marker))
        carriers |= {end: host for end, host in ((a, host_a), (b, host_b)) if end != host}
    links.sort(key=lambda link: (-link[0], link[3].name, link[4].name))
    while True:
        # The link with most observations first, so that a body is kept in the frame that sees it best.
        found = None
        for _, a, b, camera, marker in links:
            new = a if b in reached else b
            if (a in reached) != (b in reached) and carriers.get(new, "world") in reached:
                found = a, b, camera, marker
                break
        if found is None:
            return anchors
        a, b, camera, marker = found
        new, other = (a, b) if b in reached else (b, a)
        if new in carriers:
            anchors[new] = fr.body_frame(carriers[new])
        elif network.bodies[new].kind == "static" or any(
            x == new and _is_datum(network, y) for _, x, y, _, _ in links
        ):
            anchors[new] = fr.WORLD
        elif new == b:
            anchors[new] = fr.camera_frame(camera.name)
        else:
            anchors[new] = fr.marker_frame(marker.name)
        assert other in reached
        reached.add(new)


def _joint_in_view(network: Network, joint: str, pairs: Counter) -> bool:
    """Whether some observation runs across this joint."""
    for c, m in pairs:
        a = _lineage(network, network.cameras[c].body)
        b = _lineage(network, network.markers[m].body)
        if (joint in a) != (joint in b):
            return True
    return False


def _needed(network: Network, anchors: dict[str, str]) -> list[str]:
    """The bodies between the cutting edge and the world, roots first."""
    line: list[str] = []
    at = network.tool_body
    while True:
        line += _lineage(network, at)
        anchor = anchors.get(line[-1], fr.WORLD)
        if anchor == fr.WORLD:
            return line[::-1]
        kind, name = anchor.split(" ", 1)
        hosts = network.cameras if kind == "camera" else network.markers
        at = next(h.body for h in hosts if h.name == name)


def _why_not_tied(network: Network, name: str, pairs: Counter, tied: set[str]) -> str:
    body = network.bodies[name]
    if body.kind == "joint" and (set(_lineage(network, name)) - {name}) <= tied:
        beyond = [n for n in network.bodies if name in _lineage(network, n)]
        markers = [m.name for m in network.markers if m.body in beyond]
        sensors = [s.name for s in network.sensors if s.joint == name]
        return (
            f"joint '{name}' has no reading of a sensor ({_listed(sensors)}) and no marker beyond it was seen "
            f"({_listed(markers)}); its angle is unknown: check the sensor's topic, or put a marker on it"
        )
    # Bodies that see each other but nothing surveyed are one fault, not several.
    tied_together: set[str] = set()
    grown = {_root(network, name)}
    while grown - tied_together:
        tied_together |= grown
        for c, m in pairs:
            ends = {_root(network, network.cameras[c].body), _root(network, network.markers[m].body)}
            if ends & tied_together and not any(_is_datum(network, end) for end in ends):
                grown |= ends
    roots = sorted(tied_together)
    family = [n for n in network.bodies if _root(network, n) in tied_together]
    cameras = [c.name for c in network.cameras if c.body in family]
    markers = [m.name for m in network.markers if m.body in family]
    surveyed = [m.name for m in network.markers if m.benchmark and network.statics[m.mount].surveyed]
    bodies = (
        f"body {_listed(roots)} is" if len(roots) == 1 else f"bodies {_listed(roots)} see each other but are"
    )
    return (
        f"{bodies} not tied to the datum: no camera on them ({_listed(cameras)}) saw a benchmark "
        f"({_listed(surveyed)}), no camera that is tied saw a marker on them ({_listed(markers)}); let a camera "
        f"on one of them see a benchmark, or let a camera that is tied see a marker on one of them"
    )


def _listed(names) -> str:
    return ", ".join(f"'{n}'" for n in names) if names else "none"


def _unseen(network: Network, pairs: Counter) -> list[str]:
    seen_markers, active = {m for _, m in pairs}, {c for c, _ in pairs}
    sentences = []
    for k, marker in enumerate(network.markers):
        if k not in seen_markers:
            sentences.append(
                f"benchmark '{marker.name}' was never seen: check its tag ids and family, and that a camera looks at it"
                if marker.benchmark
                else f"marker '{marker.name}' on '{marker.body}' was never seen by any camera"
            )
    for k, camera in enumerate(network.cameras):
        if k not in active:
            sentences.append(f"camera '{camera.name}' saw no known marker in the whole log")
    return sentences


def _adrift(network: Network, pairs: Counter, anchors: dict[str, str]) -> list[str]:
    """Sentences about cameras and markers of unknown mount that share no picture with anything that is tied."""
    seen_cameras, seen_markers = {c for c, _ in pairs}, {m for _, m in pairs}
    lost = [
        ("camera", c.name)
        for k, c in enumerate(network.cameras)
        if k in seen_cameras and _camera_end(network, c) not in {*anchors, *network.bodies}
    ]
    lost += [
        ("benchmark" if m.benchmark else "marker", m.name)
        for k, m in enumerate(network.markers)
        if k in seen_markers and _marker_end(network, m) not in {*anchors, *network.bodies}
    ]
    return [
        f"the place of {kind} '{name}' is unknown, and it shares no picture with anything whose place is known: left "
        "out of the adjustment"
        for kind, name in lost
    ]
