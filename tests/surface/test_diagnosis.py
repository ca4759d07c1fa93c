"""The differences' covariance against drawn errors, and the tests of causes against what they say of themselves."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchmarks._drawn_checks import SIGMA, differences, morning
from pipeline.estimation.sensitivities import Sensitivities, Source
from pipeline.surface.as_built import as_built
from pipeline.surface.checks import compare
from pipeline.surface.diagnosis import NAMED, NONE, UNEXPLAINED, UNSURE, critical_w, diagnose, global_test
from pipeline.surface.parked import compare_parked
from pipeline.surface.shot_errors import Cause, Differences, differences_of, response_at
from pipeline.surface.telling_shot import telling_shot
from pipeline.tracks.poses import CuttingEdge
from tests.surface.conftest import T0
from tests.surface.test_parked import at, shots_of

WEAR, DATUM = Cause("wear", "", "", "m"), Cause("datum", "", "h", "m")
CLOCK = Cause("time offset", "pot", "", "s")


def drawn(rng, signature, causes, size=0.0, which=0, covariance=None):
    """Differences of a linear model, drawn from their covariance."""
    m = len(signature)
    V = covariance if covariance is not None else 1e-5 * (np.eye(m) + 0.5)
    d = rng.multivariate_normal(size * signature[:, which], V)
    return Differences(np.arange(m), np.tile([0, 0, 1.0], (m, 1)), d, V, np.zeros((m, 0)), causes, signature)


def test_the_covariance_is_that_of_drawn_errors():
    """Of a machine that shares no code with the house, errors drawn 200 times: d' V^-1 d is chi-square."""
    rng = np.random.default_rng(11)
    of = morning(rng)
    statistics = []
    for _ in range(200):
        found = differences(rng, of, np.zeros(len(SIGMA)), np.zeros(3))
        statistic, m, p = global_test(found, np.ones(len(found.value), bool))
        assert p == pytest.approx(chi2.sf(statistic, m), rel=1e-9)
        statistics.append(statistic)
    low, high = chi2.ppf([0.005, 0.995], 200 * m) / 200
    print(f"mean {np.mean(statistics):.1f} of {m} components, band {low:.1f} to {high:.1f}")
    assert m == 40 + 3 * 12 and low < np.mean(statistics) < high


def test_value_and_sigma_are_those_of_least_squares_with_the_whole_covariance():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(12, 12))
    V = 1e-5 * root @ root.T + 1e-5 * np.eye(12)
    found = drawn(rng, rng.normal(size=(12, 3)), (WEAR, DATUM, CLOCK), 0.02, 0, V)
    for candidate in diagnose(found).candidates:
        a = found.signature[:, found.causes.index(candidate.cause)]
        values, vectors = np.linalg.eigh(V)
        whiten = vectors @ np.diag(values**-0.5) @ vectors.T
        best, rest, *_ = np.linalg.lstsq((whiten @ a)[:, None], whiten @ found.value, rcond=None)
        assert candidate.value == pytest.approx(best[0], rel=1e-8)
        assert candidate.sigma == pytest.approx(1 / np.linalg.norm(whiten @ a), rel=1e-8)
        assert candidate.left_p_value == pytest.approx(chi2.sf(rest[0], 11), rel=1e-6)


def test_with_nothing_wrong_a_cause_is_named_in_less_than_5_of_100():
    rng = np.random.default_rng(2)
    signature = rng.normal(size=(20, 3))
    named = sum(
        diagnose(drawn(rng, signature, (WEAR, DATUM, CLOCK))).state in (NAMED, UNSURE) for _ in range(2000)
    )
    # 95 % of a binomial of 2000 and 0.05 (three nearly independent tests).
    assert 0.035 < named / 2000 < 0.062
    assert critical_w(1) == pytest.approx(1.95996, abs=1e-4)
    assert critical_w(10) == pytest.approx(2.7995, abs=1e-3)


def test_a_cause_is_seen_and_told_at_the_sizes_that_are_said():
    """In 80 of 100 drawn jobs it passes its test at one, and the test against the other cause at the other."""
    rng = np.random.default_rng(3)
    base = rng.normal(size=(20, 2))
    signature = np.column_stack([base[:, 0], 0.9 * base[:, 0] + 0.35 * base[:, 1]])
    causes = (WEAR, DATUM)
    quiet = next(c for c in diagnose(drawn(rng, signature, causes)).candidates if c.cause == WEAR)
    assert quiet.told_from > 1.2 * quiet.seen_from

    def share(size, right):
        return np.mean([right(diagnose(drawn(rng, signature, causes, size))) for _ in range(1000)])

    seen = share(
        quiet.seen_from, lambda f: max(abs(c.w) for c in f.candidates if c.cause == WEAR) > f.critical
    )
    told = share(quiet.told_from, lambda f: f.state == NAMED and f.named.cause == WEAR)
    assert seen == pytest.approx(0.80, abs=0.035) and told == pytest.approx(0.80, abs=0.035)
    assert share(2 * quiet.told_from, lambda f: f.named is not None and f.named.cause == WEAR) > 0.99


