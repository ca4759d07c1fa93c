"""Any network of the docs with everything drawn: statics, motion, corners, readings and time offsets.

Other than ``tests/network/drawing.py``, which lets bodies sway by sines, the truth moves as the motion prior says, in
the frame in which a body's pose is kept, and the truth of every static is told: so errors can be held against
covariances one by one. Pictures are OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from pipeline.config import load_machine, load_site
from pipeline.config.machine import Motion
from pipeline.config.site import EstimationSettings
from pipeline.estimation.adjust import problem_of_log, solution_of
from pipeline.estimation.marginals import marginals
from pipeline.estimation.optimise import optimise, unpulled
from pipeline.geometry import linkage, se3
from pipeline.network import Network, Observations, Readings, network_of
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation import simulator
from tests.network.drawing import Scene

MOVING, JOINT = (2e-4, 5e-5), (1e-9, 3e-3)
"""Densities of what is drawn, and of the network that adjusts it: five seconds stay in view."""
FRAME_S = 0.2


@dataclass
class Drawn:
    """One network and its truth."""

    network: Network
    observations: Observations
    readings: dict[str, Readings]
    time_ns: np.ndarray
    """(E,) every instant of the truth."""
    frame_ns: np.ndarray
    """(F,) stamps of pictures."""
    T_world: dict[str, np.ndarray]
    """Body or tool -> (E, 4, 4)."""
    statics: list[np.ndarray]
    """True value of every static."""
    carrier: dict[str, str]
    """Bodies whose pose is kept in a camera."""


def draw(scene: Scene, seed: int, frames: int = 15, carried: dict[str, str] | None = None) -> Drawn:
    """One drawn network of a scene.

    ``carried`` names the camera in which a body's pose is kept, as the adjustment chooses it; other bodies are kept in
    the world.
    """
    rng = np.random.default_rng(seed)
    carried = carried or {}
    texts = scene.files()
    machine, site = load_machine(texts[0], "machine.toml"), load_site(texts[1], "site.toml")
    network = network_of(machine, site)
    bodies = {
        name: replace(b, motion={"moving": MOVING, "joint": JOINT}.get(b.kind, b.motion))
        for name, b in network.bodies.items()
    }
    network = replace(network, bodies=bodies)
    truth = []
    for static in network.statics:
        values, vectors = np.linalg.eigh(static.covariance)
        error = vectors @ (np.sqrt(np.maximum(values, 0)) * rng.standard_normal(len(values)))
        truth.append(static.value @ se3.exp(error) if static.is_pose else static.value + error)
    by_name = {s.name: value for s, value in zip(network.statics, truth, strict=True)}

    frame_ns = simulator.T0_NS + np.round(np.arange(frames) * FRAME_S * 1e9).astype(np.int64)
    reading_ns = {}
    for sensor in network.sensors:
        jitter = rng.uniform(0.2, 0.5, frames) * FRAME_S
        reading_ns[sensor.name] = simulator.T0_NS + np.round(
            (np.arange(frames) * FRAME_S + jitter) * 1e9
        ).astype(np.int64)
    time_ns = np.unique(np.concatenate([frame_ns, *reading_ns.values()]))
    t = (time_ns - simulator.T0_NS) * 1e-9
    T_world, angles = _bodies(rng, network, by_name, scene, carried, t)
    T_world["tool"] = T_world[network.tool_body] @ by_name["cutting edge mount"]

    readings = {}
    for sensor in network.sensors:
        angle = angles[sensor.joint][np.searchsorted(time_ns, reading_ns[sensor.name])]
        measured = np.rad2deg(angle)
        if sensor.linkage is not None:
            measured = linkage.cylinder_length(angle, truth[sensor.linkage], sensor.side)
        c0, c1 = truth[sensor.curve]
        raw = (measured - c0) / c1 + sensor.noise * rng.standard_normal(len(angle))
        late_ns = round(truth[sensor.offset][0] * 1e9)  # the stamp is earlier than the truth by the offset
        readings[sensor.name] = Readings(reading_ns[sensor.name] - late_ns, raw)
    options = simulator.Options(epochs=frames, frame_s=FRAME_S)
    seen = simulator._look(rng, network, by_name, T_world, time_ns, frame_ns, options)
    keep = np.ones(len(seen.camera), dtype=bool)
    for key in scene.hidden:
        camera, _, marker = key.rpartition(">")
        hidden = np.array([m.name == marker for m in network.markers])[network.tag_marker[seen.tag]]
        keep &= ~(hidden & (seen.camera == network.camera_index(camera)))
    return Drawn(network, seen.take(keep), readings, time_ns, frame_ns, T_world, truth, carried)


def _bodies(rng, network, by_name, scene, carried, t):
    T_world: dict[str, np.ndarray] = {}
    angles = {}
    waiting = [name for name in network.bodies if name != "world"]
    density = Motion(translation=MOVING[0], rotation=MOVING[1])
    while waiting:
        name = waiting.pop(0)
        body = network.bodies[name]
        camera = next((c for c in network.cameras if c.name == carried.get(name)), None)
        needed = body.parent if body.kind == "joint" else None if camera is None else camera.body
        if needed is not None and needed not in T_world:
            waiting.append(name)
            continue
        centre = scene.courses[name].centre
        if body.kind == "joint":
            angle, _ = simulator._turn(rng, np.deg2rad(centre), t, JOINT[1])
            angles[name] = angle
            T_world[name] = T_world[needed] @ by_name[f"joint {name} axis"] @ simulator.rotz(angle)
            continue
        T_start = simulator.level(centre[:3])
        T_carrier = se3.identity((len(t),))
        if camera is not None:
            T_carrier = T_world[needed] @ by_name[f"camera {camera.name} mount"]
            T_start = se3.inverse(T_carrier[0]) @ T_start
        T_world[name] = T_carrier @ simulator._wander(rng, T_start, t, density)
    return T_world, angles


@dataclass(frozen=True)
class Errors:
    """Of many drawn networks, at one frame each; standard normal if the covariances are true."""

    edge: np.ndarray
    """(runs, 3) whitened error of the middle of the cutting edge."""
    axes: np.ndarray
    """(runs, 3) z-scores of it along the axes of the grid."""
    pose: np.ndarray
    """(runs, 6) whitened error of the pose of the cutting edge."""
    statics: np.ndarray
    """(runs, p) whitened errors of all statics together."""
    components: np.ndarray
    """(runs, p) z-scores of the statics' unknowns one by one."""


