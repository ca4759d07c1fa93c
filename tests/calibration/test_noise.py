"""Corner noise as it was put into standing tags, by light and size; and what it makes of a tag's place."""

import json

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from pipeline.calibration.noise import LIGHT_CLASSES, corner_noise, one_frame_mm
from pipeline.detection.stillness import SIZE_CLASSES
from pipeline.report.noise_sheet import noise_sheet
from pipeline.report.sheet import render_sheet

PREDICTED_PX = 0.05
SQUARE = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
CODES = {"uu": 1.0, "uv": 0.0, "vv": 1.0}


def tag(rng, number, noise_px, side_px, contrast, frames=960, drift_px=0.0):
    """Rows of one tag that stands, or drifts by so many pixels a frame."""
    uv = 200 + side_px * SQUARE + rng.normal(size=(frames, 4, 2)) * noise_px
    uv = uv + drift_px * np.arange(frames)[:, None, None]
    rows = {
        "frame": np.arange(frames, dtype=np.int32),
        "family": np.full(frames, "tag36h11", object),
        "tag_id": np.full(frames, number, np.int32),
        "status": np.full(frames, "accepted", object),
        "side_px": np.full(frames, side_px),
        "contrast": np.full(frames, contrast),
    }
    for k in range(4):
        rows[f"u{k}"], rows[f"v{k}"] = uv[:, k, 0], uv[:, k, 1]
        for code, share in CODES.items():
            rows[f"cov{k}_{code}"] = np.full(frames, share * PREDICTED_PX**2)
    return rows


def log(*tags):
    whole = {name: np.concatenate([t[name] for t in tags]) for name in tags[0]}
    order = np.argsort(whole["frame"], kind="stable")
    return {name: column[order] for name, column in whole.items()}


@pytest.fixture
def noise():
    rng = np.random.default_rng(6)
    return corner_noise(
        log(
            tag(rng, 1, 0.05, 40.0, 100.0),
            tag(rng, 2, 0.10, 40.0, 30.0),
            tag(rng, 3, 0.03, 80.0, 100.0),
            tag(rng, 4, 0.05, 40.0, 100.0, drift_px=0.2),
        )
    )


def test_each_class_of_light_and_size_has_the_noise_that_was_put_in(noise):
    dim, bright = LIGHT_CLASSES[0], LIGHT_CLASSES[2]
    put_in = {(bright, SIZE_CLASSES[1]): 0.05, (dim, SIZE_CLASSES[1]): 0.10, (bright, SIZE_CLASSES[2]): 0.03}
    assert set(noise.by_class) == set(put_in)
    for key, sigma in put_in.items():
        found = noise.by_class[key]
        print(f"{key[0]}, {key[1]}: {found.scatter_px:.4f} px of {sigma}")
        assert found.scatter_px == pytest.approx(sigma, rel=0.04)
        assert found.ratio == pytest.approx(sigma / PREDICTED_PX, rel=0.04)
    # The one that drifts is no standing tag.
    assert noise.by_class[bright, SIZE_CLASSES[1]].tags == 1


def test_noise_beyond_what_a_report_rests_on_is_told(noise):
    assert noise.surely_above
    rng = np.random.default_rng(7)
    assert not corner_noise(log(tag(rng, 1, 0.05, 40.0, 100.0))).surely_above


def test_a_camera_before_which_nothing_stood_has_no_figure():
    nothing = corner_noise(log(tag(np.random.default_rng(8), 1, 0.05, 40.0, 100.0, drift_px=0.5)))
    assert nothing.whole is None and np.isnan(nothing.ratio)


def test_millimetres_of_one_frame_are_the_scatter_of_solved_poses():
    """A facing tag solved from noisy corners, 600 times, by OpenCV's projection; noise small enough to be linear."""
    rng = np.random.default_rng(9)
    focal, distance, size, sigma = 850.0, 8.0, 0.4, 0.003
    K = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1.0]])
    side_px = focal * size / distance
    p = np.column_stack([size * SQUARE * [1, -1], np.zeros(4)])
    exact = [320, 240] + side_px * SQUARE * [1, -1]
    solved = []
    for _ in range(600):
        uv = exact + rng.normal(size=(4, 2)) * sigma

        def off(x, uv=uv):
            return (cv2.projectPoints(p, x[:3], x[3:], K, None)[0][:, 0] - uv).ravel()

        start = [1e-3, 1e-3, 0, 0, 0, distance]
        solved.append(least_squares(off, start, xtol=1e-14, ftol=1e-14, gtol=1e-14).x[3:])
    scatter = 1000 * np.std(solved, axis=0)
    across, along = one_frame_mm(sigma, side_px, focal, distance)
    print(f"across {scatter[0]:.3f} of {across:.3f} mm, along {scatter[2]:.2f} of {along:.2f} mm")
    assert scatter[:2] == pytest.approx([across, across], rel=0.1)  # three sigma of a scatter of 600
    assert scatter[2] == pytest.approx(along, rel=0.1)


def test_the_sheet_says_the_figures_of_the_class_with_most_corners(noise):
    page, said = render_sheet(
        noise_sheet({"arm": noise}, {"arm": 850.0}, 10.0, "shift", {"file": "shift.mcap"})
    )
    assert said["state"] == "poor" and "arm" in said["remarks"][0]
    (rows,) = (t["table"]["rows"] for part in said["parts"] for t in part["tables"])
    assert sorted(round(row["noise"], 2) for row in rows) == [0.03, 0.05, 0.10]
    assert json.loads(json.dumps(said)) and page.count("<svg") == 1
