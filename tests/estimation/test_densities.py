"""Motion densities learned from a log, what is parked, and how errors grow where nothing is seen."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from pipeline.config.site import EstimationSettings
from pipeline.estimation import adjust
from tests.estimation.simulator import MACHINE, Options, draw


def _wrong_by(drawn, factor):
    """The network with densities that are wrong by a factor."""
    bodies = {
        name: replace(b, motion=tuple(factor * q for q in b.motion))
        for name, b in drawn.network.bodies.items()
    }
    return replace(drawn.network, bodies=bodies)


@pytest.mark.parametrize("factor", [30.0, 1 / 30])
def test_densities_come_back_from_starts_that_are_thirty_times_wrong(factor):
    drawn = draw(21, Options(epochs=120, frame_s=0.1, reading_s=0.1))
    solution = adjust(_wrong_by(drawn, factor), drawn.observations, drawn.readings, learn=True)
    assert solution.diagnostics["converged"]
    told = solution.diagnostics["learned"]["motion"]
    for body, true in MACHINE["motion"].items():
        for part, found in told[body]["working"].items():
            if part == "seconds" or not found["learned"]:
                continue
            ratio = found["density"] / true[part]
            print(f"{body} {part}: {ratio:.2f} of the truth, {found['measured']:.0f} increments measured")
            # A variance of n draws is known to sqrt(2 / n); three of them, and what three rounds leave.
            assert abs(np.log(ratio)) < 3 * np.sqrt(2 / found["measured"]) + 0.5


def test_a_machine_that_rests_and_then_works_is_told_apart():
    """Ten seconds at rest, then the motion of the simulator: two densities, far apart."""
    rest, work = copy.deepcopy(MACHINE), draw(22, Options(epochs=60, frame_s=0.1, reading_s=0.1))
    for density in rest["motion"].values():
        density["translation"], density["rotation"] = 1e-9, 1e-10
    still = draw(22, Options(epochs=60, frame_s=0.1, reading_s=0.1, machine=rest))
    span = int(still.frame_ns[-1] - still.frame_ns[0]) + 100_000_000
    late = replace(work.observations, time_ns=work.observations.time_ns + span)
    seen = type(late)(*(
        np.concatenate([getattr(still.observations, f), getattr(late, f)])
        for f in ("camera", "tag", "time_ns", "uv", "cov")
    ))  # fmt: skip
    pots = still.readings["pot"], work.readings["pot"]
    pot = type(pots[0])(
        np.concatenate([pots[0].time_ns, pots[1].time_ns + span]), np.concatenate([pots[0].raw, pots[1].raw])
    )
    solution = adjust(work.network, seen, {"pot": pot}, learn=True)
    cab = solution.diagnostics["learned"]["motion"]["cab"]
    print(cab)
    assert 3.0 < cab["parked"]["seconds"] < 8.0  # six, less the window on either side
    for part in ("translation", "rotation"):
        assert cab["parked"][part]["density"] < 0.2 * cab["working"][part]["density"]


def test_errors_in_a_gap_of_a_minute_stay_inside_their_covariance():
    machine = copy.deepcopy(MACHINE)
    slow = {"cab": (1e-6, 1e-8), "stick": (1e-6, 1e-8), "bucket": (1.0, 1e-8)}
    for body, (translation, rotation) in slow.items():
        machine["motion"][body] = {"translation": translation, "rotation": rotation}
    squares, widths = [], []
    for seed in range(6):
        drawn = draw(
            30 + seed, Options(epochs=160, frame_s=0.5, reading_s=0.5, blind=((10.0, 70.0),), machine=machine)
        )
        solution = adjust(
            drawn.network, drawn.observations, drawn.readings, EstimationSettings(max_gap_s=0.5)
        )
        cab = solution.body("cab")
        t = (cab.time_ns - drawn.frame_ns[0]) * 1e-9
        inside = (t > 10.5) & (t < 69.0)
        assert not cab.seen[inside].any()
        error, rows = drawn.error(cab)
        P = cab.own + cab.common
        whitened = np.linalg.solve(np.linalg.cholesky(P[rows]), error[..., None])[..., 0]
        squares.append(np.mean(whitened[inside[rows]] ** 2, axis=0))
        variance = np.trace(cab.own[np.argmin(np.abs(t - 40.0)), :3, :3]) / 3
        widths.append(np.sqrt(variance / (1e-6 * 60.0**3 / 192)))
    print(
        f"mean squared whitened error in the gap {np.mean(squares):.2f}, sigma over the closed form {widths}"
    )
    # Between two known poses and velocities the variance in the middle is q T³ / 192; known, they are only nearly.
    assert min(widths) > 0.95
    assert max(widths) < 1.3
    # Six axes of six gaps, each about two independent values: 72, whose mean square is 1 +- 0.17.
    assert 0.5 < np.mean(squares) < 1.5