def test_two_causes_of_one_signature_are_never_told_apart():
    signature = np.column_stack([np.ones(15), -np.ones(15)])
    found = diagnose(drawn(np.random.default_rng(4), signature, (WEAR, DATUM), 0.05))
    assert found.state == UNSURE and found.named is None and found.rivals == (1,)
    assert all(np.isinf(c.told_from) for c in found.candidates)
    assert found.candidates[0].value == pytest.approx(-found.candidates[1].value)


def test_components_of_one_benchmark_are_one_cause():
    east, north = (Cause("benchmark", "B1", axis, "m") for axis in "en")
    signature = np.column_stack([np.ones(15), np.ones(15)])
    found = diagnose(drawn(np.random.default_rng(4), signature, (east, north), 0.05))
    assert found.state == NAMED and found.named.cause.what == ("benchmark", "B1")


def test_a_value_that_no_such_thing_has_explains_nothing():
    """A time offset of four seconds would do it; so the differences stay unexplained, and the small one is named."""
    rng = np.random.default_rng(5)
    shape = rng.normal(size=20)
    alone = diagnose(drawn(rng, 0.01 * shape[:, None], (CLOCK,), 4.0))
    assert alone.state == UNEXPLAINED and not alone.candidates[0].plausible
    both = diagnose(drawn(rng, np.column_stack([0.01 * shape, shape]), (CLOCK, WEAR), 0.04, 1))
    assert both.state == NAMED and both.named.cause == WEAR


def test_nothing_compared_has_no_diagnosis_and_one_shot_tells_nothing_apart():
    none = drawn(np.random.default_rng(0), np.ones((2, 1)), (DATUM,))
    none = replace(none, value=np.zeros(0), covariance=np.zeros((0, 0)), signature=np.zeros((0, 1)))
    assert diagnose(none) is None
    one = Differences(
        np.zeros(1, int), np.array([[0, 0, 1.0]]), np.array([0.5]), np.array([[1e-5]]), np.zeros((1, 0)),
        (DATUM, CLOCK), np.array([[1.0, 2.0]]),
    )  # fmt: skip
    assert diagnose(one).state == UNSURE
    assert diagnose(replace(one, value=np.array([0.001]))).state == NONE


def test_the_response_at_a_point_is_that_of_a_rigid_edge():
    """Shift and turn against the points of an edge that was moved; half-way between two epochs, half of both."""
    p = np.array([[512_345.0, 4_123_456.0, 50.0]])
    points = p[:, None] + np.array([[-0.6, 0.2, 0.1], [0, 0, 0], [0.6, -0.2, -0.1]])
    time_ns = np.array([T0, T0 + 10**9])
    edge = CuttingEdge(
        time_ns, np.repeat(points, 2, axis=0), np.ones(2, bool), np.zeros((2, 3, 6)), np.zeros((2, 3, 6))
    )
    shift, turn = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.4, -0.3])
    response = np.zeros((2, 1, 6))
    response[0, 0] = [*shift, *turn]
    answer = Sensitivities(time_ns, (Source("wear", "", "", "m"),), response)
    small = 1e-6
    for i in range(3):
        moved = (
            points[0, 1]
            + small * shift
            + Rotation.from_rotvec(small * turn).apply(points[0, i] - points[0, 1])
        )
        expected = (moved - points[0, i]) / small
        here = response_at(answer, edge, np.array([T0, T0 + 5 * 10**8]), np.repeat(points[:, i], 2, axis=0))[
            :, 0
        ]
        assert np.allclose(here[0], expected, atol=1e-3) and np.allclose(here[1], 0.5 * expected, atol=1e-3)


@pytest.fixture(scope="module")
def surveyed(trench):
    """Two passes, and a stand at station 5; five shots of the floor and one of the edge's middle."""
    t = np.arange(0, 30, 0.1)
    station = np.interp(t, [0, 4, 8, 10, 30], [2, 8, 2, 5, 5])
    h = np.interp(t, [0, 4, 5, 8, 10, 30], [50, 50, 51, 51, 50.5, 50.5])
    edge = trench.edge(t, station, 0.0, h, sigma=0.003, common=0.004)
    built = as_built(edge, trench.alignment, trench.design, 0.05)
    rows = [("floor", None, "", at(trench, s, 0.1, 50.0)) for s in (3, 4, 5, 6, 7)]
    shots = shots_of([*rows, ("edge", 20.0, "middle", at(trench, 5, 0, 50.5))])
    found = compare_parked(compare(shots, built, trench.alignment, 0.002), shots, edge)
    return edge, built, shots, found


