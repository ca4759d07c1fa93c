"""The lowest of many noisy passes: its bias, and that the floor's sigma is honest."""

import numpy as np
import pytest

from pipeline.surface.lowest_pass import last_floor, lowest_floor

S = 0.005
CELLS = 6000


def drawn(passes, true_above, seed=1):
    """Noisy passes of many cells whose floor is at 0: first, heights, sigmas."""
    rng = np.random.default_rng(seed)
    z = true_above(rng, (CELLS, passes))
    z = z - z.min(axis=1, keepdims=True)
    return np.arange(CELLS + 1) * passes, (z + rng.normal(0, S, z.shape)).ravel(), np.full(z.size, S)


ALL_AT_THE_FLOOR = lambda rng, shape: np.zeros(shape)  # noqa: E731
LAYERS = lambda rng, shape: rng.uniform(0, 0.3, shape)  # noqa: E731
RIPPLES = lambda rng, shape: rng.normal(0, 0.01, shape)  # noqa: E731
HALF_FINISHING = lambda rng, shape: np.where(rng.random(shape) < 0.5, 0, rng.uniform(0, 0.3, shape))  # noqa: E731


@pytest.mark.parametrize("passes, expected", [(2, -0.564), (4, -1.029), (10, -1.539)])
def test_the_plain_lowest_is_biased_by_the_expected_minimum_of_normals(passes, expected):
    floor = lowest_floor(*drawn(passes, ALL_AT_THE_FLOOR), corrected=False)
    assert floor.height.mean() / S == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("true_above", [ALL_AT_THE_FLOOR, LAYERS, RIPPLES, HALF_FINISHING])
@pytest.mark.parametrize("passes", [2, 4])
def test_the_bias_is_removed_and_sigma_is_honest(passes, true_above):
    arguments = drawn(passes, true_above)
    floor = lowest_floor(*arguments)
    assert abs(floor.height.mean()) < 0.2 * S
    assert 0.9 < np.sqrt(np.mean((floor.height / floor.sigma_own) ** 2)) < 1.13
    # The claim needs the correction: without it the same bar is missed where passes share the floor.
    plain = lowest_floor(*arguments, corrected=False)
    if true_above in (ALL_AT_THE_FLOOR, HALF_FINISHING) and passes == 4:
        assert abs(plain.height.mean()) > 0.4 * S


def few_sweeps(rng, rows=120, sweeps=36, length=40):
    """A trench dug in sweeps of 40 cells, three over each stretch; errors wander slowly within one, and all its cells
    share them: first, heights, sigmas, times, and the true floor.
    """
    starts = np.repeat(np.linspace(-length / 2, rows - length / 2, sweeps // 3).round().astype(int), 3)
    passes = [[] for _ in range(rows)]
    for k, start in enumerate(starts):
        above = abs(rng.normal(0, 2 * S))
        error = np.sqrt(1.5) * np.interp(
            np.arange(length), np.linspace(0, length - 1, 5), rng.normal(0, S, 5)
        )
        for i in range(length):
            if 0 <= start + i < rows:
                passes[start + i].append((above, above + error[i], k))
    flat = np.array([one for cell in passes for one in cell])
    first = np.concatenate([[0], np.cumsum([len(cell) for cell in passes])])
    floor = np.array([min(above for above, *_ in cell) for cell in passes])
    return first, flat[:, 1], np.full(len(flat), S), (1e10 * flat[:, 2]).astype(np.int64), floor


def test_few_sweeps_do_not_invent_a_sharp_floor():
    """Cells that share the errors of a few sweeps are no more witnesses than the sweeps are: without them counted the
    floor lies 0.65 of its sigma too high, and is 1.4 of it off.
    """
    bias, square = [], []
    for seed in range(20):
        first, height, sigma, time_ns, truth = few_sweeps(np.random.default_rng(seed))
        floor = lowest_floor(first, height, sigma, time_ns=time_ns)
        z = (floor.height - truth) / floor.sigma_own
        bias.append(z.mean())
        square.append(np.mean(z**2))
    print(f"bias {np.mean(bias):.2f}, RMS {np.sqrt(np.mean(square)):.2f} of the floor's own sigma")
    assert abs(np.mean(bias)) < 0.3
    assert 0.85 < np.sqrt(np.mean(square)) < 1.2


def test_many_passes_at_one_level_are_sharper_than_one():
    floor = lowest_floor(*drawn(10, ALL_AT_THE_FLOOR))
    assert abs(floor.height.mean()) < 0.35 * S  # of 1.54 before
    assert floor.height.std() < 0.6 * S
    assert np.median(floor.sigma_own) < 0.6 * S


def test_one_pass_is_its_own_floor():
    first, height, sigma = drawn(1, ALL_AT_THE_FLOOR)
    floor = lowest_floor(first, height, sigma)
    assert np.array_equal(floor.height, height)
    assert np.array_equal(floor.sigma_own, sigma)
    assert len(floor.excess_m) == 0


def test_passes_far_above_say_nothing():
    floor = lowest_floor(np.array([0, 3]), np.array([1.5, 1.0, 1.2]), np.full(3, S))
    assert (floor.height[0], floor.sigma_own[0], floor.lowest_pass[0], floor.passes_near[0]) == (1.0, S, 1, 1)


def test_the_floor_moves_with_its_passes_and_grows_with_their_unit():
    first, height, sigma = drawn(3, RIPPLES)
    floor = lowest_floor(first, height, sigma)
    shifted = lowest_floor(first, height + 7.25, sigma)
    assert np.allclose(shifted.height, floor.height + 7.25, rtol=0, atol=1e-9)
    scaled = lowest_floor(first, 10 * height, 10 * sigma)
    assert np.allclose(scaled.height, 10 * floor.height, rtol=0, atol=1e-9)
    assert np.allclose(scaled.sigma_own, 10 * floor.sigma_own, rtol=1e-6)


def test_cells_without_a_pass_have_no_floor():
    floor = lowest_floor(np.array([0, 0, 2, 2]), np.array([1.0, 1.001]), np.full(2, S))
    assert np.isnan(floor.height[[0, 2]]).all() and np.isfinite(floor.height[1])
    assert floor.lowest_pass.tolist() == [-1, 0, -1]
    for empty in (lowest_floor, last_floor):
        assert np.isnan(empty(np.zeros(4, int), np.zeros(0), np.zeros(0)).height).all()


def test_a_precise_pass_outweighs_a_poor_one():
    first = 2 * np.arange(2001)
    rng = np.random.default_rng(2)
    sigma = np.tile([0.002, 0.02], 2000)
    height = rng.normal(0, sigma)
    floor = lowest_floor(first, height, sigma)
    assert np.median(floor.sigma_own) < 0.003
    assert np.sqrt(np.mean(floor.height**2)) < 0.004
    assert np.sqrt(np.mean(lowest_floor(first, height, sigma, corrected=False).height ** 2)) > 0.01


def test_the_last_pass_is_the_last_and_not_the_lowest():
    floor = last_floor(np.array([0, 3, 4]), np.array([1.0, 0.5, 0.9, 2.0]), np.full(4, S))
    assert floor.height.tolist() == [0.9, 2.0]
    assert floor.lowest.tolist() == [0.5, 2.0]
    assert floor.lowest_pass.tolist() == [2, 3]
