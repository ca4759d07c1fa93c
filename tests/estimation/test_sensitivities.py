"""How the edge answers to a wrong value in a file: against adjustments of the same log with that value changed."""

import copy

import numpy as np
import pytest

from pipeline.config.site import EstimationSettings
from pipeline.estimation import adjust
from pipeline.estimation.marginals import body_track, marginals
from pipeline.estimation.optimise import optimise
from pipeline.estimation.parts import bounds
from pipeline.estimation.published import published
from pipeline.estimation.table import columns_of_sensitivities, sensitivities_from_columns
from pipeline.geometry import so3
from tests.estimation.simulator import MACHINE, SITE, Options, draw, exact
from tests.estimation.test_adjust import NO_LOSS, _problem

OPTIONS = Options(epochs=25)
QUIET = EstimationSettings(huber=1e6, cross_validation=False)


def with_files(drawn, change):
    """The same pictures and readings with another machine.toml or site.toml."""
    from pipeline.config import Machine, Site
    from pipeline.network import network_of

    machine, site = copy.deepcopy(MACHINE), copy.deepcopy(SITE)
    change(machine, site)
    network = network_of(Machine.model_validate(machine), Site.model_validate(site))
    return adjust(network, drawn.observations, drawn.readings, QUIET)


def wear(mm):
    def change(machine, site):
        machine["cutting_edge"]["wear"] = [{"date": "2020-01-01", "wear_mm": mm, "sigma_mm": 0.0}]

    return change


def sensor(machine, site):
    machine["sensors"]["pot"]["curve"]["coefficients"][0] += 0.002


def clock(machine, site):
    machine["sensors"]["pot"]["time_offset_s"] += 0.004


def benchmark(axis):
    def change(machine, site):
        site["benchmarks"]["B2"]["pose"]["enh"][axis] += 0.003

    return change


@pytest.fixture(scope="module")
def answered():
    drawn = draw(8, OPTIONS)
    return drawn, with_files(drawn, wear(5.0))


@pytest.mark.parametrize(
    "source, change, step",
    [
        (("wear", "", ""), wear(15.0), 0.010),
        (("sensor", "pot", ""), sensor, 0.002),
        (("time offset", "pot", ""), clock, 0.004),
        (("benchmark", "B2", "e"), benchmark(0), 0.003),
        (("benchmark", "B2", "n"), benchmark(1), 0.003),
        (("benchmark", "B2", "h"), benchmark(2), 0.003),
    ],
)
def test_the_response_is_that_of_an_adjustment_with_the_changed_file(answered, source, change, step):
    drawn, before = answered

    def both(machine, site):
        wear(5.0)(machine, site)
        change(machine, site)

    after = with_files(drawn, both)
    told = before.sensitivities
    row = [(s.kind, s.name, s.component) for s in told.sources].index(source)
    a, b = before.body("tool"), after.body("tool")
    # Epochs of readings move with the time offset; those of pictures are in both.
    kept = np.isin(told.time_ns, b.time_ns)
    T_a, T_b = (s.T_world_body[np.searchsorted(s.time_ns, told.time_ns[kept])] for s in (a, b))
    turn = so3.log(T_b[:, :3, :3] @ np.swapaxes(T_a[:, :3, :3], -1, -2))
    measured = np.concatenate([T_b[:, :3, 3] - T_a[:, :3, 3], turn], axis=1)
    predicted = step * told.response[kept, row]
    # Linear in the value: what is left is second order and the ends of the iterations.
    assert kept.sum() > 10 and np.abs(measured[:, :3]).max() > 1e-4
    print(source, np.abs(measured[:, :3]).max(), np.abs(measured - predicted).max())
    assert np.abs(measured - predicted).max() < 0.02 * np.abs(measured[:, :3]).max()


