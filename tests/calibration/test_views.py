"""Views: corner files, and which views are worth keeping."""

from itertools import combinations

import numpy as np

from pipeline.calibration.board import parse_board
from pipeline.calibration.views import most_telling, views_of_corner_file

BOARD = parse_board("chessboard:3x3:0.1")


def test_a_corner_file_is_read_with_its_levels_and_its_gaps():
    full = "\n".join(f"/far/a.png {10 * i}.5 {20 + i} {1 if i == 4 else 0}" for i in range(9))
    holes = "\n".join(f"b.png {i} {i} {'-' if i == 2 else 0}" if i != 5 else "b.png - - -" for i in range(9))
    views, odd = views_of_corner_file(
        f"# filename x y level\n{full}\n{holes}\nc.png - -\nd.png 1 2 0\n", BOARD
    )
    assert [view.name for view in views] == ["a.png", "b.png"]
    assert odd == ["d.png"]
    assert np.allclose(views[0].uv[3, 0], [30.5, 23])
    # One level is a picture of half the size: twice the sigma.
    assert np.allclose(views[0].cov[4], 4 * views[0].cov[3])
    assert views[1].point[:, 0].tolist() == [0, 1, 3, 4, 6, 7, 8]


def test_greedy_choice_of_views_is_close_to_the_best_of_all():
    rng = np.random.default_rng(2)
    for _ in range(20):
        J = rng.normal(size=(9, 3, 4)) * rng.uniform(0.1, 2, (9, 1, 1))
        information = list(np.swapaxes(J, 1, 2) @ J)
        chosen = most_telling(information, 4)
        assert len(set(chosen)) == 4 and chosen == sorted(chosen)
        value = {c: np.linalg.slogdet(sum(information[i] for i in c))[1] for c in combinations(range(9), 4)}
        ours, best = value[tuple(chosen)], max(value.values())
        assert ours > best - 1.0
        assert ours > np.quantile(list(value.values()), 0.9)


def test_the_scale_of_parameters_changes_nothing():
    rng = np.random.default_rng(4)
    J = rng.normal(size=(12, 5, 3))
    scale = np.array([1e3, 1.0, 1e-4])
    plain = most_telling(list(np.swapaxes(J, 1, 2) @ J), 5)
    scaled = most_telling(list(np.swapaxes(J * scale, 1, 2) @ (J * scale)), 5)
    assert plain == scaled


def test_few_views_are_all_kept():
    assert most_telling([np.eye(2)] * 3, 5) == [0, 1, 2]
