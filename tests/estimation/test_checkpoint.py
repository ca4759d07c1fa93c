"""An adjustment that is stopped goes on where it was, and ends with the bytes of one that nobody stopped."""

import numpy as np
import pytest

from pipeline.config.site import EstimationSettings
from pipeline.estimation import adjust, approach, optimise, parts
from pipeline.estimation.repeated import Repeated
from tests.estimation.simulator import Options, draw
from tests.estimation.test_adjust import _problem


class Stopped(Exception):
    """What a kill is to these tests."""


class Kept:
    """A checkpoint in memory that stops the adjustment once it has kept so many."""

    def __init__(self, stop_after=None):
        self.arrays, self.names, self.stop_after = {}, [], stop_after

    def recall(self, name):
        found = self.arrays.get(name)
        return None if found is None else {key: a.copy() for key, a in found.items()}

    def keep(self, name, arrays):
        self.arrays[name] = {key: np.array(a) for key, a in arrays.items()}
        self.names.append(name)
        if len(self.names) == self.stop_after:
            raise Stopped

    def forget(self, name):
        self.arrays.pop(name, None)


@pytest.fixture
def solved(monkeypatch):
    """How many steps were solved for, and of how many epochs."""
    sizes = []
    solve = optimise.Step.solve

    def counted(self, damping):
        sizes.append(len(self.problem.epochs.time_ns))
        return solve(self, damping)

    monkeypatch.setattr(optimise.Step, "solve", counted)
    return sizes


def _bytes(optimum):
    values = optimum.values
    arrays = [*values.pose, *values.rate, values.z, *optimum.weights.corners, *optimum.weights.sensors]
    state = optimum.iterations, optimum.converged, float(optimum.last_step_sigmas), float(optimum.cost)
    return [a.tobytes() for a in arrays], state


@pytest.mark.parametrize("long", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_stopped_after_any_iteration_it_ends_with_the_same_bytes(long, solved, monkeypatch):
    if long:  # one that is approached by a sample
        for name, value in (("STRETCH", 8), ("SPREAD", 4), ("OF_GROUP", 1)):
            monkeypatch.setattr(approach, name, value)
        monkeypatch.setattr(optimise, "SPAN", 64)
        monkeypatch.setattr(parts.bounds, "__defaults__", (50,))
    problem = _problem(
        draw(3, Options(200, 0.04, 0.04, True, outliers=0.01) if long else Options(9, outliers=0.1))
    )
    E = len(problem.epochs.time_ns)
    whole = Kept()
    undisturbed = _bytes(optimise.optimise(problem, 2.5, 60, checkpoint=whole))
    assert ("approach" in whole.names[0]) == long
    assert whole.names[-1] == " optimum"
    assert list(whole.arrays) == [" optimum"], "what is finished is not kept in pieces too"
    all_steps = solved.count(E)
    for stop_after in range(1, len(whole.names) + 1):
        kept = Kept(stop_after)
        with pytest.raises(Stopped):
            optimise.optimise(problem, 2.5, 60, checkpoint=kept)
        kept.stop_after = None
        solved.clear()
        assert _bytes(optimise.optimise(problem, 2.5, 60, checkpoint=kept)) == undisturbed
        done_before = sum(name not in (" approach", " optimum") for name in whole.names[:stop_after])
        assert solved.count(E) <= all_steps - done_before
        solved.clear()


def test_stopped_while_it_learns_it_ends_with_the_same_bytes(solved):
    drawn = draw(5, Options(epochs=40))
    given = drawn.network, drawn.observations, drawn.readings, EstimationSettings(), Repeated(), True
    whole = Kept()
    undisturbed = adjust(*given, whole)
    steps = len(solved)
    for stop_after in (2, len(whole.names) // 2, len(whole.names)):
        kept = Kept(stop_after)
        with pytest.raises(Stopped):
            adjust(*given, kept)
        kept.stop_after = None
        solved.clear()
        again = adjust(*given, kept)
        assert len(solved) < steps
        assert again.diagnostics == undisturbed.diagnostics
        for ours, theirs in zip(again.states, undisturbed.states, strict=True):
            assert ours.T_world_body.tobytes() == theirs.T_world_body.tobytes()
            assert ours.own.tobytes() == theirs.own.tobytes()
