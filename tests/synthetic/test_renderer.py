"""Frames show what the truth says, where it says; the detector, and OpenCV's camera, are the oracles."""

import cv2
import numpy as np
import pytest
from pyapriltags import Detector

from pipeline.geometry import se3
from pipeline.synthetic import command, recording, scenery
from pipeline.synthetic.renderer import Renderer

DIGGING_S = (5.2, 6.4, 7.6)


@pytest.fixture(scope="module", params=["trench 1280", "other"])
def site(request):
    name, *size = request.param.split()
    w = recording.world(command.specification_of(name, size=size[0] if size else "640"), seed=3)
    return w, Renderer(w.spec, w.truth, w.motion, seed=3)


def projected(w, renderer, camera, t):
    """Corners of all tags of the truth by OpenCV, dict tag id -> (4, 2), and the frame."""
    p = w.motion.poses(np.array([t]))
    T_camera_world = se3.inverse(p.T_world_cab[0] @ w.truth.cameras[camera])
    k = w.truth.intrinsics[camera]
    K = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]])
    corners = {}
    for name, b in renderer.boards.items():
        on_site = name in w.truth.benchmarks
        T_world = w.truth.benchmarks[name] if on_site else p.stick(w.spec)[0] @ w.truth.stick_marker
        in_camera = se3.transform(T_camera_world @ T_world, b.corners())
        if in_camera[..., 2].min() < 1.0:
            continue
        uv = cv2.projectPoints(in_camera.reshape(-1, 3), np.zeros(3), np.zeros(3), K, k[4:])[0]
        corners.update(zip(b.ids.tolist(), uv.reshape(-1, 4, 2)))
    return corners


def side_px(corners):
    return np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min()


def test_found_corners_agree_with_projected_ones(site):
    """Ids, rotation on the print and position; 0.1 px RMS is asked of tags of 40 px and more, all of them count."""
    w, renderer = site
    detector = Detector(families=w.spec.family, quad_decimate=1.0, refine_edges=1)
    errors, seen = [], set()
    for camera in (c.name for c in w.spec.cameras):
        for t in DIGGING_S:
            truth = projected(w, renderer, camera, t)
            for found in detector.detect(renderer.frame(camera, round(5 * t), t)):
                if found.decision_margin < 20 or found.hamming > 0:
                    continue
                # The library's corners run counter-clockwise from the bottom left, pixel centres at 0.5.
                uv = np.roll(found.corners[[3, 2, 1, 0]], 2, axis=0) - 0.5
                assert found.tag_id in truth, "a tag was found that nobody put there"
                if side_px(truth[found.tag_id]) >= 40:
                    errors.append(uv - truth[found.tag_id])
                seen.add(found.tag_id)
    errors = np.array(errors)
    assert seen == {int(i) for b in renderer.boards.values() for i in b.ids}
    assert np.sqrt(np.mean(errors**2)) < 0.1
    # Half a pixel of another convention would show here at once.
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.03


