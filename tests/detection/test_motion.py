"""How far the picture moved, from thumbnails."""

import cv2
import numpy as np

from benchmarks._moving_tags import texture
from pipeline.detection.motion import Thumbnails


def pictures(way, rng, noise=2.0):
    ground = texture(rng, 2400, 1400)
    for u, v in way:
        shown = cv2.warpAffine(ground, np.array([[1, 0, u - 600.0], [0, 1, v - 200.0]]), (1280, 960))
        yield np.clip(shown + rng.normal(0, noise, shown.shape), 0, 255).astype(np.uint8)


def test_drift_follows_a_swing_and_comes_back_to_where_it_began():
    """Content that moves right has a positive u. Errors must not add up: 20 frames of shaking stay where they are.

    Two thumbnail pixels are enough: glances fall due at twelve, and tags are looked for at other places too.
    """
    rng = np.random.default_rng(4)
    swing = [(90.0 * k, 6.0 * k) for k in range(5)]
    shaking = [(swing[-1][0] + 3 * np.sin(k), swing[-1][1] + 3 * np.cos(k)) for k in range(20)]
    way = np.array(swing + shaking)
    drift = Thumbnails(1280, 960).drift(list(pictures(way, rng)))
    worst = np.abs(drift.uv - (way - way[0])).max()
    print(f"worst {worst:.1f} px")
    assert drift.certain.all()
    assert worst < 32.0


def test_another_scene_is_no_motion():
    rng = np.random.default_rng(5)
    greys = [next(pictures([(0, 0)], rng)) for _ in range(3)]
    drift = Thumbnails(1280, 960).drift(greys)
    assert drift.certain.tolist() == [True, False, False]
    assert np.all(drift.uv == 0)


def test_a_scene_that_stands_does_not_drift_at_all():
    rng = np.random.default_rng(6)
    ground = texture(rng, 640, 480)
    greys = [np.clip(ground + rng.normal(0, 3, ground.shape), 0, 255).astype(np.uint8) for _ in range(5)]
    assert np.all(Thumbnails(640, 480).drift(greys).uv == 0)


def test_what_moves_before_a_scene_that_stands_is_no_motion_of_the_whole():
    """Two prints of 120 px on their way; their phases tell of 8 px."""
    rng = np.random.default_rng(7)
    ground = texture(rng, 1280, 960)
    cells = np.kron(rng.integers(0, 2, (10, 10)), np.ones((12, 12))) * 200 + 20
    greys = []
    for k in range(4):
        shown = ground.copy()
        for left, top in ((200 + 12 * k, 300), (700 + 12 * k, 500)):
            shown[top : top + 120, left : left + 120] = cells
        greys.append(np.clip(shown + rng.normal(0, 2, shown.shape), 0, 255).astype(np.uint8))
    assert np.all(Thumbnails(1280, 960).drift(greys).uv == 0)
