"""Changes in time, on corners drawn by another camera model: found, named, sized; and none where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.config.site import EstimationSettings, Split
from pipeline.estimation import adjust, changes, split, steps
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.normal import linearise
from pipeline.estimation.optimise import optimise
from pipeline.estimation.parts import bounds
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation import dense
from tests.estimation.faults import MOVED_M, TURNED_RAD, inject, scene
from tests.estimation.simulator import T0_NS

HUBER = 2.5


def _problem(drawn):
    tied = tie(drawn.network, drawn.observations, drawn.readings)
    return problem_of_log(
        drawn.network, tied, epochs_of(drawn.network, drawn.observations.take(tied.used), drawn.readings)
    )


@pytest.fixture(scope="module")
def clean():
    return scene(1, 40.0)


@pytest.mark.parametrize("size", [2048, 7])
def test_scores_and_information_of_a_step_are_those_of_one_more_dense_column(size, monkeypatch):
    """The step's column written out: its border from the instant on, eliminated by a dense solve; in parts, too."""
    monkeypatch.setattr("pipeline.estimation.optimise.bounds", lambda problem: bounds(problem, size))
    problem = _problem(scene(3, 3.0))
    values = problem.first
    weights = changes.wide_weights(problem, values, 1e6)
    at = np.array([0, 4, 11, 20])
    found = steps.sums(problem, values, weights, at)
    chains, C, g_z = linearise(problem, values, weights)
    H, gradient, starts = dense.assemble(chains, C, g_z)
    scale = 1 / np.sqrt(np.diagonal(H))
    groups = [(g, corner_residuals) for g in problem.corners]
    groups += [(s, sensor_residuals) for s in problem.sensors]
    worst = 0.0
    for s, rows in found.rows.items():
        columns = problem.statics.columns[s]
        for j, epoch in enumerate(at[1:], start=1):
            N = np.zeros((len(H), len(columns)))
            for chain, start in zip(chains, starts, strict=False):
                here = np.isin(columns, chain.columns)
                border = chain.B[:, :, np.searchsorted(chain.columns, columns[here])].copy()
                border[:epoch] = 0
                N[start : start + chain.g.size, here] = border.reshape(chain.g.size, -1)
            own, score = np.zeros((len(columns), len(C))), np.zeros(len(columns))
            for group, residuals in groups:
                r, J = residuals(group, values, problem.statics)
                if s in J.statics:
                    late = group.epoch >= epoch
                    for other, J_other in J.statics.items():
                        own[:, problem.statics.columns[other]] += np.einsum(
                            "nmi,nmj->ij", J.statics[s][late], J_other[late]
                        )
                    score += np.einsum("nmi,nm->i", J.statics[s][late], r[late])
            N[starts[-1] :] = own.T
            solved = scale[:, None] * np.linalg.solve(H * scale[:, None] * scale, scale[:, None] * N)
            expected = own[:, columns] - N.T @ solved
            ours = found.own[j][np.ix_(rows, rows)]
            ours = ours - found.cross[j][rows] @ found.P_zz @ found.cross[j][rows].T
            worst = max(worst, np.abs(ours - expected).max() / np.abs(expected).max())
            assert found.g[j][rows] == pytest.approx(
                score - solved.T @ gradient, rel=1e-6, abs=1e-6 * np.abs(score).max()
            )
    print(f"\ninformation of steps against dense algebra: {worst:.1e}")
    assert worst < 1e-8


def _trace(drawn):
    problem = _problem(drawn)
    optimum = optimise(problem, HUBER, 60)
    return problem, split.trace(problem, optimum, HUBER, 60)


def test_a_benchmark_that_moved_is_named_with_its_instant_and_its_size(clean):
    problem, (steps, _, _) = _trace(inject(clean, ["benchmark"], at_s=25.0).drawn)
    assert [problem.network.statics[s.static].name for s in steps] == ["benchmark B2 pose"]
    step = steps[0]
    away = step.shift[:3] - MOVED_M * np.array([0.6, 0.8, 0.0])
    t = problem.epochs.time_s
    print(
        f"\nB2 {1000 * step.shift[:3]} mm ± {1000 * np.sqrt(np.diagonal(step.cov))[:3]}, {t[step.change.epoch]} s"
    )
    assert np.all(np.abs(away) < 3.5 * np.sqrt(np.diagonal(step.cov))[:3])
    assert np.sqrt(step.cov[1, 1]) < 0.001
    assert t[step.change.first] - 0.5 <= 25.0 <= t[step.change.last] + 0.5
    assert t[step.change.last] - t[step.change.first] < 5


