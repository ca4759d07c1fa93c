"""What a change of the set-up would bring, and the best place for the next benchmark."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry import se3
from pipeline.network.build import UNKNOWN_SIGMA
from pipeline.network.model import POSE_COMPONENTS, POSE_UNITS, Marker, Network, Static
from pipeline.planning.postures import Postures, world_poses
from pipeline.planning.prediction import Setup, predict

LOST_M = 0.1
"""What an edge that is not seen counts with, beside the sigmas of those that are."""


def with_larger_tags(network: Network, factor: float, benchmarks: bool) -> Network:
    """All tags of the benchmarks, or of the machine, larger by a factor; their board grows with them."""
    of_benchmark = np.array([network.markers[m].benchmark for m in network.tag_marker], bool)
    grown = np.where((of_benchmark == benchmarks)[:, None, None], factor, 1.0)
    return replace(network, tag_corners=network.tag_corners * grown)


def with_longer_lens(network: Network, factor: float, camera: str) -> Network:
    """One camera's focal length larger by a factor, on the same sensor; its picture shows less."""
    index = next(c.intrinsics for c in network.cameras if c.name == camera)
    old = network.statics[index]
    value = old.value.copy()
    value[:2] *= factor
    return _with_static(network, index, replace(old, value=value))


def with_better(network: Network, source: str, factor: float) -> Network:
    """Every sigma of one source smaller by a factor."""
    statics = tuple(
        replace(s, covariance=s.covariance / factor**2) if s.source == source else s for s in network.statics
    )
    return replace(network, statics=statics)


def with_benchmark(network: Network, T_world_marker, like: str, name: str = "new") -> Network:
    """One more benchmark, with the print and the survey's sigma of one that is there."""
    k = next(k for k, m in enumerate(network.markers) if m.name == like)
    model = network.markers[k]
    old = network.statics[model.mount]
    pose = Static(
        f"benchmark {name} pose",
        old.source,
        True,
        np.asarray(T_world_marker, float),
        old.covariance,
        POSE_COMPONENTS,
        POSE_UNITS,
    )
    tags = np.flatnonzero(network.tag_marker == k)
    # Its ids need only differ from the others'.
    first = int(network.tag_id.max()) + 1
    return replace(
        network,
        statics=(*network.statics, pose),
        markers=(*network.markers, Marker(name, model.body, len(network.statics), True)),
        tag_marker=np.append(network.tag_marker, np.full(len(tags), len(network.markers))),
        tag_family=(*network.tag_family, *(network.tag_family[t] for t in tags)),
        tag_id=np.append(network.tag_id, first + np.arange(len(tags))),
        tag_corners=np.concatenate([network.tag_corners, network.tag_corners[tags]]),
    )


def _with_static(network: Network, index: int, static: Static) -> Network:
    statics = [*network.statics]
    statics[index] = static
    return replace(network, statics=tuple(statics))


@dataclass(frozen=True)
class Gain:
    """The work with one change."""

    name: str
    """Key of the change; of a lens with the camera after a colon."""
    sigma_m: float
    """Median over the work of the edge's elevation, where it is seen."""
    seen: float
    """Share of the work."""
    score_m: float
    """Root of the mean variance, ``LOST_M`` where it is not seen."""


def gain_of(name: str, setup: Setup, work: Postures) -> Gain:
    """The figures of a set-up over the work."""
    sigma = predict(setup, work).edge.sigma_h()
    seen = np.isfinite(sigma)
    score = np.sqrt(np.mean(np.where(seen, np.minimum(np.nan_to_num(sigma), LOST_M), LOST_M) ** 2))
    return Gain(
        name, float(np.median(sigma[seen])) if seen.any() else float("nan"), float(seen.mean()), float(score)
    )


def gains(setup: Setup, work: Postures) -> list[Gain]:
    """The set-up as it is, and with one change at a time."""
    net = setup.network
    out = [gain_of("as it is", setup, work)]

    def add(name: str, changed: Network) -> None:
        out.append(gain_of(name, replace(setup, network=changed), work))

    add("larger benchmark tags", with_larger_tags(net, 1.5, True))
    add("larger machine tags", with_larger_tags(net, 1.5, False))
    for camera in net.cameras:
        add(f"longer lens:{camera.name}", with_longer_lens(net, 1.5, camera.name))
    for source in ("benchmarks", "mounts", "intrinsics", "linkage and sensor", "cutting edge"):
        add(f"better {source}", with_better(net, source, 2.0))
    faster = replace(setup.looking, frame_s=0.5 * setup.looking.frame_s,
                     readings_per_look=max(0.5 * setup.looking.readings_per_look, 1.0))  # fmt: skip
    out.append(gain_of("twice the frames", replace(setup, looking=faster), work))
    return out


@dataclass(frozen=True, eq=False)
class Place:
    """A place for one more benchmark."""

    T_world_marker: np.ndarray
    """(4, 4)."""
    like: str
    gain: Gain


def facing_print(p_world, towards):
    """``T_world_marker`` of an upright print at a place that faces another, (4, 4)."""
    z = np.asarray(towards, float)[:2] - np.asarray(p_world, float)[:2]
    z = np.append(z / np.linalg.norm(z), 0.0)
    x = np.cross([0.0, 0.0, 1.0], z)
    R = np.stack([x, np.cross(z, x), z], axis=-1)
    return se3.from_rotation_translation(R, np.asarray(p_world, float))


def best_place(setup: Setup, work: Postures, candidates, benchmark: str) -> tuple[Place, list[Place]]:
    """Where one more benchmark like another brings most, by trying places.

    Parameters
    ----------
    setup : Setup
        As it is.
    work : Postures
        A few dozen of the work.
    candidates : (k, 3) array
        Places of the print's centre, world; it faces the middle of the cameras that look at benchmarks.
    benchmark : str
        Name of the one that it is like.

    Returns
    -------
    best : Place
        Of the lowest score.
    all : list of Place
        Of every candidate, in their order.
    """
    T_world = world_poses(setup.network, work)
    eyes = [(T_world[c.body] @ setup.network.statics[c.mount].value)[:, :3, 3] for c in setup.network.cameras]
    towards = np.median(np.concatenate(eyes), axis=0)
    places = []
    for p in np.asarray(candidates, float):
        T = facing_print(p, towards)
        network = with_benchmark(setup.network, T, benchmark)
        places.append(
            Place(T, benchmark, gain_of("one more benchmark", replace(setup, network=network), work))
        )
    return min(places, key=lambda place: place.gain.score_m), places


def largest_benchmark(network: Network) -> str | None:
    """Name of the surveyed benchmark with the largest tags, None without one."""
    best, side = None, 0.0
    for k, marker in enumerate(network.markers):
        if not marker.benchmark or network.statics[marker.mount].covariance[0, 0] >= UNKNOWN_SIGMA[0] ** 2:
            continue
        corners = network.tag_corners[network.tag_marker == k]
        size = float(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=-1).max()) if len(corners) else 0.0
        if size > side:
            best, side = marker.name, size
    return best
