"""What an adjustment hands on: arrays for the tables ``states``, ``statics``, ``residuals``, and for solution.json."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.estimation.sensitivities import Sensitivities


@dataclass(frozen=True, eq=False)
class BodyStates:
    """One body (or ``tool``) at the epochs between its first and its last observation."""

    body: str
    time_ns: np.ndarray
    """(n,) int64."""
    T_world_body: np.ndarray
    """(n, 4, 4); world = grid minus the integer origin."""
    velocity: np.ndarray
    """(n, 6) m/s and rad/s in the body, translation first."""
    angle_rad: np.ndarray
    """(n,) of a joint; nan else."""
    sigma_angle_rad: np.ndarray
    """(n,) whole standard deviation of the angle; nan else."""
    seen: np.ndarray
    """(n,) bool: every link to the datum observed within max_gap_s; else bridged."""
    own: np.ndarray
    """(n, 6, 6) own part of the covariance of ``xi``, on the right of ``T_world_body``."""
    common: np.ndarray
    """(n, 6, 6) common part."""


@dataclass(frozen=True, eq=False)
class StaticResult:
    """One static after the adjustment, in coordinates a person can compare with the file."""

    quantity: str
    source: str
    components: tuple[str, ...]
    """A pose: origin in the parent, then rotation vector."""
    units: tuple[str, ...]
    file_value: np.ndarray
    value: np.ndarray
    prior_sigma: np.ndarray
    sigma: np.ndarray
    shift_sigmas: np.ndarray
    """(value - file_value) / prior_sigma; 0 where it is exact."""


@dataclass(frozen=True, eq=False)
class CornerResiduals:
    """Every corner after the adjustment, (n,) each, in the order of the observations handed in (by epoch)."""

    camera: np.ndarray
    """Index into the network's cameras."""
    marker: np.ndarray
    """Index into the network's markers."""
    tag_id: np.ndarray
    time_ns: np.ndarray
    corner: np.ndarray
    residual: np.ndarray
    """(n, 2) observed minus predicted, px."""
    sigma_px: np.ndarray
    normalised: np.ndarray
    """Length of the whitened residual."""
    weight: np.ndarray
    """1 = full, 0 = gross outlier."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The answer of the adjustment."""

    states: tuple[BodyStates, ...]
    statics: tuple[StaticResult, ...]
    residuals: CornerResiduals
    diagnostics: dict
    """For solution.json: plain numbers, strings, lists and dicts."""
    warnings: tuple[str, ...]
    sensitivities: Sensitivities | None = None
    """How the cutting edge answers to values of the files; None where there is no edge."""

    def body(self, name: str) -> BodyStates:
        """States of a body, or of ``tool``."""
        return next(s for s in self.states if s.body == name)
