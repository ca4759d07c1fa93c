"""Corners through a lens that bends: held against OpenCV's lens with numpy's lines, and against rendered frames."""

from dataclasses import replace

import cv2
import numpy as np

from pipeline.detection.apriltag import TagFinder
from pipeline.geometry import se3
from pipeline.network.bow import crossings, without_bow
from pipeline.synthetic import command, recording
from pipeline.synthetic.renderer import Renderer

BENT = np.array([850.0, 848.0, 320.0, 240.0, -0.18, 0.05, 0.0003, -0.0002, 0.0])
CORNERS = np.array([[[60.0, 40.0], [150.0, 50.0], [140.0, 145.0], [55.0, 130.0]]])


def test_crossings_are_those_of_lines_through_points_that_opencv_bends():
    K = np.array([[BENT[0], 0, BENT[2]], [0, BENT[1], BENT[3]], [0, 0, 1]])
    criteria = (3, 200, 1e-14)
    xy = cv2.undistortPoints(CORNERS.reshape(-1, 1, 2), K, BENT[4:], criteria=criteria).reshape(4, 2)
    lines = []
    for k in range(4):
        side = xy[k] + np.linspace(0, 1, 402)[1:-1, None] * (xy[(k + 1) % 4] - xy[k])
        p = cv2.projectPoints(np.c_[side, np.ones(400)], np.zeros(3), np.zeros(3), K, BENT[4:])[0].reshape(
            -1, 2
        )
        mean = p.mean(axis=0)
        normal = np.linalg.svd(p - mean)[2][1]
        lines.append((normal, normal @ mean))
    expected = [
        np.linalg.solve([lines[k - 1][0], lines[k][0]], [lines[k - 1][1], lines[k][1]]) for k in range(4)
    ]
    # Sixteen places instead of four hundred leave out a little more of the ends.
    assert np.allclose(crossings(CORNERS, BENT)[0], expected, atol=0.01)
    assert np.abs(crossings(CORNERS, BENT) - CORNERS).max() > 0.05


def test_a_lens_without_distortion_bends_nothing():
    straight = np.where(np.arange(9) < 4, BENT, 0.0)
    assert np.allclose(without_bow(CORNERS, straight), CORNERS, atol=1e-9)
    assert without_bow(np.empty((0, 4, 2)), BENT).shape == (0, 4, 2)


def test_rendered_tags_are_found_without_a_bias_that_their_bow_explains():
    plain = command.specification_of("trench", size="640")
    cameras = tuple(replace(c, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0)) for c in plain.cameras)
    w = recording.world(replace(plain, cameras=cameras), seed=3)
    renderer = Renderer(w.spec, w.truth, w.motion, seed=3)
    finder = TagFinder(["tag36h11"])
    camera = cameras[0].name
    k = w.truth.intrinsics[camera]
    K = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]])
    before, after, bow = [], [], []
    for t in np.arange(5.2, 8.0, 0.2):
        T_camera_world = se3.inverse(w.motion.poses(np.array([t])).T_world_cab[0] @ w.truth.cameras[camera])
        found = finder.find(renderer.frame(camera, round(5 * t), t))
        corrected = without_bow(found.uv, k)
        for name, b in renderer.boards.items():
            if name not in w.truth.benchmarks:
                continue
            p = se3.transform(T_camera_world @ w.truth.benchmarks[name], b.corners()).reshape(-1, 3)
            truth = cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, k[4:])[0].reshape(-1, 4, 2)
            for tag, uv in zip(b.ids, truth, strict=True):
                for i in np.flatnonzero(found.tag_id == tag):
                    before.append(found.uv[i] - uv)
                    after.append(corrected[i] - uv)
                    bow.append(found.uv[i] - corrected[i])
    before, after, bow = (np.array(v) for v in (before, after, bow))
    explained = [np.sum(error * bow) / np.sum(bow**2) for error in (before, after)]
    print(f"share of the bow in the errors: {explained[0]:.2f} before, {explained[1]:.2f} after")
    assert len(before) > 100
    assert 0.6 < explained[0] < 1.4 and abs(explained[1]) < 0.4
