"""The adjustment of a calibration's network, with the whole covariance of whatever it tells.

The calibration graph (Fig. 6 of the paper) is a network like any other; what is to be told has no mount, or a wide one.
The report needs only standard deviations of statics; a machine file needs their covariances, so the steps of
`estimation.adjust` are taken here one by one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.config.site import EstimationSettings
from pipeline.errors import CalibrationError
from pipeline.estimation import diagnostics
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.densities import PARKED
from pipeline.estimation.marginals import Marginals, marginals
from pipeline.estimation.observability import Finding, findings
from pipeline.estimation.optimise import Optimum, optimise
from pipeline.estimation.problem import Problem
from pipeline.estimation.repeated import Repeated, with_offsets
from pipeline.estimation.solution import CornerResiduals
from pipeline.estimation.variances import settle
from pipeline.geometry import se3
from pipeline.network import frames as fr
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from pipeline.network.model import Network, Observations, Readings

STOP_S = 1.0
"""What shows nothing but noise for this long stands still, and the log tells how still: so pictures of two cameras at
one stop are of one pose. Of six drawn machines whose motion prior was that of the files at their stops too, cameras
against each other were off by 0.63 of their sigma; now by 0.85, and by two thirds of what they were. Densities of
motion are not learned here: a swing is no white noise, it comes back with every stop. Learned, they were a
ten-thousandth for all axes but the one it turns about, and errors were 1.4 sigmas. What of a corner's error comes back
is learned along with them."""

SCATTER = (0.4, 10.0)
"""Bounds of the variance that a log's corners are believed to have, of the stated one. On the sample's log of stops it
is 0.66; with the stated one cameras against each other were off by 0.85 of their sigma, 98.5 % of 720 figures within
1.96 sigmas (120 machines), with that of the log by 0.92, 96.7 % (60)."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A calibration's network at its optimum."""

    problem: Problem
    optimum: Optimum
    found: Marginals
    residuals: CornerResiduals
    sigma0: float
    """Root of the variance component: 1 where corners scatter as detection says."""
    warnings: tuple[str, ...]
    untold: tuple[Finding, ...]
    """What the log cannot tell or part, all of it; the warnings hold what matters whatever is calibrated."""

    @property
    def network(self) -> Network:
        return self.problem.network

    def index(self, name: str) -> int:
        """Of a static by its name. KeyError where there is none."""
        for k, static in enumerate(self.network.statics):
            if static.name == name:
                return k
        raise KeyError(name)

    def columns(self, name: str) -> np.ndarray:
        """Places of a static's unknowns in ``z``, (r,)."""
        return self.problem.statics.columns[self.index(name)]

    def value(self, name: str) -> np.ndarray:
        """(4, 4) pose or (n,) vector of a static."""
        return np.array(self.problem.statics.value(self.index(name), self.optimum.values.z))

    def sensitivity(self, name: str) -> np.ndarray:
        """(n, r) right perturbation (or change) of a static by its unknowns."""
        return self.problem.statics.sensitivity(self.index(name), self.optimum.values.z)

    def covariance(self, name: str, other: str | None = None) -> np.ndarray:
        """(n, n) covariance of a static, or (n, m) with another one; eq. (3) of the paper, m and rad for poses."""
        other = name if other is None else other
        P = self.found.P_zz[np.ix_(self.columns(name), self.columns(other))]
        return self.sensitivity(name) @ P @ self.sensitivity(other).T

    def pose_of_body(self, body: str) -> np.ndarray:
        """(E, 4, 4) ``T_world_body`` at the epochs."""
        path = self.problem.tie.frames.path(fr.WORLD, fr.body_frame(body))
        values, statics = self.optimum.values, self.problem.statics
        _, T = fr.along(path, lambda edge: values.edge_pose(statics, edge))
        return np.broadcast_to(T, (len(self.problem.epochs.time_ns), 4, 4))


