"""Idle spans against motions whose rest is known."""

import numpy as np
import pytest

from pipeline.report import render
from pipeline.report.idle import idle_spans
from tests.report.conftest import made_up_inputs

SECOND = 1_000_000_000
T0 = 1_790_000_000 * SECOND + 123_456_789
CORNER = np.array([501_200.0, 4_201_700.0, 58.0])


def edge(middle, t, noise=0.004, seen=None, seed=0):
    """A cutting edge of 1.2 m across the easting, its middle at (n, 3) metres from a corner of the grid."""
    n = len(t)
    points = middle[:, None] + CORNER + np.array([[-0.6, 0, 0], [0, 0, 0], [0.6, 0, 0]])
    points = points + np.random.default_rng(seed).normal(0, noise, points.shape)
    return {
        "time_ns": np.repeat(T0 + np.round(t * 1e9).astype(np.int64), 3),
        "point": np.array(["left", "middle", "right"] * n, object),
        **dict(zip("enh", points.reshape(-1, 3).T)),
        "seen": np.repeat(np.ones(n, bool) if seen is None else seen, 3),
    }


def strokes(t, rests):
    """Three metres a second at most, and nothing while it rests."""
    moving = np.ones(len(t))
    for start, end in rests:
        moving[(t >= start) & (t < end)] = 0.0
    way = np.cumsum(moving) * (t[1] - t[0])
    return np.stack([3 * np.sin(way), np.cos(0.7 * way), 0.5 * np.sin(1.3 * way)], axis=1)


def seconds(spans):
    return (spans - T0) / SECOND


@pytest.mark.parametrize("rate", [5, 10, 25])
def test_rests_are_found_to_the_second(rate):
    t = np.arange(0, 200, 1 / rate)
    rests = [(20.4, 41.7), (90.0, 99.2), (150.0, 152.0)]
    found = seconds(idle_spans(edge(strokes(t, rests), t), T0))
    # Whole seconds inside each rest; that of two seconds is the pause of an operator.
    assert found == pytest.approx(np.array([[21, 41], [90, 99]]), abs=1.01)
    assert np.all(found[:, 0] >= [20, 89.5]) and np.all(found[:, 1] <= [42, 100])


def test_digging_is_never_idle():
    t = np.arange(0, 600, 0.1)
    assert idle_spans(edge(strokes(t, []), t), T0).shape == (0, 2)


def test_creeping_is_not_standing_still():
    """5 mm a second: no second moves more than the noise, but a minute does."""
    t = np.arange(0, 60, 0.1)
    middle = np.stack([0.005 * t, 0 * t, 0 * t], axis=1)
    found = seconds(idle_spans(edge(middle, t), T0))
    assert np.all(found[:, 1] - found[:, 0] < 8) if len(found) else True


def test_a_bucket_that_turns_in_place_is_not_idle():
    """The middle rests, the corners go round."""
    t = np.arange(0, 60, 0.1)
    found = edge(np.zeros((len(t), 3)), t)
    turn = 0.3 * np.sin(0.8 * t)
    for name, side in (("left", -1), ("right", 1)):
        found["h"][found["point"] == name] += side * 0.6 * np.sin(turn)
    assert len(idle_spans(found, T0)) == 0


def test_what_was_not_seen_is_not_known_to_be_idle():
    t = np.arange(0, 60, 0.1)
    seen = (t < 20) | (t >= 40)
    found = seconds(idle_spans(edge(np.zeros((len(t), 3)), t, seen=seen), T0))
    assert found.tolist() == [[0, 20], [40, 60]]


def test_a_shake_of_the_engine_is_still_idle():
    t = np.arange(0, 60, 0.1)
    middle = 0.006 * np.stack([np.sin(37 * t), np.cos(29 * t), np.sin(31 * t)], axis=1)
    assert seconds(idle_spans(edge(middle, t), T0)).tolist() == [[0, 60]]


def test_an_empty_edge_has_no_idle_span():
    nothing = edge(np.zeros((0, 3)), np.zeros(0))
    assert idle_spans(nothing, T0).shape == (0, 2)


def test_the_page_says_how_long_the_machine_waited():
    coverage = render(made_up_inputs()).content["coverage"]
    # From the 70th to the 90th second; the log begins at 20 s past a minute.
    assert coverage["idle_count"]["value"] == 1
    assert coverage["idle_total"]["value"] == pytest.approx(20.0)
    (row,) = coverage["idle"]["rows"]
    assert row["seconds"] == 20.0 and row["start"][-4:] == "30.0" and row["end"][-4:] == "50.0"
