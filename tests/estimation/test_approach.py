"""A long log brought near by a sample of it, against the same log adjusted from its start; and risky steps."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation import approach, pull, sweeps
from pipeline.estimation import optimise as iterations
from pipeline.estimation.linearised import pieces
from pipeline.estimation.marginals import marginals
from pipeline.estimation.normal import linearise
from pipeline.estimation.optimise import optimise, unpulled
from pipeline.estimation.parts import bounds, part_of
from pipeline.estimation.problem import keep_all
from tests.estimation.simulator import Options, draw
from tests.estimation.test_adjust import _problem

HUBER = 2.5


@pytest.fixture(scope="module")
def problem():
    """Both kinds of observations of the bucket, a time offset, gross corners, a gap."""
    return _problem(draw(5, Options(200, 0.04, 0.04, True, outliers=0.01, blind=((3.0, 3.6),))))


@pytest.fixture
def short_stretches(monkeypatch):
    monkeypatch.setattr(approach, "STRETCH", 8)
    monkeypatch.setattr(approach, "SPREAD", 4)
    monkeypatch.setattr(approach, "OF_GROUP", 1)


@pytest.fixture(scope="module")
def plain(problem):
    optimum = optimise(problem, HUBER, 40)
    assert optimum.converged
    return optimum


def test_short_logs_have_no_sample(problem):
    assert approach.sample(problem, keep_all(problem, HUBER)) is None


def test_a_sample_holds_sightings_of_all_and_the_motion_within_its_stretches(problem, short_stretches):
    short, weights = approach.sample(problem, keep_all(problem, HUBER))
    at = np.searchsorted(problem.epochs.time_ns, short.epochs.time_ns)
    E = len(at)
    assert len(problem.epochs.time_ns) > 3 * E
    for ours, group, alive in zip(short.corners, problem.corners, weights.corners, strict=True):
        assert 0 < len(ours.epoch) == len(alive)
        rows = np.flatnonzero(np.isin(group.epoch, at))
        np.testing.assert_array_equal(at[ours.epoch], group.epoch[rows])
        np.testing.assert_array_equal(ours.uv, group.uv[rows])
    within = np.diff(at) == 1
    np.testing.assert_array_equal(short.dt_s[within], problem.dt_s[at[:-1][within]])
    # A pair of states that fits the motion of a stretch costs nothing across a seam.
    assert np.all(short.dt_s[~within] == approach.SEAM_S) and not within.all()
    for density, whole in zip(short.densities, problem.densities, strict=True):
        np.testing.assert_array_equal(density[within], whole[at[:-1][within]])
        assert np.all(density[~within] == approach.SEAM_DENSITY)


def test_the_statics_of_a_sample_are_those_of_the_log_within_their_sigmas(problem, plain, short_stretches):
    """Whitened by what a share of the data knows less than all of them: chi-square of 58."""
    short, _ = approach.sample(problem, keep_all(problem, HUBER))
    found = optimise(short, HUBER, 40)
    P_short = marginals(short, found.values, found.weights).P_zz
    P = marginals(problem, plain.values, plain.weights).P_zz
    apart = found.values.z - plain.values.z
    values, vectors = np.linalg.eigh(P_short - P)
    told = values > 1e-3 * values.max()
    chi2 = np.sum((vectors[:, told].T @ apart) ** 2 / values[told])
    print(f"chi-square of the sample's statics: {chi2:.1f} of {told.sum()}")
    assert chi2 < told.sum() + 4 * np.sqrt(2 * told.sum())


def test_held_statics_leave_the_states_normal_equations_as_they_are(problem):
    rng = np.random.default_rng(1)
    values = replace(problem.first, z=0.5 * rng.standard_normal(problem.statics.size))
    weights = keep_all(problem, HUBER)
    states = approach.held(problem, values.z)
    clocks = np.concatenate([problem.statics.columns[c] for c in set(problem.statics.clocks) - {None}])
    assert states.statics.size == len(clocks) == 1
    chains, C, g_z = linearise(problem, values, weights)
    ours, C_held, g_held = linearise(states, replace(values, z=states.first.z), weights)
    for a, b in zip(ours, chains, strict=True):
        for name in ("D", "A", "g"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-9, atol=1e-6)
        here = np.flatnonzero(np.isin(b.columns, clocks))
        np.testing.assert_allclose(a.B[:, :, : len(here)], b.B[:, :, here], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(C_held, C[np.ix_(clocks, clocks)], rtol=1e-9)
    np.testing.assert_allclose(g_held, g_z[clocks], rtol=1e-9)


def _same_answer(problem, near, far):
    sigma = np.sqrt(np.diagonal(marginals(problem, far.values, far.weights, far.eased).P_zz))
    assert near.converged
    assert near.cost == pytest.approx(far.cost, rel=1e-8)
    assert np.abs((near.values.z - far.values.z) / sigma).max() < 0.01
    for a, b in zip(near.weights.corners, far.weights.corners, strict=True):
        assert np.array_equal(a, b) and not a.all()


def test_a_log_that_was_approached_ends_where_it_does_from_its_start(problem, plain, short_stretches):
    near = optimise(problem, HUBER, 40)
    again = optimise(problem, HUBER, 40)
    far = unpulled(problem, plain)
    assert near.eased and near.iterations < far.iterations
    _same_answer(problem, near, far)
    assert unpulled(problem, near) is near
    assert near.values.z.tobytes() == again.values.z.tobytes()
    print(f"{near.iterations} steps of everything, {far.iterations} from the start")


def test_a_long_log_of_other_variances_goes_on_from_its_statics(problem, plain, short_stretches):
    """Densities a hundredth of those before: Newton's steps alone would be far off."""
    other = replace(problem, densities=tuple(0.01 * q for q in problem.densities))
    far = unpulled(other, optimise(other, HUBER, 60))
    near = optimise(replace(other, first=plain.values), HUBER, 60, near=True)
    assert near.eased
    _same_answer(other, near, far)
    print(f"{near.iterations} steps of everything, {far.iterations} from the start")