def adjusted(
    network: Network,
    observations: Observations,
    readings: dict[str, Readings] | None = None,
    settings: EstimationSettings | None = None,
    repeated: Repeated | None = None,
    scaled: bool = False,
) -> Adjusted:
    """Adjust a calibration's network.

    Parameters
    ----------
    network : Network
        The tool hangs on a body that the log ties, or there is no answer.
    observations, readings
        What was seen and read.
    settings : EstimationSettings, optional
        Those of site.toml.
    repeated : Repeated, optional
        What of a corner's error comes back: left out, as rendered and recorded logs have it.
    scaled : bool
        Whether corners get the variance that they scatter by in this log (its sigma0 squared), as those of a lens do;
        what of their errors comes back in every picture keeps its own.

    Raises
    ------
    NetworkError
        A body is tied to nothing surveyed.
    CalibrationError
        Nothing was seen, or the adjustment finds no answer.
    """
    settings = settings or EstimationSettings()
    repeated = Repeated() if repeated is None else repeated
    if len(observations.camera) == 0:
        raise CalibrationError(
            "no camera saw a marker of machine.toml or site.toml in this log; check the tags' ids and family"
        )
    network = with_offsets(network, observations, repeated)
    tied = tie(network, observations, readings or {})
    epochs = epochs_of(network, observations.take(tied.used), readings or {})
    problem = problem_of_log(network, tied, epochs, repeated)
    optimum = optimise(problem, settings.huber, settings.max_iterations)
    if not optimum.converged:
        raise CalibrationError(
            f"the adjustment found no answer: after {optimum.iterations} iterations it still moves by "
            f"{optimum.last_step_sigmas:.2g} sigma; something in machine.toml or site.toml contradicts the log, "
            "most often a tag's size or a benchmark's place"
        )
    settled = settle(problem, optimum, settings, repeated, window_s=STOP_S, classes=(PARKED,))
    problem, optimum = settled.problem, settled.optimum
    # The report frees its statics of the motion prior (`estimation.pull`), whose pull grows with the log: 2e-4 sigma
    # an epoch. Here logs are of a minute, and the prior is what ties pictures of cameras that take turns: without it a
    # cluster of two that stood still had 11 mm and 0.27 deg instead of 1 mm and 0.01 deg.
    found = marginals(problem, optimum.values, optimum.weights, optimum.eased)
    at = problem, optimum.values, optimum.weights, found
    corners = diagnostics.fit_corners(*at)
    variance = diagnostics.variance_component(corners + diagnostics.fit_sensors(*at), settings.huber)
    residuals = diagnostics.corner_table(problem, corners)
    of_corners = diagnostics.variance_component(corners, settings.huber)["sigma0_squared"]
    if scaled and of_corners:
        factor = float(np.clip(of_corners, *SCATTER)) ** -0.5
        groups = tuple(replace(group, whitener=factor * group.whitener) for group in problem.corners)
        trial = replace(problem, corners=groups, first=optimum.values)
        told = optimise(trial, settings.huber, settings.max_iterations, True)
        if told.converged:
            problem, optimum = trial, told
            found = marginals(problem, optimum.values, optimum.weights, optimum.eased)
    untold = findings(problem)
    sentences = [w for w in tied.warnings if "never seen" not in w]  # of a yard's markers some always are
    sentences += [f.sentence for f in untold if f.kind in ("gauge", "line")]
    if settled.rounds == 0:
        sentences.append(
            "how still the machine stood at its stops could not be told from the log: pictures of several cameras at "
            "one stop are tied by the motion prior of machine.toml, and are less sure than they could be"
        )
    sentences += diagnostics.stiff_motion(diagnostics.motion_fit(problem, optimum.values))
    return Adjusted(
        problem,
        optimum,
        found,
        residuals,
        float(variance["sigma0_squared"] or np.nan) ** 0.5,
        tuple(sentences),
        untold,
    )


def halves_disagree(
    whole: Adjusted, odd: Adjusted, even: Adjusted, names: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """What odd and even instants apart say of some poses, and how far apart they may be.

    Either half has the same priors, so their errors are correlated. With ``H_i = P_i^-1 - I`` the information of a
    half's pictures, its error is ``P_i (J_i' noise_i - error of the priors)``, and

        cov(z_1 - z_2) = P_1 H_1 P_1 + P_2 H_2 P_2 + (P_1 - P_2)²

    Parameters
    ----------
    whole, odd, even : Adjusted
        Of one network, that of the whole: a tag that one half never saw has its errors among the statics there too.
    names : list of str
        Statics that are poses.

    Returns
    -------
    difference : (k, 6) array
        ``xi`` of each pose, odd against even, m and rad.
    sigma : (k, 6, 6) array
        Its covariance.
    """
    difference, covariance = [], []
    P_1, P_2 = odd.found.P_zz, even.found.P_zz
    eye = np.eye(len(P_1))
    both = P_1 @ (np.linalg.inv(P_1) - eye) @ P_1 + P_2 @ (np.linalg.inv(P_2) - eye) @ P_2
    both += (P_1 - P_2) @ (P_1 - P_2)
    for name in names:
        difference.append(se3.local(odd.value(name), even.value(name)))
        J = whole.sensitivity(name)
        at = whole.columns(name)
        covariance.append(J @ both[np.ix_(at, at)] @ J.T)
    return np.array(difference), np.array(covariance)