def test_a_camera_that_turned_is_told_as_one_of_the_two_that_sit_on_the_cab(clean):
    problem, (steps, _, _) = _trace(inject(clean, ["mount"], at_s=45.0).drawn)  # at 25 s
    names = [problem.network.statics[s].name for s in (steps[0].static, *steps[0].others)]
    assert len(steps) == 1 and {"camera bench mount", "camera dig mount"} <= set(names)
    turn, sigma = np.linalg.norm(steps[0].shift[3:]), np.sqrt(np.trace(steps[0].cov[3:, 3:]))
    print(f"\nturned {np.rad2deg(turn):.4f} ± {np.rad2deg(sigma):.4f} deg")
    assert abs(turn - TURNED_RAD) < 3 * sigma and sigma < 0.2 * TURNED_RAD


@pytest.mark.slow
def test_two_changes_are_not_told_as_a_third():
    """A camera turns while nothing is seen, and then a board moves: what explains both best alone is another board."""
    drawn = inject(scene(1, 90.0), ["benchmark", "mount"], at_s=60.0).drawn  # the mount at 40 s
    t = (drawn.observations.time_ns - T0_NS) * 1e-9
    seen = drawn.observations.take(np.flatnonzero((t < 22) | (t >= 52)))
    problem, (steps, _, _) = _trace(replace(drawn, observations=seen))
    told = [(problem.network.statics[s.static].name, problem.epochs.time_s[s.change.epoch]) for s in steps]
    print(f"\n{[f'{name} at {at:.1f} s' for name, at in told]}")
    assert {name for name, _ in told} in (
        {"benchmark B2 pose", "camera dig mount"},
        {"benchmark B2 pose", "camera bench mount"},
    )
    assert dict(told)["benchmark B2 pose"] == pytest.approx(60.0, abs=0.5)


@pytest.mark.parametrize("repeated_px", [0.0, 0.1])
def test_nothing_is_named_where_nothing_moved_though_corner_errors_drift(repeated_px):
    """0.1 px against 0.2 px of noise, half of it drifting over ten seconds: T alone would be 100 and more."""
    _, (steps, _, _) = _trace(scene(102, 60.0, repeated_px))
    assert steps == ()


def test_telling_the_adjustment_where_to_split_mends_the_edge(clean):
    """A board moved by 10 mm bends the poses; split there, they are those of the clean log."""
    dirty = inject(clean, ["benchmark"], at_s=25.0).drawn
    at = np.datetime64(T0_NS + 25 * 10**9, "ns").astype("datetime64[ms]").item()
    told = Split.model_validate({"static": "benchmark B2 pose", "at": f"{at:%Y-%m-%dT%H:%M:%S}Z"})
    off = {}
    for name, drawn, settings in (
        ("clean", clean, EstimationSettings()),
        ("not told", dirty, EstimationSettings()),
        ("told", dirty, EstimationSettings(split=(told,))),
    ):
        solution = adjust(drawn.network, drawn.observations, drawn.readings, settings)
        error, rows = drawn.error(solution.body("tool"))
        late = solution.body("tool").time_ns[rows] >= T0_NS + 25 * 10**9
        off[name] = float(np.sqrt(np.mean(np.sum(error[late, :3] ** 2, axis=1))))
        if name == "not told":
            found = solution.diagnostics["changes"]["found"]
            assert [c["static"] for c in found] == ["benchmark B2 pose"]
            assert any(
                "benchmark B2 moved 10.0 mm" in w or "benchmark B2 moved" in w for w in solution.warnings
            )
            print("\n" + found[0]["sentence"])
    print(f"edge RMSE, mm: { ({k: round(1000 * v, 2) for k, v in off.items()}) }")
    assert off["told"] < 1.2 * off["clean"]
