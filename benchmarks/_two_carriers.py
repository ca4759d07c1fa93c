"""A log that GTSAM's own factors can express whole: two carriers in the world, three cameras, two surveyed boards.

A cab with two cameras and an arm with one drive about before two boards of one tag each. Unknown are, per epoch, pose
and velocity of both (24), and 42 statics: mounts and intrinsics of three cameras, poses of two boards. What GTSAM has
no factor for is left out: joints, sensors, a body whose pose is kept in a camera, distortion beyond what pinholes have,
robust loss. Corners come straight from the geometry, 0.2 px of noise, 10 Hz; the arm is blind in a fifth of the time.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from benchmarks._drawn_corners import CYCLE_S, FRAME_S, blind, noisy_corners, true_statics
from pipeline.config import Machine, Site
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.problem import Problem
from pipeline.geometry import se3, so3
from pipeline.network import Network, Observations, network_of
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation.simulator import MACHINE, SITE

BLIND_SHARE = 0.2
NO_LOSS = 1e6
"""A Huber threshold that nothing reaches: plain least squares."""


def network_of_two() -> Network:
    """The machine and the site, with nominal values."""
    machine: Any = copy.deepcopy(MACHINE)
    site: Any = copy.deepcopy(SITE)
    machine["bodies"] = {"cab": {"kind": "moving"}, "arm": {"kind": "moving"}}
    left, right = machine["cameras"]["bench"], machine["cameras"]["dig"]
    right["mount"]["rpy_deg"] = [-91.0, 0.0, -5.0]
    machine["cameras"] = {
        "left": left,
        "right": right,
        "arm": copy.deepcopy(left) | {"body": "arm", "topic": "/arm"},
    }
    for camera in machine["cameras"].values():
        camera["intrinsics"] |= {"distortion": [0.0] * 5, "sigma": [1.0] * 4 + [0.0] * 5}
    del machine["markers"], machine["sensors"]
    machine["cutting_edge"]["body"] = "arm"
    machine["cutting_edge"]["mount"] |= {"sigma_mm": 0.0, "sigma_deg": 0.0}
    machine["motion"] = {
        "cab": {"translation": 1e-3, "rotation": 3e-2},
        "arm": {"translation": 2e-2, "rotation": 3e-2},
    }
    site["benchmarks"] = {name: site["benchmarks"][name] for name in ("B1", "B2")}
    for board in site["benchmarks"].values():
        board["pose"] |= {"sigma_mm": 0.0, "sigma_deg": 0.0}
        board["tags"] = [{"id": board["tags"][0]["id"], "size_m": 0.5}]
    return network_of(Machine.model_validate(machine), Site.model_validate(site))


def corners_of_two(network: Network, epochs: int, seed: int = 0) -> Observations:
    """Noisy corners of a log of this length; the statics differ from the files by draws from their priors."""
    rng = np.random.default_rng(seed)
    truth = true_statics(rng, network)
    phase = 2 * np.pi * np.arange(epochs) * FRAME_S / CYCLE_S
    T_world = {
        "world": se3.identity((epochs,)),
        "cab": _swing(phase, 0.12, 0.02, 1.5),
        "arm": _swing(phase + 1, 0.15, 0.3, 1.2),
    }
    of_arm = blind(rng, epochs, BLIND_SHARE)
    never = np.zeros(epochs, dtype=bool)
    return noisy_corners(
        rng, network, truth, T_world, lambda c, m: of_arm if network.cameras[c].body == "arm" else never
    )


def problem_of_two(epochs: int) -> Problem:
    """The least-squares problem of such a log, at its start."""
    network = network_of_two()
    seen = corners_of_two(network, epochs)
    tied = tie(network, seen, {})
    assert all(tied.frames.edges[f"body {v.body}"].parent == "world" for v in tied.variables)
    return problem_of_log(network, tied, epochs_of(network, seen.take(tied.used), {}))


def _swing(phase, turn_rad: float, way_m: float, height_m: float):
    turn = np.stack([0.01 * np.sin(3 * phase), 0.01 * np.cos(2 * phase), turn_rad * np.sin(phase)], axis=-1)
    way = np.stack(
        [way_m * np.sin(2 * phase), way_m * np.cos(phase), height_m + way_m * np.sin(3 * phase)], axis=-1
    )
    return se3.from_rotation_translation(so3.exp(turn), way)