def test_the_light_of_a_tag_lies_where_the_tag_is(site):
    """No detector: the centroid of a painted square, lens blur and noise left out, against its projected outline."""
    w, renderer = site
    camera, t = w.spec.cameras[0].name, 6.0
    p = w.motion.poses(np.array([t]))
    T = se3.inverse(p.T_world_cab[0] @ w.truth.cameras[camera])
    for name in renderer.boards:
        if name in w.truth.benchmarks:
            T_camera_marker = T @ w.truth.benchmarks[name]
        else:
            T_camera_marker = T @ p.stick(w.spec)[0] @ w.truth.stick_marker
        texture, per_m = renderer.textures[name]
        scene = np.zeros((w.spec.height, w.spec.width), np.float32)
        renderer.textures[name] = (np.ones_like(texture), per_m)
        try:
            renderer._paste(camera, scene, name, T_camera_marker, t)
        finally:
            renderer.textures[name] = (texture, per_m)
        if scene.max() == 0:
            continue
        v, u = np.mgrid[0 : w.spec.height, 0 : w.spec.width]
        centre = np.array([(scene * u).sum(), (scene * v).sum()]) / scene.sum()
        half = 0.5 * np.array(texture.shape[::-1]) / per_m
        edge = np.linspace(-1, 1, 60, endpoint=False)
        ring = np.concatenate(
            [np.stack([edge, 1 + 0 * edge], -1), np.stack([1 + 0 * edge, -edge], -1),
             np.stack([-edge, -1 + 0 * edge], -1), np.stack([-1 + 0 * edge, edge], -1)]
        )  # fmt: skip
        outline = np.concatenate([ring * half, np.zeros((len(ring), 1))], axis=1)
        k = w.truth.intrinsics[camera]
        K = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]])
        uv = cv2.projectPoints(se3.transform(T_camera_marker, outline), np.zeros(3), np.zeros(3), K, k[4:])[
            0
        ][:, 0]
        x, y = uv.T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        centroid = np.array([np.sum((q + np.roll(q, -1)) * cross) for q in (x, y)]) / (3 * cross.sum())
        np.testing.assert_allclose(centre, centroid, atol=0.01)


def test_every_tag_is_large_enough_while_digging(site):
    """FIELD: under 25 px a tag's corners are biased."""
    w, renderer = site
    sides = [
        side_px(corners)
        for camera in (c.name for c in w.spec.cameras)
        for corners in projected(w, renderer, camera, 6.0).values()
        if corners.min() > 0 and corners[:, 0].max() < w.spec.width and corners[:, 1].max() < w.spec.height
    ]
    assert len(sides) >= 16
    assert min(sides) > 27


def test_benchmarks_and_stick_board_are_in_view_throughout_the_digging():
    w = recording.world(command.specification_of("trench"), seed=3)
    renderer = Renderer.__new__(Renderer)  # only its boards are asked for
    from pipeline.synthetic.excavator import board

    plans = [b.board for b in w.spec.benchmarks] + [w.spec.stick_board]
    renderer.boards = {p.name: board(p, w.spec.family) for p in plans}
    t = np.arange(0, w.motion.duration_s, 0.25)
    for moment in t[w.motion.phase(t) == "dig"]:
        inside = set()
        for camera in ("bench", "arm"):
            for tag, uv in projected(w, renderer, camera, moment).items():
                if uv.min() > 2 and uv[:, 0].max() < 638 and uv[:, 1].max() < 478:
                    inside.add(tag)
        assert {int(i) for b in renderer.boards.values() for i in b.ids} <= inside


def test_a_print_keeps_its_edges_between_texels():
    """The area of ink in a texture is that of the tag's black cells, wherever they fall between the texels."""
    from pipeline.synthetic.excavator import board
    from pipeline.synthetic.specification import BoardPlan

    made = board(BoardPlan("b", 3, 1, 1, 0.31, 0.05, 0.0423), "tag36h11")
    texture, per_m = scenery.board_texture(made, np.random.default_rng(0))
    ink = (scenery.WHITE - texture).clip(0).sum() / (scenery.WHITE - scenery.BLACK) / per_m**2
    cells = (1 - scenery.tag_cells("tag36h11", 3)).sum() * (0.31 / 8) ** 2
    # Dust takes a few per cent of the light.
    assert ink == pytest.approx(cells, rel=0.1)


def test_noise_and_exposure_differ_from_frame_to_frame(site):
    w, renderer = site
    camera = w.spec.cameras[0].name
    a, b = renderer.frame(camera, 1, 1.0), renderer.frame(camera, 2, 1.0)
    difference = a.astype(float) - b
    assert 0.7 * np.sqrt(2) < difference.std() / w.spec.noise < 1.3 * np.sqrt(2)
    np.testing.assert_array_equal(a, renderer.frame(camera, 1, 1.0))
