"""Motion densities learned from a log, what is parked, and how errors grow where nothing is seen."""

import copy
import sys
from dataclasses import replace

import numpy as np
import pytest

from pipeline.config import Machine, Site
from pipeline.config.site import EstimationSettings
from pipeline.estimation import adjust
from pipeline.geometry import se3
from pipeline.network import network_of
from tests.estimation.simulator import (
    MACHINE,
    SIGMA_PX,
    SITE,
    T0_NS,
    Drawn,
    Options,
    draw,
    level,
    observed,
    pictures,
    true_static,
)


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
            for density, shake, measured in zip(
                found["density"], found["shake"], found["measured"], strict=True
            ):
                ratio = density / true[part]
                print(f"{body} {part}: {ratio:.2f} of the truth, {measured:.0f} increments measured")
                # A variance of n draws is known to sqrt(2 / n); three of them, and what three rounds leave.
                assert abs(np.log(ratio)) < 3 * np.sqrt(2 / measured) + 0.5
                assert shake < 0.3**2 / 3 * density  # nothing shakes: less than it works over three frames


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
        assert max(cab["parked"][part]["density"]) < 0.2 * min(cab["working"][part]["density"])


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


def _shaken(seed: int) -> Drawn:
    """A cab that shakes at 0.7 to 4 Hz and turns; its camera takes pictures at 5 Hz, the stick's half-way between."""
    rng = np.random.default_rng(seed)
    document = copy.deepcopy(MACHINE)
    del document["sensors"], document["bodies"]["bucket"]
    document["cutting_edge"] |= {"body": "stick"}
    document["motion"] = {"cab": {"translation": 0.02, "rotation": 0.01}, "stick": {"translation": 0.1}}
    machine, site = Machine.model_validate(document), Site.model_validate(SITE)
    network = network_of(machine, site)
    statics = [true_static(rng, s) for s in network.statics]
    by_name = {s.name: value for s, value in zip(network.statics, statics, strict=True)}
    t = np.arange(0.0, 60.0, 0.1)
    rate = 2 * np.pi * np.exp(rng.uniform(np.log(0.7), np.log(4.0), (6, 12, 1)))
    waves = np.sin(rate * t + rng.uniform(0, 2 * np.pi, (6, 12, 1))).sum(axis=1) / np.sqrt(6)
    rms = np.array([0.002, 0.002, 0.002, 0.001, 0.001, 0.0004])
    turn = np.zeros((len(t), 6))
    turn[:, 5] = 0.15 * np.sin(0.8 * t)
    T_cab = level([0.0, 0.0, 1.5]) @ se3.exp(turn) @ se3.exp((rms[:, None] * waves).T)
    T_stick = T_cab @ level([1.0, 6.0, -1.2])
    T_world = {"cab": T_cab, "stick": T_stick, "tool": T_stick @ by_name["cutting edge mount"]}
    time_ns = T0_NS + np.round(t * 1e9).astype(np.int64)
    drawn = Drawn(machine, site, network, None, {}, time_ns, T_world, statics, None, time_ns)
    rows = [
        (c, k, time_ns[i], uv + SIGMA_PX * rng.standard_normal((4, 2)))
        for c, k, i, uv in pictures(network, by_name, T_world, np.arange(len(t)))
        if i % 2 == ("bench", "dig").index(network.cameras[c].name)
    ]
    return replace(drawn, observations=observed(rows, SIGMA_PX**2))


@pytest.mark.parametrize("shakes", [True, False])
def test_a_shake_near_half_the_frame_rate_is_in_the_sigma_between_two_pictures(shakes, monkeypatch):
    """Root mean square of the cab's own error along z and about x and y, half-way between pictures, over its sigma."""
    if not shakes:
        monkeypatch.setattr(sys.modules["pipeline.estimation.adjust"], "shaking", lambda problem: problem)
    ratio = []
    for seed in range(3):
        drawn = _shaken(seed)
        cab = adjust(drawn.network, drawn.observations, {}, learn=True).body("cab")
        error, rows = drawn.error(cab)
        between = np.round((cab.time_ns[rows] - T0_NS) / 1e8).astype(int) % 2 == 1
        rows, error = rows[between], error[between]
        # What comes through the statics is no part of it: it differs by camera, and stays or goes with the cab's turn.
        turn = np.sin(0.8e-9 * (cab.time_ns[rows] - T0_NS))
        stays = np.stack([np.ones_like(turn), turn, turn**2], axis=-1)
        error = (error - stays @ np.linalg.lstsq(stays, error, rcond=None)[0])[:, 2:5]
        own = np.sqrt(np.einsum("nii->ni", cab.own[rows])[:, 2:5])
        ratio.append(np.sqrt(np.mean((error / own) ** 2, axis=0)))
    told = np.mean(ratio, axis=0)
    print(
        f"error over own sigma between pictures: {told.round(2)}, {'with' if shakes else 'without'} shaking"
    )
    # Acceleration alone makes the path between two pictures smoother than it was.
    assert np.all((told > 0.8) & (told < 1.2)) == shakes
