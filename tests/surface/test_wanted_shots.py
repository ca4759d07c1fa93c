"""The shots that would settle most: the chance of settling against drawn truths, and which stations are chosen."""

import numpy as np
import pytest
from scipy.stats import norm

from pipeline.surface.decision import CANNOT_TELL, CUT, PARTLY, PASS, Stations, ToleranceBand, decide
from pipeline.surface.wanted_shots import wanted_shots

BAND = ToleranceBand(0.03, 0.03)
SHOT_M = 0.002


def stations(deviation, own, common, scatter=0.0, state=CUT):
    deviation, own, common, scatter = np.broadcast_arrays(deviation, own, common, scatter)
    n = len(deviation)
    u = 2 * np.hypot(own, common)
    verdict = np.array([decide(d, x, BAND)[0] for d, x in zip(deviation, u)], object)
    nothing = np.zeros(n)
    return Stations(
        station=100.0 + np.arange(n), state=np.full(n, state, object), h=nothing, design_h=nothing,
        deviation=deviation, sigma_own=own, sigma_common=common, expanded_uncertainty=u, scatter=scatter,
        width=nothing, cells_cut=np.full(n, 100), cells_floor=np.full(n, 100), verdict=verdict,
        reason=np.full(n, "", object),
    )  # fmt: skip


def dense_conditional(own, common, noise, shot):
    """Covariance of all stations' errors after the shots, by the plain formula with whole matrices."""
    cov = np.diag(own**2) + np.outer(common, common)
    h = np.eye(len(own))[shot]
    s = h @ cov @ h.T + np.diag(noise[shot] ** 2)
    gain = cov @ h.T @ np.linalg.inv(s)
    return cov - gain @ h @ cov


def test_expected_number_settled_is_that_of_drawn_errors_and_shots():
    rng = np.random.default_rng(3)
    own, common = rng.uniform(0.002, 0.006, 8), rng.uniform(0.006, 0.012, 8)
    scatter = rng.uniform(0.001, 0.004, 8)
    at = stations(rng.uniform(0.014, 0.027, 8), own, common, scatter)
    found = wanted_shots(at, BAND, SHOT_M, most=2)
    open_ = np.flatnonzero(at.verdict == CANNOT_TELL)
    assert len(found.shots) == 2
    own, common, noise = own[open_], common[open_], np.hypot(SHOT_M, scatter[open_])
    shot = np.isin(at.station[open_], [s.station for s in found.shots])
    # Condition each draw of shots densely and judge by the rule itself.
    n, settled = len(open_), 0
    draws = 4000
    cov = np.diag(own**2) + np.outer(common, common)
    after = dense_conditional(own, common, noise, shot)
    h = np.eye(n)[shot]
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + np.diag(noise[shot] ** 2))
    root = np.linalg.cholesky(cov)
    for _ in range(draws):
        error = root @ rng.normal(size=n)
        seen = (error + noise * rng.normal(size=n))[shot]
        estimate = at.deviation[open_] + gain @ seen
        verdicts = [decide(d, 2 * np.sqrt(v), BAND)[0] for d, v in zip(estimate, np.diag(after))]
        settled += sum(v != CANNOT_TELL for v in verdicts)
    expected = found.shots[-1].settles
    print(f"expected {expected:.3f} settled of {n}, drawn {settled / draws:.3f}")
    assert settled / draws == pytest.approx(expected, abs=4 * np.sqrt(n) / np.sqrt(draws))


def test_one_station_alone_settles_with_the_chance_of_the_closed_form():
    at = stations([0.024], [0.004], [0.003])
    (shot,) = wanted_shots(at, BAND, SHOT_M).shots
    before, noise = 0.004**2 + 0.003**2, SHOT_M**2
    after = before * noise / (before + noise)
    u, moves = 2 * np.sqrt(after), np.sqrt(before - after)
    inside = norm.cdf((0.03 - u - 0.024) / moves) - norm.cdf((-0.03 + u - 0.024) / moves)
    outside = norm.sf((0.03 + u - 0.024) / moves) + norm.cdf((-0.03 - u - 0.024) / moves)
    assert shot.settles == pytest.approx(inside + outside, abs=1e-12)


def test_where_the_common_error_rules_one_shot_settles_many_and_where_the_own_does_only_its_own():
    together = wanted_shots(stations(np.full(6, 0.02), 0.0005, 0.008), BAND, SHOT_M)
    alone = wanted_shots(stations(np.full(6, 0.02), 0.008, 0.0005), BAND, SHOT_M)
    assert together.shots[0].settles > 4
    assert alone.shots[0].settles < 1.1
    assert len(together.shots) < len(alone.shots)


def test_each_shot_adds_less_than_all_of_them_and_what_digging_must_settle_is_told_apart():
    at = stations(np.full(5, 0.02), 0.006, 0.004)
    found = wanted_shots(at, BAND, SHOT_M)
    settled = [0.0, *(s.settles for s in found.shots)]
    assert np.all(np.diff(settled) > 0) and settled[-1] <= found.best_alone + 1e-12 <= found.open
    partly = wanted_shots(stations(np.full(5, 0.02), 0.006, 0.004, state=PARTLY), BAND, SHOT_M)
    assert partly.shots == () and partly.partly == 5 and partly.open == 0


def test_nothing_is_asked_for_where_nothing_is_open_or_no_shot_would_help():
    assert wanted_shots(stations([0.0, 0.001], 0.001, 0.001), BAND, SHOT_M).open == 0
    assert set(stations([0.0], [0.001], [0.001]).verdict) == {PASS}
    hopeless = wanted_shots(stations([0.03], [0.001], [0.0]), BAND, 0.005)
    assert hopeless.open == 1 and hopeless.shots == ()


def test_a_station_that_waits_for_a_side_is_not_shot():
    at = stations(np.full(3, 0.02), 0.006, 0.004)
    found = wanted_shots(at, BAND, SHOT_M, only=np.array([True, False, False]))
    assert found.open == 1 and [shot.station for shot in found.shots] == [100.0]