def test_the_factors_give_the_common_covariance_of_two_instants():
    problem = _problem(draw(8, OPTIONS))
    optimum = optimise(problem, NO_LOSS, 30)
    told = published(problem, optimum, 0.3).sensitivities
    found = marginals(problem, optimum.values, optimum.weights)
    track = body_track(problem, optimum.values, found, "tool", "tool")
    at = np.searchsorted(problem.epochs.time_ns, told.time_ns)
    R = track.T_world_body[at, :3, :3]
    M = R @ track.M[at, :3]  # of the edge's middle, along e n h
    whole = np.einsum("kap,pq,lbq->kalb", M, found.P_zz, M)
    factors = told.response[:, [s.kind == "common" for s in told.sources], :3].astype(float)
    ours = np.einsum("kra,lrb->kalb", factors, factors)
    n = len(at)
    # The parts of the budget add up to the variance of the elevation, and move nothing else.
    budget = told.response[:, [s.kind == "budget" for s in told.sources]].astype(float)
    parts = np.sum(budget[:, :, 2] ** 2, axis=1)
    np.testing.assert_allclose(parts, np.einsum("kckc->kc", whole)[:, 2], rtol=1e-5)
    assert not budget[..., [0, 1, 3, 4, 5]].any()
    assert {s.name for s in told.sources if s.kind == "budget"} >= {"benchmarks", "mounts", "cutting edge"}
    whole, ours = whole.reshape(3 * n, 3 * n), ours.reshape(3 * n, 3 * n)
    print(f"{factors.shape[1]} factors of {len(found.P_zz)} unknowns")
    assert factors.shape[1] < 0.5 * len(found.P_zz)
    # Nothing is claimed that is not there, and at most a thousandth is left to the reader.
    left = whole - ours
    assert np.linalg.eigvalsh(left)[0] > -1e-5 * np.trace(whole)
    assert 0 < np.trace(left) < 2e-3 * np.trace(whole)


def test_a_log_in_parts_has_the_responses_of_the_log_in_one_piece(monkeypatch):
    problem = _problem(draw(5, Options(90, 0.05, 0.05, True)))
    optimum = optimise(problem, NO_LOSS, 30)
    whole = published(problem, optimum, 0.3).sensitivities
    monkeypatch.setattr("pipeline.estimation.linearised.bounds", lambda problem: bounds(problem, size=37))
    parts = published(problem, optimum, 0.3).sensitivities
    np.testing.assert_array_equal(parts.time_ns, whole.time_ns)
    assert np.all(np.diff(whole.time_ns) > 0.14e9) and len(whole.time_ns) < 0.5 * len(problem.epochs.time_ns)
    causes = [s.kind != "common" for s in whole.sources]
    shown = [s.kind != "common" for s in parts.sources]
    assert [s for s in whole.sources if s.kind != "common"] == [
        s for s in parts.sources if s.kind != "common"
    ]
    np.testing.assert_allclose(parts.response[:, shown], whole.response[:, causes], rtol=1e-4, atol=1e-6)
    for told, of in ((parts, shown), (whole, causes)):
        factors = told.response[:, ~np.array(of), :3].astype(float)
        covariance = np.einsum("kra,lrb->kalb", factors, factors)
        if told is parts:
            first = covariance
    # Each part may leave a thousandth of its variance out, and two instants share what either left.
    assert np.abs(first - covariance).max() < 1e-2 * np.abs(covariance).max()


def test_the_table_gives_back_what_was_written():
    problem = _problem(draw(8, OPTIONS))
    optimum = optimise(problem, NO_LOSS, 30)
    told = published(problem, optimum, 0.3).sensitivities
    parts = [columns_of_sensitivities(portion) for portion in told.portions(7)]
    assert len(parts) > 1
    back = sensitivities_from_columns({key: np.concatenate([p[key] for p in parts]) for key in parts[0]})
    assert back.sources == told.sources
    np.testing.assert_array_equal(back.time_ns, told.time_ns)
    np.testing.assert_array_equal(back.response, told.response)


def test_exact_files_have_no_common_error_and_only_teeth_that_wear():
    options = Options(epochs=6, machine=exact(MACHINE), site=exact(SITE))
    problem = _problem(draw(8, options))
    assert problem.statics.size == 0
    told = published(problem, optimise(problem, NO_LOSS, 30), 0.3).sensitivities
    assert [s.kind for s in told.sources] == ["wear"]
    assert (
        np.allclose(np.linalg.norm(told.response[:, 0, :3], axis=1), 1.0)
        and not told.response[:, 0, 3:].any()
    )
