"""What a log cannot tell is found before solving, named with its time, and held; nothing becomes singular."""

import dataclasses

import numpy as np
import pytest

from pipeline.estimation import adjust, observability
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.observability import findings, information, null_space
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.network.drawing import T0_NS, draw
from tests.network.test_networks import SCENES


def _scene(name, **changes):
    return dataclasses.replace(next(s for s in SCENES if s.name == name), **{"epochs": 60, **changes})


def _problem(drawn):
    tied = tie(drawn.network, drawn.observations, drawn.readings)
    epochs = epochs_of(drawn.network, drawn.observations.take(tied.used), drawn.readings)
    return problem_of_log(drawn.network, tied, epochs)


def _found(scene, kind):
    return [f for f in findings(_problem(draw(scene, 1))) if f.kind == kind]


def test_two_mounts_of_which_only_the_product_is_seen_are_named_together():
    """Cameras 1 and 2 of Fig. 3: turn both mounts alike and the cab back, and no picture changes."""
    (pair,) = _found(_scene("third-camera"), "in series")
    assert pair.quantities == ("camera bench mount", "camera dig mount")
    assert "their product, not the two (6 unknowns)" in pair.sentence
    assert (pair.start_ns, pair.end_ns) == (T0_NS, T0_NS + 59 * 200_000_000)


def test_no_pair_is_left_where_one_of_the_two_is_exact():
    exact = (("[-92, 1, 5], sigma_mm = 2, sigma_deg = 0.05", "[-92, 1, 5], sigma_mm = 0, sigma_deg = 0"),)
    scene = _scene("third-camera", replaced=exact)
    assert _found(scene, "in series") == []


def test_a_time_offset_without_a_second_clock_is_named_and_held():
    drawn = draw(_scene("potentiometer"), 1)
    said = [f for f in findings(_problem(drawn)) if f.quantities == ("sensor bucket_cylinder time offset",)]
    assert len(said) == 1 and "stays at the file's 20 ms within 3.0 ms" in said[0].sentence
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    offset = next(s for s in solution.statics if s.quantity.endswith("time offset"))
    assert offset.value == offset.file_value and offset.sigma == pytest.approx(offset.prior_sigma)
    assert any("time offset of sensor" in f["sentence"] for f in solution.diagnostics["observability"])


def test_a_marker_on_the_bucket_is_the_second_clock():
    board = (
        '[cutting_edge]\nbody = "bucket"',
        '[markers.bucket_board]\nbody = "bucket"\nmount = { xyz_m = [-0.3, -0.5, 0.0], rpy_deg = [0, -70, -90], '
        'sigma_mm = 1.5, sigma_deg = 0.1 }\nfamily = "tag36h11"\ntags = [{ id = 60, size_m = 0.25 }]\n\n'
        '[cutting_edge]\nbody = "bucket"',
    )
    rough = (
        "sigma_time_offset_s = 0.003",
        "sigma_time_offset_s = 0.05",
    )  # better than 3 ms a tag at 6 m is no clock
    for replaced, told in (((rough,), False), ((rough, board), True)):
        untold = _found(_scene("potentiometer", replaced=replaced), "untold")
        assert told != any("time offset" in q for f in untold for q in f.quantities)


@pytest.mark.parametrize("hidden, seen", [(("B3",), 2), (("B2", "B3"), 1), ((), 3)])
def test_benchmarks_on_one_line_are_named_with_what_rests_on_it(hidden, seen):
    scene = _scene("third-camera", hidden=dict.fromkeys(hidden, ((0.0, 1e9),)))
    scene = dataclasses.replace(scene, replaced=(('body = "world"', 'body = "cab"'),))  # no surveyed camera
    line = _found(scene, "line")
    if seen == 3:
        assert line == []
        return
    assert line[0].quantities == ("B1", "B2")[:seen]
    assert f"{0.05 / seen**0.5:.3f} deg" in line[0].sentence  # as surveyed, over the root of their number