def errors(scene: Scene, carried, runs: int, trust_files: bool = False, seed: int = 5000) -> Errors:
    """Draw, adjust and compare.

    ``trust_files`` takes the files as exact though the statics are drawn: the border of the normal matrix off.
    """
    out: dict[str, list] = {name: [] for name in Errors.__dataclass_fields__}
    settings = EstimationSettings()
    for run in range(runs):
        drawn = draw(scene, seed + run, carried=carried)
        network = drawn.network
        if trust_files:
            network = replace(
                network,
                statics=tuple(replace(s, covariance=np.zeros_like(s.covariance)) for s in network.statics),
            )
        tied = tie(network, drawn.observations, drawn.readings)
        kept = {v.body: tied.frames.edges[f"body {v.body}"].parent for v in tied.variables}
        assert all(kept[body] == f"camera {camera}" for body, camera in drawn.carrier.items()), kept
        epochs = epochs_of(network, drawn.observations.take(tied.used), drawn.readings)
        problem = problem_of_log(network, tied, epochs)
        optimum = unpulled(problem, optimise(problem, settings.huber, settings.max_iterations))
        tool = solution_of(problem, optimum, settings).body("tool")
        rows = np.flatnonzero(np.isin(tool.time_ns, drawn.frame_ns))
        k = rows[np.random.default_rng(run).integers(len(rows))]
        T = tool.T_world_body[k]
        xi = se3.local(T, drawn.T_world["tool"][np.searchsorted(drawn.time_ns, tool.time_ns[k])])
        P = (tool.own + tool.common)[k]
        R = T[:3, :3]
        out["edge"].append(np.linalg.solve(np.linalg.cholesky(P[:3, :3]), xi[:3]))
        out["axes"].append((R @ xi[:3]) / np.sqrt(np.diagonal(R @ P[:3, :3] @ R.T)))
        out["pose"].append(np.linalg.solve(np.linalg.cholesky(P), xi))
        z, P_zz = _static_errors(problem, optimum, drawn.statics)
        out["statics"].append(scipy.linalg.solve_triangular(np.linalg.cholesky(P_zz), z, lower=True))
        out["components"].append(z / np.sqrt(np.diagonal(P_zz)))
    return Errors(**{name: np.array(values) for name, values in out.items()})


def _static_errors(problem, optimum, truth):
    """True minus adjusted unknowns of the statics, and their covariance."""
    statics, z = problem.statics, np.zeros(problem.statics.size)
    for k, value in enumerate(truth):
        if len(statics.columns[k]):
            off = se3.local(statics.base[k], value) if statics.is_pose[k] else value - statics.base[k]
            z[statics.columns[k]] = np.linalg.lstsq(statics.scale[k], off, rcond=None)[0]
    if not len(z):
        return z, np.zeros((0, 0))
    return z - optimum.values.z, marginals(problem, optimum.values, optimum.weights, optimum.eased).P_zz
