"""Budgets of the cutting edge's elevation by what the machine was doing, and how long its own part lasts."""

import copy

import numpy as np
import pytest

from pipeline.config.site import EstimationSettings
from pipeline.estimation import adjust
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.budget import Lasting
from pipeline.estimation.marginals import body_track, marginals
from pipeline.estimation.normal import linearise
from pipeline.estimation.optimise import optimise
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation import dense
from tests.estimation.simulator import MACHINE, Options, draw


def test_budgets_by_class_count_every_epoch_and_a_bridged_one_is_the_widest():
    drawn = draw(14, Options(epochs=60, blind=((4.0, 7.0),), machine=_slow_bucket()))
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    tool, found = solution.body("tool"), solution.diagnostics["error_budget_by_class"]
    assert sum(entry["epochs"] for entry in found.values()) == len(tool.time_ns)
    assert found["bridged"]["epochs"] == np.sum(~tool.seen)
    sigma = {name: entry["sigma"] for name, entry in found.items()}
    print(sigma, solution.diagnostics["correlation_time_s"])
    assert sigma["bridged"] == max(sigma.values()) > 1.5 * min(sigma.values())
    up = tool.T_world_body[:, 2, :3]
    whole = np.einsum("ni,nij,nj->n", up, (tool.own + tool.common)[:, :3, :3], up)
    assert sigma["bridged"] == pytest.approx(np.sqrt(np.median(whole[~tool.seen])), rel=1e-3)


def test_the_correlation_time_is_that_of_a_dense_inverse():
    """Elevation of the edge at one epoch and at all others: covariances of the own part from the whole matrix."""
    drawn = draw(19, Options(epochs=14, frame_s=0.3, potentiometer=False, bucket_marker=True))
    settings = EstimationSettings()
    tied = tie(drawn.network, drawn.observations, drawn.readings)
    problem = problem_of_log(
        drawn.network, tied, epochs_of(drawn.network, drawn.observations, drawn.readings)
    )
    optimum = optimise(problem, settings.huber, settings.max_iterations)
    found = marginals(problem, optimum.values, optimum.weights)
    track = body_track(problem, optimum.values, found, "tool", "tool")
    chains, C, g_z = linearise(problem, optimum.values, optimum.weights)
    H, _, starts = dense.assemble(chains, C, g_z)
    states = dense.inverse(H[: starts[-1], : starts[-1]])
    E = len(problem.epochs.time_ns)
    rows = np.zeros((E, starts[-1]))
    for c, J_x in track.J_x.items():
        b = J_x.shape[-1]
        for k in range(E):
            at = starts[c] + k * b
            rows[k, at : at + b] = track.T_world_body[k, 2, :3] @ J_x[k, :3]
    P = rows @ states @ rows.T
    correlation = P / np.sqrt(np.outer(np.diagonal(P), np.diagonal(P)))
    t, level, times = problem.epochs.time_s, np.exp(-1.0), []
    for k in range(E - 1):
        below = np.flatnonzero(correlation[k, k:] < level)
        if len(below):
            times.append(float(np.interp(-level, -correlation[k, k + below[0] - 1 : k + below[0] + 1],
                                         t[k + below[0] - 1 : k + below[0] + 1]) - t[k]))  # fmt: skip
        else:
            times.append(float(t[-1] - t[k]))
    lasting = Lasting(t, np.arange(E))
    lasting.add(track, found, 0, E)
    ours = lasting.described(np.zeros(E, dtype=int))
    print(f"median correlation time {ours['median']} s, dense {np.median(times):.3f} s")
    assert ours["median"] == pytest.approx(np.median(times), abs=2e-3)


def _slow_bucket():
    machine = copy.deepcopy(MACHINE)
    machine["motion"]["bucket"]["rotation"] = 2e-4
    return machine
