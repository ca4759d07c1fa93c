"""The graph of a network, after Fig. 3 of the paper: what is known of what, what was seen, and which loops close.

Nodes are frames: the world, bodies, cameras, markers, and sensors. Links are poses from the files (a mount, a survey),
joints, and sightings. A body that moves freely has no link but those of what hangs on it. Every loop is a
condition that poses have to fulfil; what no way leads to from the datum cannot be known.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from pipeline.errors import NetworkError
from pipeline.network import frames as fr
from pipeline.network.datum import Tie, tie
from pipeline.network.model import Network, Observations, Readings

GAP_S = 10.0
"""A body that no picture shows for longer is named: states in longer gaps are held by the motion prior alone."""


@dataclass(frozen=True)
class Node:
    """One frame, or a sensor."""

    key: str
    kind: str
    """world, static, moving, joint, camera, marker, benchmark or sensor."""
    name: str


@dataclass(frozen=True)
class Link:
    """What is known between two nodes."""

    ends: tuple[str, str]
    kind: str
    """mount, survey, joint, reading, seen; ``may see`` where there is no log to tell."""
    count: int = 0
    """Frames in which it was seen, or readings."""


@dataclass(frozen=True)
class Graph:
    """A network as it is drawn and told."""

    nodes: tuple[Node, ...]
    links: tuple[Link, ...]
    loops: tuple[tuple[str, ...], ...]
    """Independent loops, each as the keys of its nodes in order."""
    measured: int
    """Coordinates of corners, and readings."""
    unknown: int
    """Coordinates of poses and angles at the epochs at which they were measured, and of poses that no file gives. The
    other statics have their priors."""
    untied: tuple[str, ...]
    """Sentences about what does not hang on the datum, or not all the time."""
    from_log: bool


def graph_of(
    network: Network,
    observations: Observations | None = None,
    readings: dict[str, Readings] | None = None,
) -> Graph:
    """The graph of a network; without observations, with every sighting that its cameras could make."""
    nodes = [Node(fr.WORLD, "world", fr.WORLD)]
    nodes += [Node(fr.body_frame(n), b.kind, n) for n, b in network.bodies.items() if b.kind != fr.WORLD]
    nodes += [Node(fr.camera_frame(c.name), "camera", c.name) for c in network.cameras]
    nodes += [
        Node(fr.marker_frame(m.name), "benchmark" if m.benchmark else "marker", m.name)
        for m in network.markers
    ]
    nodes += [Node(f"sensor {s.name}", "sensor", s.name) for s in network.sensors]
    links = list(_known_links(network))
    from_log = observations is not None
    if observations is None:
        observations, readings = _all_that_may_be(network)
    assert readings is not None
    links += [
        Link((f"sensor {s.name}", fr.body_frame(s.joint)), "reading", len(readings[s.name].raw))
        for s in network.sensors
        if s.name in readings
    ]
    links += _sightings(network, observations, from_log)
    loops = _loops(links) if from_log else ()
    try:
        tied = tie(network, observations, readings)
    except NetworkError as error:
        untied = [str(error)]
        measured = unknown = 0
    else:
        untied = list(tied.warnings) if from_log else [w for w in tied.warnings if "not tied" in w]
        measured, unknown = _balance(network, tied, observations, readings)
        untied += _gaps(network, tied, observations) if from_log else []
    if not from_log:
        measured = unknown = 0
    return Graph(tuple(nodes), tuple(links), tuple(loops), measured, unknown, tuple(untied), from_log)


def told(graph: Graph) -> list[str]:
    """The graph in words, line by line."""
    name = {node.key: node.name for node in graph.nodes}
    of_kind = Counter(node.kind for node in graph.nodes)
    lines = ["nodes: " + ", ".join(f"{count} {kind}" for kind, count in of_kind.items())]
    for title, kinds in (("mounted or surveyed", ("mount", "survey")), ("joints", ("joint",))):
        rows = [link for link in graph.links if link.kind in kinds]
        if rows:
            lines.append(
                f"{title}: " + ", ".join(f"{name[b]} on {name[a]}" for a, b in (r.ends for r in rows))
            )
    for link in graph.links:
        if link.kind == "reading":
            what = f" ({link.count} readings)" if graph.from_log else ""
            lines.append(f"sensor {name[link.ends[0]]} reads {name[link.ends[1]]}{what}")
    for kind, verb in (("seen", "saw"), ("may see", "may see")):
        by_camera: dict[str, list[str]] = {}
        for link in graph.links:
            if link.kind == kind:
                count = f" ({link.count})" if graph.from_log else ""
                by_camera.setdefault(link.ends[0], []).append(name[link.ends[1]] + count)
        lines += [f"camera {name[key]} {verb} {', '.join(seen)}" for key, seen in by_camera.items()]
    if graph.from_log:
        lines.append(f"loops: {len(graph.loops) or 'none'}")
        lines += ["  " + " - ".join(name[key] for key in loop) for loop in graph.loops]
        lines.append(
            f"redundancy: {graph.measured - graph.unknown} = {graph.measured} measured coordinates and readings - "
            f"{graph.unknown} unknown coordinates of poses and angles"
        )
    else:
        lines.append(
            "which camera sees which marker, and so the loops and the redundancy, only a log can tell"
        )
    lines += [f"! {sentence}" for sentence in graph.untied]
    if not graph.untied:
        lines.append(
            "everything is tied to the datum" if graph.from_log else "everything can be tied to the datum"
        )
    return lines


def _known_links(network: Network):
    for name, body in network.bodies.items():
        if body.kind == "joint":
            assert body.parent is not None
            yield Link((fr.body_frame(body.parent), fr.body_frame(name)), "joint")
            if body.follows is not None:
                yield Link((fr.body_frame(body.follows), fr.body_frame(name)), "belt")
        elif body.kind == "static" and body.static is not None and network.statics[body.static].surveyed:
            yield Link((fr.WORLD, fr.body_frame(name)), "survey")
    for camera in network.cameras:
        kind = "survey" if camera.body == fr.WORLD else "mount"
        yield Link((fr.body_frame(camera.body), fr.camera_frame(camera.name)), kind)
    for marker in network.markers:
        if marker.benchmark and not network.statics[marker.mount].surveyed:
            continue
        kind = "survey" if marker.body == fr.WORLD else "mount"
        yield Link((fr.body_frame(marker.body), fr.marker_frame(marker.name)), kind)


def _sightings(network: Network, observations: Observations, from_log: bool) -> list[Link]:
    marker_of = network.tag_marker[observations.tag]
    rows = np.unique(np.stack([observations.camera, marker_of, observations.time_ns]), axis=1)
    counts = Counter(zip(rows[0].tolist(), rows[1].tolist(), strict=True))
    return [
        Link(
            (fr.camera_frame(network.cameras[c].name), fr.marker_frame(network.markers[m].name)),
            "seen" if from_log else "may see",
            count if from_log else 0,
        )
        for (c, m), count in sorted(counts.items())
    ]


def _all_that_may_be(network: Network) -> tuple[Observations, dict[str, Readings]]:
    """One sighting of every marker by every camera that does not ride with it, and one reading of every sensor."""
    first_tag = {int(m): k for k, m in reversed(list(enumerate(network.tag_marker)))}
    pairs = [
        (c, first_tag[m])
        for c, camera in enumerate(network.cameras)
        for m, marker in enumerate(network.markers)
        if camera.body != marker.body
    ]
    n = len(pairs)
    at = np.array(pairs, dtype=np.int64).reshape(n, 2)
    seen = Observations(
        at[:, 0], at[:, 1], np.zeros(n, dtype=np.int64), np.zeros((n, 4, 2)), np.zeros((n, 4, 2, 2))
    )
    return seen, {s.name: Readings(np.zeros(1, dtype=np.int64), np.zeros(1)) for s in network.sensors}


def _loops(links: list[Link]) -> list[tuple[str, ...]]:
    """Fundamental loops: each link that the breadth-first tree leaves out closes one."""
    solid = [link for link in links if link.kind not in ("reading", "belt")]
    ways: dict[str, list[tuple[str, int]]] = {}
    for k, link in enumerate(solid):
        a, b = link.ends
        ways.setdefault(a, []).append((b, k))
        ways.setdefault(b, []).append((a, k))
    above: dict[str, str | None] = {}
    used = set()
    for root in [fr.WORLD, *ways]:
        if root in above or root not in ways:
            continue
        above[root] = None
        queue = deque([root])
        while queue:
            at = queue.popleft()
            for other, k in ways[at]:
                if other not in above:
                    above[other] = at
                    used.add(k)
                    queue.append(other)

    def upward(key):
        way = [key]
        while (up := above[way[-1]]) is not None:
            way.append(up)
        return way

    loops = []
    for k, link in enumerate(solid):
        if k not in used:
            a, b = (upward(end) for end in link.ends)
            top = next(key for key in a if key in b)
            loops.append((*a[: a.index(top) + 1], *reversed(b[: b.index(top)])))
    return loops


def _balance(network: Network, tied: Tie, observations: Observations, readings) -> tuple[int, int]:
    """Measured and unknown coordinates, counted."""
    when: list[list[np.ndarray]] = [[] for _ in tied.variables]
    measured = 8 * int(np.sum(tied.used))
    for path, rows in _groups(network, tied, observations):
        for step in path:
            if step.edge.kind != "static":
                when[step.edge.index].append(observations.time_ns[rows])
    for sensor in network.sensors:
        for k, variable in enumerate(tied.variables):
            if variable.body == sensor.joint and sensor.name in readings:
                when[k].append(readings[sensor.name].time_ns)
                measured += len(readings[sensor.name].raw)
    unknown = sum(
        v.half * len(np.unique(np.concatenate(t))) for v, t in zip(tied.variables, when, strict=True) if t
    )
    told_by_log = {e.index for e in tied.frames.edges.values() if e.kind == "static"}
    return measured, unknown + 6 * sum(not network.statics[k].surveyed for k in told_by_log)


def _gaps(network: Network, tied: Tie, observations: Observations) -> list[str]:
    """When a moving body was out of every picture that could tell where it is."""
    seen: list[list[np.ndarray]] = [[] for _ in tied.variables]
    for path, rows in _groups(network, tied, observations):
        for step in path:
            if step.edge.kind == "moving":
                seen[step.edge.index].append(observations.time_ns[rows])
    sentences = []
    whole = observations.time_ns
    for variable, stamps in zip(tied.variables, seen, strict=True):
        if not stamps:
            continue
        t = np.unique(np.concatenate([*stamps, [whole.min(), whole.max()]]))
        for k in np.flatnonzero(np.diff(t) > GAP_S * 1e9):
            a, b = ((int(t[i]) - int(whole.min())) * 1e-9 for i in (k, k + 1))
            sentences.append(
                f"body '{variable.body}' is in no picture that ties it from {a:.1f} to {b:.1f} s of the log "
                f"({b - a:.0f} s): bridged by the motion prior, or left out before its first and after its last picture"
            )
    return sentences


def _groups(network: Network, tied: Tie, observations: Observations):
    """Path and rows of each pair of camera and marker that counts."""
    marker_of = network.tag_marker[observations.tag]
    for c, camera in enumerate(network.cameras):
        for m, marker in enumerate(network.markers):
            rows = np.flatnonzero((observations.camera == c) & (marker_of == m) & tied.used)
            if len(rows):
                yield tied.frames.path(fr.camera_frame(camera.name), fr.marker_frame(marker.name)), rows
