"""A veil that is eliminated first against the same least squares with all of it at once."""

import numpy as np

from pipeline.detection.image_model import GAIN, PARAMETERS, VEIL_TERMS
from pipeline.detection.veil import BENT_SIGMAS, bent_light, eliminate_veil, without_veil


def powers(x, y):
    """Of the second to fourth order, written out anew."""
    return np.stack([x ** (n - j) * y**j for n in (2, 3, 4) for j in range(n + 1)], axis=-1)


def drawn(m=900):
    rng = np.random.default_rng(3)
    J = rng.normal(size=(m, PARAMETERS))
    J[:, 2:4] = rng.uniform(-1, 1, (m, 2))  # slopes: the place of the pixel
    return rng, J, powers(J[:, 2], J[:, 3])


def test_print_and_veil_step_as_in_one_least_squares():
    rng, J, Q = drawn()
    assert Q.shape[1] == VEIL_TERMS
    r, noise = rng.normal(0, 2, len(J)), 2.0
    par = rng.normal(size=PARAMETERS + VEIL_TERMS)
    par[GAIN] = 100.0
    weight = (noise / (0.3 * par[GAIN] + 1)) ** 2
    both = np.hstack([J, Q])
    H, g = both.T @ both, both.T @ r
    H[PARAMETERS:, PARAMETERS:] += weight * np.eye(VEIL_TERMS)
    g[PARAMETERS:] -= weight * par[PARAMETERS:]
    due = np.linalg.solve(H, g)
    A, b = J.T @ J, J.T @ r
    K, change = eliminate_veil(A, b, J, r, len(J), par, noise)
    x = np.linalg.solve(A, b)
    np.testing.assert_allclose(x, due[:PARAMETERS], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(change - K @ x, due[PARAMETERS:], rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(
        np.linalg.inv(A), np.linalg.inv(H)[:PARAMETERS, :PARAMETERS], rtol=1e-8, atol=1e-12
    )
    left = r.copy()
    without_veil(J, left, len(J), due[PARAMETERS:])
    np.testing.assert_allclose(left, r - Q @ due[PARAMETERS:], atol=1e-12)


def test_noise_is_not_bent_and_a_hot_spot_is():
    rng, J, _ = drawn()
    x, y = J[:, 2], J[:, 3]
    noise = rng.normal(0, 2, len(J))
    spot = 40 * np.exp(-((x - 0.8) ** 2 + (y + 0.4) ** 2) / 0.5)
    slopes = np.stack([np.ones_like(x), x, y], axis=-1)
    bent = spot - slopes @ np.linalg.lstsq(slopes, spot, rcond=None)[0]
    assert BENT_SIGMAS > 5
    assert not bent_light(J, noise, len(J), 2.0)
    assert bent_light(J, noise + bent, len(J), 2.0)