def test_where_steps_without_the_pull_get_longer_the_cost_leads(problem, plain, short_stretches, monkeypatch):
    monkeypatch.setattr(pull, "LONGER", 0.0)
    near = optimise(problem, HUBER, 40)
    assert not near.eased
    _same_answer(problem, near, plain)


def test_near_enough_ends_a_step_earlier_and_no_further_off_than_it_says(problem, plain):
    sigma = np.sqrt(np.diagonal(marginals(problem, plain.values, plain.weights).P_zz))
    start = replace(plain.values, z=plain.values.z + 0.3 * sigma)
    whole = iterations._iterate(problem, start, plain.weights, 40, 0)
    early = iterations._iterate(problem, start, plain.weights, 40, 0, near_enough=True)
    off = np.abs((early[0].z - whole[0].z) / sigma).max()
    print(f"{early[1]} steps instead of {whole[1]}, {off:.5f} sigma off, said to be {early[3]:.5f} at most")
    assert early[2] and early[1] < whole[1]
    assert off < early[3] < iterations.STEP_SIGMAS


def test_statics_thousands_of_sigmas_off_are_brought_back_and_it_is_told(problem, plain):
    sigma = np.sqrt(np.diagonal(marginals(problem, plain.values, plain.weights).P_zz))
    # Together, though they are known by their sums.
    start = replace(plain.values, z=plain.values.z + 3.0 * sigma)
    _, used, converged, _, cost = iterations._iterate(problem, start, plain.weights, 40, 0)
    print(f"{used} steps")
    assert converged and cost == pytest.approx(plain.cost, rel=1e-9)


