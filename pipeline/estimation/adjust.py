"""The adjustment of a whole log at once: eq. (1) to (3) of the paper, with its statics among the unknowns."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from pipeline.config.site import EstimationSettings
from pipeline.errors import EstimationError
from pipeline.estimation import diagnostics, observability
from pipeline.estimation.checkpoint import FORGETFUL, Checkpoint
from pipeline.estimation.densities import described, shaking, spells
from pipeline.estimation.likelihood import log_likelihood
from pipeline.estimation.optimise import Optimum, optimise, unpulled
from pipeline.estimation.problem import Problem, problem_of
from pipeline.estimation.published import published
from pipeline.estimation.repeated import SOURCE as CORNERS
from pipeline.estimation.repeated import WHITE, Repeated, with_offsets
from pipeline.estimation.self_check import examine
from pipeline.estimation.solution import Solution
from pipeline.estimation.split import told
from pipeline.estimation.values import Values, statics_of
from pipeline.estimation.variances import settle
from pipeline.network import frames as fr
from pipeline.network.datum import tie as tie_network
from pipeline.network.epochs import Epochs, epochs_of
from pipeline.network.model import Network, Observations, Readings
from pipeline.network.start import start as start_values

LOST_SIGMAS = 10.0
"""An adjustment that stops while it still moves by more than this has no covariances and so no verdicts."""


def adjust(
    network: Network,
    observations: Observations,
    readings: dict[str, Readings],
    settings: EstimationSettings | None = None,
    repeated: Repeated = WHITE,
    learn: bool = False,
    checkpoint: Checkpoint = FORGETFUL,
) -> Solution:
    """Poses of every body at every epoch, and the statics, that fit everything best; with their covariances.

    Parameters
    ----------
    network : Network
        Of ``network_of``.
    observations : Observations
        Every accepted tag of every frame.
    readings : dict of str to Readings
        By name of the sensor; a sensor that is missing here was not recorded.
    settings : EstimationSettings, optional
        Those of site.toml; without them the defaults.
    repeated : Repeated
        What of a corner's error comes back in the next picture; to start with, if ``learn``.
    learn : bool
        Learn that and the motion densities from the log; the given ones are the start.
    checkpoint : Checkpoint, optional
        Keeps what is finished; if it has something of this same adjustment, that is where it goes on.

    Returns
    -------
    Solution

    Raises
    ------
    NetworkError
        What carries the cutting edge is tied to nothing surveyed; the message says what would tie it.
    EstimationError
        The normal equations cannot be solved.
    """
    settings = settings or EstimationSettings()
    network = with_offsets(network, observations, repeated)
    tied = tie_network(network, observations, readings)
    epochs = epochs_of(network, observations.take(tied.used), readings)
    problem = told(problem_of_log(network, tied, epochs, repeated), settings.split)
    if learn:
        problem = shaking(problem)
    optimum = optimise(problem, settings.huber, settings.max_iterations, False, checkpoint, "first")
    if not optimum.converged and optimum.last_step_sigmas > LOST_SIGMAS:
        raise EstimationError(
            f"the adjustment found no answer: after {optimum.iterations} iterations it still moves by "
            f"{optimum.last_step_sigmas:.2g} sigma; something in machine.toml or site.toml contradicts the log, "
            "most often the topic, field or curve of a sensor, or a tag's size or place"
        )
    if not learn or not optimum.converged:
        return solution_of(problem, unpulled(problem, optimum), settings)
    settled = settle(problem, optimum, settings, repeated, checkpoint)
    optimum = unpulled(settled.problem, settled.optimum)
    solution = solution_of(settled.problem, optimum, settings)
    solution.diagnostics["learned"] = {
        "rounds": settled.rounds,
        "log_likelihood": [
            *(round(value, 3) for value in settled.log_likelihood),
            solution.diagnostics["log_likelihood"],
        ],
        "motion": described(settled.problem, list(settled.densities)),
        "spells": spells(settled.problem, list(settled.densities)),
        "repeated": {
            "constant": round(settled.repeated.constant, 4),
            "resting": round(settled.repeated.resting, 4),
        },
    }
    return solution


def problem_of_log(network: Network, tied, epochs: Epochs, repeated: Repeated = WHITE) -> Problem:
    """The least-squares problem of a log, with its start."""
    first = start_values(network, tied, epochs)
    statics = statics_of(network, tied, first)
    values = Values(first.pose, first.rate, np.zeros(statics.size), epochs.time_s)
    return problem_of(network, tied, epochs, statics, values, repeated)


def solution_of(problem: Problem, optimum: Optimum, settings: EstimationSettings) -> Solution:
    """Marginals, tables and diagnostics at the optimum."""
    values = optimum.values
    all_epochs = published(problem, optimum, settings.max_gap_s)
    corner_fits, sensor_fits, found = all_epochs.corner_fits, all_epochs.sensor_fits, all_epochs.first
    table = diagnostics.corner_table(problem, corner_fits)
    # Constant errors of corners have no file to be compared with, and are many.
    statics = [s for s in diagnostics.static_results(problem, values, found) if s.source != CORNERS]
    motion = diagnostics.motion_fit(problem, values)
    untold = observability.findings(problem)
    checked, remarks = examine(
        problem, optimum, settings, found, all_epochs.edge_seen, corner_fits, sensor_fits
    )
    warnings = [
        *remarks,
        *([optimum.remark] if optimum.remark else []),
        *problem.tie.warnings,
        *(f.sentence for f in untold if f.kind in ("gauge", "line")),
        *diagnostics.moved_statics(statics),
        *diagnostics.stiff_motion(motion),
    ]
    if not optimum.converged:
        warnings.append(
            f"the adjustment stopped after {optimum.iterations} iterations with a last step of "
            f"{optimum.last_step_sigmas:.2g} sigma; raise estimation.max_iterations"
        )
    whole = diagnostics.variance_component(corner_fits + sensor_fits, settings.huber)
    variance = whole["sigma0_squared"]
    figures = {
        "sigma0": None if variance is None else round(variance**0.5, 4),
        "sigma0_squared": variance,
        "redundancy": whole["redundancy"],
        "iterations": optimum.iterations,
        "converged": optimum.converged,
        "last_step_sigmas": float(f"{optimum.last_step_sigmas:.3g}"),
        "epochs": len(problem.epochs.time_ns),
        "unknowns": {
            "statics": problem.statics.size,
            "states": len(problem.epochs.time_ns) * sum(v.size for v in problem.tie.variables),
        },
        "chains": [[problem.tie.variables[k].body for k in chain] for chain in problem.chains],
        "anchors": {
            v.body: problem.tie.frames.edges[fr.body_frame(v.body)].parent for v in problem.tie.variables
        },
        "cost": round(float(optimum.cost), 3),
        "log_likelihood": round(log_likelihood(problem, optimum, found.log_det), 3),
        "global_test": whole,
        "corners": diagnostics.variance_component(corner_fits, settings.huber),
        "sensors": {
            s.sensor.name: diagnostics.variance_component([f], settings.huber)
            for s, f in zip(problem.sensors, sensor_fits, strict=True)
        },
        "motion": motion,
        "pixels": diagnostics.pixel_rms(problem.network, table),
        "dropped": problem.epochs.dropped,
        "error_budget": all_epochs.budget,
        "error_budget_by_class": all_epochs.by_class,
        "correlation_time_s": all_epochs.lasting,
        "observability": [asdict(f) for f in untold],
        **checked,
        "warnings": warnings,
    }
    return Solution(
        all_epochs.states, tuple(statics), table, figures, tuple(warnings), all_epochs.sensitivities
    )
