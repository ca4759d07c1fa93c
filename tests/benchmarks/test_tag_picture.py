"""The renderer of the benchmarks against closed forms and the house's camera, and its Cramer-Rao bound."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks._bound import _derivatives, corner_bound, noise
from benchmarks._tag_picture import SQUARE, View, cells, shoot, sight
from pipeline.geometry import camera

WIDE = (900.0, 905.0, 640.0, 480.0, -0.15, 0.02, 0.001, -0.0007, 0.0)
PLAIN = View(tag_id=7, side_px=40, noise=0, quality=0, black=40, white=200)


def test_corners_are_where_the_camera_of_the_house_projects_them():
    """Lens, tilt and place in the frame: 1e-6 px, and the tilt is the angle to the line of sight."""
    for k in range(20):
        rng = np.random.default_rng(k)
        view = View(
            side_px=90,
            tilt_deg=rng.uniform(0, 60),
            axis_deg=rng.uniform(0, 360),
            roll_deg=rng.uniform(0, 360),
            centre=(rng.uniform(100, 1180), rng.uniform(100, 860)),
            lens=WIDE,
        )
        where, corner = sight(view, rng)
        R, centre = where.H[:, :2], where.H[:, 2]
        p_camera = (0.5 * SQUARE) @ R.T + centre
        uv = camera.project(p_camera, np.array(WIDE)) - corner
        assert np.abs(uv - where.project(0.5 * SQUARE)).max() < 1e-6
        assert np.abs(where.project(np.zeros((1, 2))) + corner - view.centre).max() < 1e-6
        normal = np.cross(R[:, 0], R[:, 1])
        cosine = abs(normal @ centre) / np.linalg.norm(centre)
        assert np.rad2deg(np.arccos(min(cosine, 1))) == pytest.approx(view.tilt_deg, abs=1e-5)


def test_moving_the_corners_nowhere_is_the_same_sight():
    where, _ = sight(View(side_px=70, tilt_deg=50, axis_deg=20, centre=(200.3, 700.6), lens=WIDE))
    grid = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    again = where.moved(where.project(0.5 * SQUARE))
    assert np.abs(again.project(grid) - where.project(grid)).max() < 1e-9


@pytest.mark.parametrize("roll_deg", [0, 3, 30])
@pytest.mark.parametrize("blurs", [{"blur_px": 0.5}, {"disc_px": 1.3}, {"motion_px": 3.0, "motion_deg": 40}])
def test_black_has_the_area_and_the_centroid_of_its_cells(roll_deg, blurs):
    """Blur moves neither; the sum over pixels of what is missing to white is exact whatever the phase: 1e-3 px."""
    view = replace(PLAIN, **{"blur_px": 0, "roll_deg": roll_deg, "centre": (0.37, 0.21)} | blurs)
    flat = np.full(
        (200, 200), view.white
    )  # a background as white as the print: all that is seen is its black
    rng = np.random.default_rng(1)
    shot = shoot(
        replace(view, centre=(100.37, 100.21), lens=(1e4, 1e4, 100, 100, 0, 0, 0, 0, 0)), rng, 4, flat
    )
    dark = (view.white - shot.clean) / (view.white - view.black)
    print_, border = cells(view.family, view.tag_id)
    black = 1 - print_
    at = (np.arange(len(print_)) + 0.5 - len(print_) / 2) / border
    middle = np.array([(black * at[None]).sum(), -(black * at[:, None]).sum()]) / black.sum()
    expected = shot.uv.mean(axis=0) + middle @ np.array([shot.uv[1] - shot.uv[0], shot.uv[0] - shot.uv[3]])
    v, u = np.mgrid[: dark.shape[0], : dark.shape[1]]
    found = np.array([(u * dark).sum(), (v * dark).sum()]) / dark.sum()
    assert dark.sum() == pytest.approx(black.sum() * (40 / border) ** 2, rel=2e-3)
    assert np.abs(found - expected).max() < 1e-3


@pytest.mark.parametrize(
    "view", [replace(PLAIN, side_px=20, tilt_deg=60), replace(PLAIN, tilt_deg=45), PLAIN]
)
def test_the_grid_is_fine_enough_for_a_thousandth_of_a_pixel(view):
    """What a fit would take the remaining error of the grid for, against a much finer grid."""
    flat = np.full((100, 100), view.white)
    view = replace(view, blur_px=0.5, centre=(50.2, 50.4), lens=(1731, 1731, 50.2, 50.4, 0, 0, 0, 0, 0))
    shots = [shoot(view, np.random.default_rng(1), fine, flat) for fine in (0, 20)]
    difference = (shots[0].clean - shots[1].clean)[shots[0].inside]
    moved = np.linalg.lstsq(_derivatives(view, shots[0]), difference, rcond=None)[0][:8]
    assert np.abs(moved).max() < 1e-3


@pytest.mark.parametrize("kind", [1, 2, 3, 4, 5, 6, 7, 8])
def test_the_share_that_is_covered_is_the_share_that_was_asked_for(kind):
    """Without blur what differs from the uncovered tag lies within the share; never more, and nearly all of it."""
    view = replace(PLAIN, side_px=100, blur_px=0, covered=0.3, black=0, white=255)
    pictures = [
        shoot(each, np.random.default_rng(kind), 4, np.full((9, 9), 255.0)).clean
        for each in (view, replace(view, covered=0))
    ]
    changed = np.abs(pictures[0] - pictures[1]) > 2
    v, u = np.mgrid[: changed.shape[0], : changed.shape[1]]
    uv = shoot(view, np.random.default_rng(kind), 1).uv
    on_tag = (u > uv[0, 0]) & (u < uv[1, 0]) & (v > uv[0, 1]) & (v < uv[3, 1])
    assert changed[on_tag].mean() < 0.33
    assert changed[on_tag].mean() > 0.08  # cells of the same grey as what lies over them do not show


def test_exposure_clips_and_photon_noise_grows_with_the_light():
    view = replace(PLAIN, side_px=120, noise=3, photon=1.0)
    bright, dim = (shoot(replace(view, exposure=e), np.random.default_rng(2)) for e in (4.0, 0.25))
    white = shoot(view, np.random.default_rng(2)).clean > view.white - 1
    assert np.all(bright.grey[white & bright.inside] == 255)
    rest = white & dim.inside
    assert (dim.grey - dim.clean)[rest].std() == pytest.approx(3 * np.sqrt(50 / 128), rel=0.06)


def test_the_bound_is_the_scatter_of_a_linear_fit_to_drawn_noise():
    """Least squares on the derivatives at the truth, 4000 draws: within 6 %, whitened RMS within 3 % of one."""
    view = replace(PLAIN, side_px=30, tilt_deg=30, noise=2, slope=0.1)
    rng = np.random.default_rng(3)
    shot = shoot(view, rng)
    J = _derivatives(view, shot)
    drawn = rng.normal(0, 2.0, (len(J), 4000))
    corners = np.linalg.lstsq(J, drawn, rcond=None)[0][:8]
    bound = corner_bound(view, shot, sigma=2.0)
    assert np.allclose(np.diag(np.cov(corners)), np.diag(bound), rtol=0.1)
    white = np.linalg.solve(np.linalg.cholesky(bound), corners)
    assert np.sqrt(np.mean(white**2)) == pytest.approx(1, abs=0.03)
    assert noise(shot) == pytest.approx(2.0, rel=0.1)


def test_the_bound_of_a_straight_edge_is_the_textbook_one():
    """Information of one edge: contrast² / (2 sqrt(pi) s sigma²) per px of it, s the blur with the pixel's own.

    A shift of the whole facing tag is told by the edges that cross it, so its sigma has a closed form, but for half a
    pixel that blur takes off each end of an edge: 2 % of a tag of 240 px.
    """
    view = replace(PLAIN, side_px=240, noise=2, blur_px=0.9)
    shot = shoot(view, np.random.default_rng(4))
    J = _derivatives(view, shot)
    shift = J[:, 0:8:2].sum(axis=1)
    print_, border = cells(view.family, view.tag_id)
    edges_px = np.abs(np.diff(print_, axis=1)).sum() * view.side_px / border
    blur = np.hypot(view.blur_px, np.sqrt(1 / 12))
    information = edges_px * (view.white - view.black) ** 2 / (2 * np.sqrt(np.pi) * blur)
    assert shift @ shift == pytest.approx(information, rel=0.05)