def test_states_that_follow_span_by_span_are_those_that_follow_as_one(problem, plain, monkeypatch):
    """A span ends in the gap; where it ends is not to be seen, for 100 epochs on either side are adjusted with it."""
    weights = keep_all(problem, HUBER)
    start = replace(problem.first, z=plain.values.z)
    monkeypatch.setattr(iterations, "NEAR_STEPS", 8)
    whole = iterations._followed(problem, start, weights, 2)
    monkeypatch.setattr(iterations, "SPAN", 90)
    monkeypatch.setattr(iterations, "MARGIN", 100)
    spans = iterations._followed(problem, start, weights, 2)
    assert spans.z.tobytes() == plain.values.z.tobytes()
    found, E = marginals(problem, whole, weights), len(problem.epochs.time_ns)
    for k in range(len(problem.tie.variables)):
        c, at = problem.place(k)
        sigma = np.sqrt(np.einsum("nii->ni", found.Z[c][:, at, at]))
        rate = (spans.rate[k] - whole.rate[k]).reshape(E, -1) / sigma[:, sigma.shape[1] // 2 :]
        assert np.abs(rate).max() < 0.05


def test_no_unknown_moves_further_than_the_bound_says(problem, plain):
    """In posterior sigmas, with all unknowns off the optimum, and with the statics alone; in parts of 64 epochs."""
    rng = np.random.default_rng(2)
    E = len(problem.epochs.time_ns)
    weights = keep_all(problem, 1e6)
    for of_states, of_statics in ((1e-4, 1.0), (0.0, 0.01)):
        values = plain.values.retract(
            [of_states * rng.standard_normal((E, v.size)) for v in problem.tie.variables],
            of_statics * rng.standard_normal(problem.statics.size),
        )
        cut = [part_of(problem, values, weights, a, b) for a, b in bounds(problem, 64)]
        ours = pieces(cut)
        reduced = sweeps.reduce(ours, len(cut))
        P_zz = np.linalg.inv(reduced.S)
        worst = np.abs(reduced.dz / np.sqrt(np.diagonal(P_zz))).max()
        moves = dict(sweeps.steps(ours, reduced))
        for i, found in sweeps.inverses(ours, reduced):
            for dx, of in zip(moves[i], found, strict=True):
                columns = linearise(cut[i].problem, cut[i].values, cut[i].weights)[0]
                q = next(c.columns for c in columns if c.B.shape == of.Y.shape)
                var = np.einsum("nii->ni", of.Z) + np.einsum("nij,jk,nik->ni", of.Y, P_zz[np.ix_(q, q)], of.Y)
                worst = max(worst, np.abs(dx / np.sqrt(var)).max())
        whole = np.sqrt(sum(reduced.innovations) + reduced.pull)
        print(f"largest {worst:.4g} sigma, bound {reduced.longest:.4g}, whole step {whole:.4g}")
        assert worst < reduced.longest < whole


def test_a_risky_step_that_is_not_mended_is_taken_back(problem, plain, monkeypatch):
    """With any patience the answer is the same; and where every step is followed by a longer one, none is kept."""
    for patience in (0.0, 1e9):
        monkeypatch.setattr(iterations, "PATIENCE", patience)
        other = optimise(problem, HUBER, 60)
        assert other.converged
        assert other.cost == pytest.approx(plain.cost, rel=1e-8)
    values, weights = plain.values, plain.weights
    lengths = iter(np.geomspace(1.0, 1e9, 1000))

    class Worse(iterations.Step):
        """Steps away from the optimum, each longer than the one before."""

        def solve(self, damping):
            super().solve(damping)
            self.pull = next(lengths)
            self.deltas = [1e-4 * np.ones_like(d) for d in self.deltas]

    monkeypatch.setattr(iterations, "Step", Worse)
    ended, *_, cost = iterations._iterate(problem, values, weights, 3, irls=0)
    assert cost <= plain.cost * (1 + 1e-9)
    np.testing.assert_array_equal(ended.z, values.z)