def test_components_and_parts_of_a_small_job(trench, surveyed):
    edge, _, shots, found = surveyed
    told = differences_of(shots, found, trench.alignment, edge, None, 2.0)
    assert told.shot.tolist() == [0, 1, 2, 3, 4, 5, 5, 5]
    # Without factors the common error is one of all in elevation; the own part fades with the time between passes.
    when = (found.time_ns[:5] - T0) / 1e9
    lag = np.abs(when[:, None] - when)
    expected = 0.004**2 + 0.003**2 * np.exp(-lag / 2.0) + 0.002**2 * np.eye(5)
    assert np.allclose(told.covariance[:5, :5], expected, rtol=1e-5)
    assert told.covariance[5, 5] == pytest.approx(0.002**2) and told.covariance[5, 6] == 0.0
    assert [c.component for c in told.causes] == ["e", "n", "h"]
    assert np.array_equal(told.signature[:, 2], [1, 1, 1, 1, 1, 0, 0, 1])


def answer_with(edge, wear, offset):
    """Wear and a sensor, whose response along e n h is given by functions of the epoch's place in the log."""
    share = np.linspace(0, 1, len(edge))
    response = np.zeros((len(edge), 3, 6))
    response[:, 0, :3] = wear(share[:, None])
    response[:, 1, :3] = offset(share[:, None])
    response[:, 2, 2] = 0.003
    sources = (
        Source("wear", "", "", "m"),
        Source("sensor", "pot", "", "deg"),
        Source("common", "1", "", "sigma"),
    )
    return Sensitivities(edge.time_ns, sources, response)


def test_factors_take_the_place_of_the_shared_error_and_what_they_leave_out_is_own(trench, surveyed):
    edge, _, shots, found = surveyed
    up = np.array([0, 0, 1.0])
    answer = answer_with(edge, lambda s: up + 0 * s, lambda s: s * up)
    told = differences_of(shots, found, trench.alignment, edge, answer, 1e-6)
    expected = np.full((5, 5), 0.003**2) + (0.003**2 + 0.004**2 - 0.003**2 + 0.002**2) * np.eye(5)
    assert np.allclose(told.covariance[:5, :5], expected, rtol=1e-5)
    # A file with more wear has a higher edge; a truth with more wear leaves ours too low.
    assert np.allclose(told.signature[:5, 0], -1.0)


def test_the_shot_that_would_tell_is_where_the_explanations_part(trench, surveyed):
    edge, built, shots, found = surveyed
    up, north = np.array([0, 0, 1.0]), np.array([0, 1.0, 0])
    low = replace(found, difference=found.difference - 0.03)
    # On the floor both lift the edge alike; parked, wear would show in northing as well.
    for wear, kind, axis in (
        (lambda s: up + 2 * s * north, "edge", "n"),
        (lambda s: up * (1 - 12 * s), "floor", "h"),
    ):
        answer = answer_with(edge, wear, lambda s: 0.5 * up + 0 * s)
        floor_only = replace(low, result=np.where(shots.kind == "floor", low.result, "left out"))
        if kind == "floor":  # one shot only: two explanations
            floor_only = replace(
                floor_only, result=np.where(np.arange(6) == 0, floor_only.result, "left out")
            )
        diagnosis = diagnose(differences_of(shots, floor_only, trench.alignment, edge, answer, 0.4))
        assert diagnosis.state == UNSURE
        by_kind = {c.cause.kind: c for c in diagnosis.candidates}
        shot = telling_shot(by_kind["wear"], by_kind["sensor"], built, trench.alignment, edge, answer, 0.002)
        assert (shot.kind, shot.axis) == (kind, axis)
        s = np.interp(shot.time_ns - T0, edge.time_ns - T0, np.linspace(0, 1, len(edge)))
        i = "enh".index(axis)
        assert shot.first == pytest.approx(-wear(s)[i] * by_kind["wear"].value, rel=1e-6)
        assert shot.second == pytest.approx(-(0.5 * up)[i] * by_kind["sensor"].value, rel=1e-6)
        assert shot.apart_sigmas > 3
    alike = answer_with(edge, lambda s: up + 0 * s, lambda s: 0.5 * up + 0 * s)
    diagnosis = diagnose(differences_of(shots, low, trench.alignment, edge, alike, 0.4))
    by_kind = {c.cause.kind: c for c in diagnosis.candidates}
    assert (
        telling_shot(by_kind["wear"], by_kind["sensor"], built, trench.alignment, edge, alike, 0.002) is None
    )
