"""From postures to the edge's predicted covariance in one step, for maps, lines and changes of the set-up."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.network.model import Network
from pipeline.planning.edge import EdgePlan, edge_plan
from pipeline.planning.looks import Looking, Looks, looks
from pipeline.planning.postures import Arm, Postures, world_poses
from pipeline.planning.sight import Sight, SightRules, sight


@dataclass(frozen=True, eq=False)
class Setup:
    """A machine on a site, and how it looks around."""

    network: Network
    arm: Arm | None
    """Hides tags; None hides none."""
    arm_bodies: tuple[str, str]
    """The cab and the stick."""
    looking: Looking = field(default_factory=Looking)
    rules: SightRules = field(default_factory=SightRules)
    looks: float = 300.0
    """Over the shift, each from another posture: they calibrate what the files state only roughly."""
    densities: dict[str, tuple] = field(default_factory=dict)
    """Of motion, where a log told them; see ``edge_plan``."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Of n postures."""

    edge: EdgePlan
    sight: Sight
    found: Looks
    S: np.ndarray
    """(p, p) information of the statics after the shift."""


def predict(setup: Setup, work: Postures, share=None) -> Prediction:
    """The edge over the postures of the work, whose looks also calibrate the statics."""
    seen = _sight(setup, work)
    found = looks(setup.network, work, seen, setup.looking, share)
    S = found.statics_information(setup.looks / len(work))
    return Prediction(edge_plan(found, S, setup.looking, setup.densities), seen, found, S)


def predict_elsewhere(setup: Setup, postures: Postures, shift: Prediction) -> Prediction:
    """The edge at other postures, with the statics as the shift leaves them.

    What only these postures see, such as the constant errors of a tag's corners that no look of the work shows, has its
    prior.
    """
    seen = _sight(setup, postures)
    found = looks(setup.network, postures, seen, setup.looking, like=shift.found)
    S = np.eye(found.statics.size)
    place = {s.name: k for k, s in enumerate(found.network.statics)}
    # Put together with the shift's looks, these have all statics that those have, and perhaps more.
    at = np.concatenate([found.statics.columns[place[static.name]] for static in shift.found.network.statics])
    S[np.ix_(at, at)] = shift.S
    return Prediction(edge_plan(found, S, setup.looking, setup.densities), seen, found, S)


def _sight(setup: Setup, postures: Postures) -> Sight:
    T_world = world_poses(setup.network, postures)
    return sight(setup.network, T_world, setup.rules, setup.arm, setup.arm_bodies)