def test_a_gauge_is_named_with_its_time_and_the_rest_is_solved_all_the_same():
    """No picture shows the undercarriage: swing and undercarriage turn into each other, the bucket stays known."""
    scene = _scene("full-chain", hidden={"track_board": ((0.0, 1e9),)})
    drawn = draw(scene, 1)
    (gauge,) = [f for f in findings(_problem(drawn)) if f.kind == "gauge"]
    assert set(gauge.quantities) == {"undercarriage", "cab"} and "from 0.0 to 11.8 s" in gauge.sentence
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    assert solution.diagnostics["converged"] and gauge.sentence in solution.warnings
    tool, swing = solution.body("tool"), solution.body("cab")
    e, P = drawn.errors(tool), tool.own + tool.common
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e)
    print(f"tool NEES {nees.mean():.1f}, swing sigma {np.rad2deg(np.median(swing.sigma_angle_rad)):.0f} deg")
    assert nees.mean() < 16.8  # 99 % of chi-square, 6
    assert np.median(swing.sigma_angle_rad) > 0.5  # and it says that it does not know the swing


def test_the_gauge_is_there_only_while_the_marker_is_hidden():
    drawn = draw(_scene("full-chain", epochs=256, hidden={"track_board": ((12.8, 25.6),)}), 1)
    (gauge,) = [f for f in findings(_problem(drawn)) if f.kind == "gauge"]
    assert "from 12.8 to 25.4 s" in gauge.sentence


def test_networks_whose_bodies_are_all_in_view_have_no_gauge():
    for name in ("cluster", "flip-marker", "two-machines", "potentiometer"):
        assert _found(_scene(name, epochs=70), "gauge") == []


def test_the_data_tell_nothing_in_the_null_space_and_something_beside_it():
    """Oracle: pictures drawn again with the two mounts moved along, and moved against each other."""
    problem = _problem(draw(_scene("third-camera"), 1))
    H = information(problem)
    names = [s.name for s in problem.network.statics]
    both = np.concatenate(
        [problem.statics.columns[names.index(f"camera {c} mount")] for c in ("bench", "dig")]
    )
    N = null_space(H[np.ix_(both, both)], 0.1)
    T = [problem.network.statics[names.index(f"camera {c} mount")].value for c in ("bench", "dig")]
    # A common small turn D about the cab's origin: T' = D T = T exp(Ad(T^-1) d), whitened by the sigmas.
    d = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1e-3])
    z = []
    for M in T:
        R, p = M[:3, :3], M[:3, 3]
        z += [R.T @ np.cross(d[3:], p) / 0.002, R.T @ d[3:] / np.deg2rad(0.05)]
    z = np.concatenate(z)
    assert np.linalg.norm(z - N @ (N.T @ z)) < 1e-3 * np.linalg.norm(z)
    z[6:] *= -1
    assert np.linalg.norm(z - N @ (N.T @ z)) > 0.3 * np.linalg.norm(z)


def test_of_a_long_log_stretches_are_looked_at_and_the_same_is_found(monkeypatch):
    problem = _problem(draw(_scene("third-camera", epochs=150), 1))
    whole = [f.quantities for f in findings(problem)]
    monkeypatch.setattr(observability, "EPOCHS", 40)
    monkeypatch.setattr(observability, "STRETCHES", 4)
    part = findings(problem)
    assert [f.quantities for f in part] == whole
    assert (part[0].start_ns, part[0].end_ns) == (T0_NS, T0_NS + 149 * 200_000_000)


def test_a_start_that_cannot_be_factored_is_no_error(monkeypatch):
    def singular(*_):
        raise np.linalg.LinAlgError

    problem = _problem(draw(_scene("third-camera", epochs=10), 1))
    monkeypatch.setattr(observability.arrow, "solve", singular)
    assert [f.kind for f in findings(problem)] == []
