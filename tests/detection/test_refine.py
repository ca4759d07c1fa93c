"""Refined corners against rendered tags whose corners are known; the renderer shares nothing with the refinement."""

import time
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pyapriltags
import pytest

from benchmarks import _light, occlusion
from benchmarks._tag_picture import View, cells, shoot
from pipeline.detection.refine import REASONS, Refiner

FAMILY = "tag36h11"
IDS = 587


def random_view(rng, **known) -> View:
    """A tag turned at random; blur 0.5 to 1.3 px, noise 1 to 5, JPEG 75 to 95, uneven light, unless told."""
    drawn = {
        "tag_id": int(rng.integers(IDS)),
        "side_px": float(np.exp(rng.uniform(np.log(20), np.log(80)))),
        "tilt_deg": float(rng.uniform(0, 60)),
        "axis_deg": float(rng.uniform(0, 360)),
        "roll_deg": float(rng.uniform(0, 360)),
        "centre": tuple(rng.uniform(-0.5, 0.5, 2).tolist()),
        "blur_px": float(rng.uniform(0.5, 1.3)),
        "noise": float(rng.uniform(1, 5)),
        "quality": int(rng.integers(75, 96)),
        "slope": float(rng.uniform(0, 0.2)),
        "slope_deg": float(rng.uniform(0, 360)),
    }
    return View(**{**drawn, **known})


def off_by(rng, uv, px):
    """Corners, each moved by a length in a direction of its own."""
    angle = rng.uniform(0, 2 * np.pi, 4)
    return uv + px * np.column_stack([np.cos(angle), np.sin(angle)])


def side_of(uv) -> float:
    """Mean length of a quad's sides, px."""
    return float(np.linalg.norm(uv - np.roll(uv, 1, axis=0), axis=1).mean())


class Fits:
    """What became of some views: errors of the tags that stand, and the covariances they were given."""

    def __init__(self):
        self.errors, self.covs, self.outward, self.reasons, self.motion_px = [], [], [], [], []

    def add(self, view, shot, start, intrinsics=None):
        fit = Refiner(intrinsics).refine(shot.grey, [view.family], [view.tag_id], start[None])
        self.reasons.append(fit.reason[0])
        if not fit.reason[0]:
            error = fit.uv[0] - shot.uv
            away = shot.uv - shot.uv.mean(axis=0)
            self.errors.append(error)
            self.covs.append(fit.cov[0])
            self.outward.append(np.mean(np.sum(error * away, axis=1) / np.linalg.norm(away, axis=1)))
            self.motion_px.append(fit.motion_px[0])
        return fit

    @property
    def standing(self) -> int:
        return len(self.errors)

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.errors))))

    @property
    def bias_px(self) -> float:
        """Largest of the mean errors along u, along v and away from the centre."""
        return float(np.abs([*np.mean(self.errors, axis=(0, 1)), np.mean(self.outward)]).max())

    @property
    def square_8(self) -> float:
        """Mean normalised square of the errors by the 8 x 8, per degree of freedom."""
        return float(
            np.mean([e.ravel() @ np.linalg.solve(C, e.ravel()) / 8 for e, C in zip(self.errors, self.covs)])
        )

    @property
    def squares_2(self) -> np.ndarray:
        """(n, 4) normalised squares of the corners by their 2 x 2, per degree of freedom."""
        return np.array(
            [
                [e[k] @ np.linalg.solve(C[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], e[k]) / 2 for k in range(4)]
                for e, C in zip(self.errors, self.covs)
            ]
        )


BARS_PX = {20: 0.045, 30: 0.03, 40: 0.02, 80: 0.014, 160: 0.009}
"""Blur 0.8 px, noise 2 of 150 grey values: twice what a bound of 0.3 / side px (facing, twice that at 60 degrees) and
the 0.003 px of eight-bit JPEG come to."""


@pytest.mark.parametrize("side_px", BARS_PX)
def test_corners_of_tags_facing_and_tilted_are_at_the_noise_floor(side_px):
    rng = np.random.default_rng(side_px)
    every = []
    for tilt_deg in (0, 45, 60):
        fits = Fits()
        for _ in range(5 if side_px == 160 else 10):
            view = random_view(
                rng, side_px=side_px, tilt_deg=tilt_deg, blur_px=0.8, noise=2.0, quality=85, slope=0.1
            )
            shot = shoot(view, rng)
            fits.add(view, shot, off_by(rng, shot.uv, 0.02 * side_px))
        print(
            f"{side_px} px, {tilt_deg} degrees: {fits.standing} stand, "
            f"rms {fits.rms_px:.4f} px, bias {fits.bias_px:.4f} px"
        )
        assert set(fits.reasons) == {""}
        assert fits.rms_px < BARS_PX[side_px]
        every += fits.errors
    assert np.abs(np.mean(every, axis=(0, 1))).max() < 0.2 * BARS_PX[side_px]


def test_the_covariance_predicts_the_errors_of_150_tags():
    """Noise is taken for as correlated as its neighbours show; the band is that of the bars, 0.9 to 1.15 in RMS.

    150 tags of 8 coordinates alone scatter by 4 % in the square; views this easy are 10 % better than they say.
    """
    rng = np.random.default_rng(11)
    fits = Fits()
    for _ in range(150):
        view = random_view(rng)
        shot = shoot(view, rng)
        fits.add(view, shot, off_by(rng, shot.uv, 0.02 * view.side_px))
    print(
        f"{fits.standing} of 150 stand; normalised squares: 8 x 8 {fits.square_8:.3f}, "
        f"2 x 2 {fits.squares_2.mean():.3f}; largest corner {np.sqrt(2 * fits.squares_2.max()):.1f} sigma; "
        f"bias {fits.bias_px:.4f} px"
    )
    assert fits.standing > 140
    assert 0.65 < fits.square_8 < 1.35
    assert 0.65 < fits.squares_2.mean() < 1.35
    assert np.sqrt(2 * fits.squares_2.max()) < 5
    assert fits.bias_px < 0.005


def test_starts_within_7_percent_of_the_side_converge_or_are_refused():
    """Half a cell: the contract. One that converged to another place would be off by a cell, a tenth of the side."""
    rng = np.random.default_rng(12)
    fits = Fits()
    for _ in range(120):
        view = random_view(rng)
        shot = shoot(view, rng)
        fits.add(view, shot, off_by(rng, shot.uv, 0.07 * side_of(shot.uv)))
    worst = np.linalg.norm(fits.errors, axis=2).max()
    print(f"{fits.standing} of 120 stand, the worst corner {worst:.3f} px off")
    assert worst < 0.3
    assert fits.standing > 100


@cache
def prints() -> np.ndarray:
    """(587, 100) cells of all tags of the family, as OpenCV draws them."""
    return np.array([cells(FAMILY, tag_id)[0].ravel() for tag_id in range(IDS)])


def nearest_ids(family, tag_id, number) -> np.ndarray:
    """Ids of tag36h11 whose prints differ least from a print of the same size, but for itself."""
    apart = np.abs(prints() - cells(family, tag_id)[0].ravel()).sum(axis=1)
    apart[apart == 0] = 100
    return np.argsort(apart, kind="stable")[:number]


def test_a_wrong_id_never_stands():
    """The three ids that differ least, by 10 to 12 of 36 cells, on tags that are seen well and badly."""
    rng = np.random.default_rng(13)
    reasons = []
    for _ in range(100):
        view = random_view(rng)
        shot = shoot(view, rng)
        wrong = nearest_ids(FAMILY, view.tag_id, 3)
        fit = Refiner().refine(shot.grey, [FAMILY] * 3, wrong, np.repeat(shot.uv[None], 3, axis=0))
        reasons += fit.reason.tolist()
    print({reason: reasons.count(reason) for reason in set(reasons)})
    assert len(reasons) == 300
    assert "" not in reasons


def test_a_print_of_another_family_never_stands():
    """ArUco's 6 x 6: the same border and as many cells, so that only the code tells.

    Beyond these views one of 1,500 stood: 24 px at 55 degrees with 1.2 px of blur, where a cell is 1.7 px high.
    """
    rng = np.random.default_rng(131)
    reasons = []
    for _ in range(40):
        view = random_view(
            rng, family="DICT_6X6_250", tag_id=int(rng.integers(250)), tilt_deg=float(rng.uniform(0, 45))
        )
        shot = shoot(view, rng)
        near = nearest_ids(view.family, view.tag_id, 5)
        fit = Refiner().refine(shot.grey, [FAMILY] * 5, near, np.repeat(shot.uv[None], 5, axis=0))
        reasons += fit.reason.tolist()
    print({reason: reasons.count(reason) for reason in set(reasons)})
    assert "" not in reasons


def test_texture_never_stands():
    """Ground and machine, without a tag; quads anywhere, twelve ids."""
    rng = np.random.default_rng(14)
    reasons = []
    for _ in range(12):
        light = _light.texture((300, 400), 1, rng)
        grey = np.clip(light + rng.normal(0, 2, light.shape), 0, 255).astype(np.uint8)
        quads = []
        for _ in range(25):
            side, angle = rng.uniform(20, 80), rng.uniform(0, 2 * np.pi)
            at = angle + np.pi / 2 * np.arange(4)
            square = rng.uniform(60, [340, 240]) + side / np.sqrt(2) * np.column_stack(
                [np.cos(at), np.sin(at)]
            )
            quads.append(off_by(rng, square, 0.1 * side))
        fit = Refiner().refine(grey, [FAMILY] * 25, rng.integers(IDS, size=25), np.array(quads))
        reasons += fit.reason.tolist()
    print({reason: reasons.count(reason) for reason in set(reasons)})
    assert len(reasons) == 300
    assert "" not in reasons


def with_bar(rng, shot, share):
    """A bar of one grey that lies over part of the tag, ragged by its own blur of half a pixel."""
    grey = shot.grey.astype(float)
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(float)
    angle, side = rng.uniform(0, 2 * np.pi), side_of(shot.uv)
    middle = shot.uv.mean(axis=0) + rng.uniform(-0.4, 0.4, 2) * side
    away = np.abs((x - middle[0]) * np.cos(angle) + (y - middle[1]) * np.sin(angle))
    cover = np.clip(0.5 * share * side - away + 0.5, 0, 1)
    value = rng.choice([40, 110, 190, rng.uniform(10, 240)])
    return replace(shot, grey=np.rint(grey + cover * (value - grey)).astype(np.uint8))


def test_tags_under_a_bar_stand_only_where_their_corners_are_within_5_sigma():
    """A rope, a rod, a cable of 8 to 20 % of the side, also of the print's own black and white."""
    rng = np.random.default_rng(15)
    fits, whole = Fits(), []
    for _ in range(120):
        view = random_view(rng, side_px=float(rng.uniform(30, 90)))
        shot = with_bar(rng, shoot(view, rng), rng.uniform(0.08, 0.2))
        whole.append(fits.add(view, shot, off_by(rng, shot.uv, 0.02 * view.side_px)).whole[0])
    sigmas = np.sqrt(2 * fits.squares_2).max(axis=1)
    counts = {reason or "stands": fits.reasons.count(reason) for reason in sorted(set(fits.reasons))}
    print(f"{counts}; largest {np.sort(sigmas)[-4:].round(1)} sigma; whole {np.median(whole):.2f}")
    assert fits.standing > 40
    assert sigmas.max() < 5
    # Of those that stand, what is covered was left out.
    assert np.median([share for share, reason in zip(whole, fits.reasons) if not reason]) < 0.95


def test_a_print_that_a_cover_took_along_is_refused():
    """A draw of `make bench-occlusion` that was believed 7 sigmas off where straying was no reason."""
    occlusion._begin()
    drawn = occlusion.draw(17, 3528)
    assert drawn.outcomes["predicted"].reason == "covered"


def test_the_bent_light_of_a_low_sun_moves_no_corner():
    """Hot spots of 40 to 160 grey values beside the tag; with slopes of the light alone it is 0.08 px, 2.3 sigmas."""
    rng = np.random.default_rng(23)
    fits = Fits()
    for _ in range(30):
        view = random_view(rng, side_px=float(rng.uniform(40, 90)), blur_px=0.8, noise=2.0, slope=0.0)
        view = replace(view, black=35.0, white=185.0, glare=float(rng.uniform(40, 160)))
        shot = shoot(view, rng, fine=4)
        fits.add(view, shot, off_by(rng, shot.uv, 0.01 * view.side_px))
    rms = np.sqrt(fits.squares_2.mean())
    print(f"{fits.standing} of 30 stand, {fits.rms_px:.3f} px, {rms:.2f} sigmas")
    assert fits.standing > 25
    assert rms < 1.4 and fits.rms_px < 0.06


BARS_EXPOSED = {1.5: (0.02, 6.0), 2.5: (0.02, 3.0), 4.0: (0.06, 1.0)}
"""Outward px, and normalised square. JPEG rings beside what is cut, and what rings below 255 counts as seen: at 1.5
to 2 the errors are twice what they are said to be. Taken for the end of the range down to 235, ringing did no harm
at 1.5, but at 4 a tag stood that was off by 24 sigma."""


@pytest.mark.parametrize("exposure", BARS_EXPOSED)
def test_over_exposed_whites_leave_corners_where_they_are_or_are_refused(exposure):
    """White of 285, 475 and 760 grey values, cut at 255: fitted edges see prints with less black than there is."""
    rng = np.random.default_rng(16)
    fits, edges = Fits(), []
    detector = pyapriltags.Detector(families=FAMILY, quad_decimate=1.0)
    for _ in range(40):
        view = random_view(
            rng, side_px=float(rng.uniform(30, 80)), exposure=exposure, tilt_deg=float(rng.uniform(0, 45))
        )
        shot = shoot(view, rng)
        fits.add(view, shot, shot.uv + rng.normal(0, 0.2, (4, 2)))
        edges += outward_of(detector, shot)
    counts = {reason or "stands": fits.reasons.count(reason) for reason in sorted(set(fits.reasons))}
    print(
        f"exposure {exposure}: {counts}, outward {np.mean(fits.outward):+.4f} px, squares {fits.square_8:.2f}; "
        f"of fitted edges {np.mean(edges) if edges else np.nan:+.3f} px"
    )
    outward_px, square = BARS_EXPOSED[exposure]
    assert fits.standing > 15
    assert abs(np.mean(fits.outward)) < outward_px
    assert fits.square_8 < square


def outward_of(detector, shot) -> list[float]:
    """How far pyapriltags' own corners lie outside the true ones, px; none if it does not find the tag."""
    away = shot.uv - shot.uv.mean(axis=0)
    away /= np.linalg.norm(away, axis=1)[:, None]
    outward = []
    for found in detector.detect(shot.grey):
        corners = found.corners - 0.5
        nearest = np.linalg.norm(corners[None] - shot.uv[:, None], axis=2).argmin(axis=1)
        outward.append(float(np.mean(np.sum((corners[nearest] - shot.uv) * away, axis=1))))
    return outward


@pytest.mark.parametrize(
    ("black", "blur_px", "bar_px"), [(60.0, 0.8, 0.03), (40.0, 0.8, 0.03), (20.0, 1.2, 0.08)]
)
def test_the_cameras_response_moves_fitted_edges_but_not_the_print(black, blur_px, bar_px):
    """Gamma 2.2. Blur happens in light, grey values are its root: the middle grey of an edge lies on the black side.

    A parabola is not quite a power: the deeper the black and the wider the blur, the more is left.
    """
    rng = np.random.default_rng(17)
    fits, edges, response = Fits(), [], []
    detector = pyapriltags.Detector(families=FAMILY, quad_decimate=1.0)
    for _ in range(40):
        view = random_view(
            rng, side_px=float(rng.uniform(30, 60)), tilt_deg=float(rng.uniform(0, 30)), gamma=2.2,
            blur_px=blur_px, noise=2.0, slope=0.0, black=black, white=200.0,
        )  # fmt: skip
        shot = shoot(view, rng)
        fit = fits.add(view, shot, shot.uv + rng.normal(0, 0.2, (4, 2)))
        response.append(fit.response[0])
        edges += outward_of(detector, shot)
    light = (np.array([black, 200.0]) / 255) ** 2.2
    middle = (255 * light.mean() ** (1 / 2.2) - black) / (200 - black)
    print(
        f"black {black:.0f}, blur {blur_px} px: {fits.standing} of 40 stand, outward {np.mean(fits.outward):+.4f} px, "
        f"rms {fits.rms_px:.4f} px, squares {fits.square_8:.1f}; edges fitted by pyapriltags {np.mean(edges):+.3f} px "
        f"({len(edges)} found); response {np.median(response):.2f}, by its middle grey {4 * middle - 2:.2f}"
    )
    assert fits.standing > 35
    assert abs(np.mean(fits.outward)) < bar_px
    assert len(edges) > 30
    assert abs(np.mean(edges)) > 0.1
    assert np.median(response) == pytest.approx(4 * middle - 2, abs=0.1)


def test_motion_blur_is_found_and_leaves_the_corners():
    rng = np.random.default_rng(18)
    fits = Fits()
    for _ in range(40):
        view = random_view(
            rng, side_px=float(rng.uniform(40, 80)), blur_px=0.6, noise=2.0, motion_px=3.0,
            motion_deg=float(rng.uniform(0, 180)),
        )  # fmt: skip
        shot = shoot(view, rng)
        fits.add(view, shot, shot.uv + rng.normal(0, 0.2, (4, 2)))
    low, middle, high = np.percentile(fits.motion_px, [5, 50, 95])
    print(
        f"{fits.standing} of 40 stand, way {low:.2f} to {high:.2f} px, median {middle:.2f} px of 3; "
        f"normalised squares {fits.squares_2.mean():.2f}, bias {fits.bias_px:.4f} px"
    )
    assert fits.standing > 35
    assert low > 0.85 * 3
    assert high < 1.15 * 3
    assert fits.squares_2.mean() < 1.5
    assert fits.bias_px < 0.01


def test_no_motion_is_found_where_there_is_none():
    """Least of what could be told: the streak's variance is good to about 0.03 px²."""
    rng = np.random.default_rng(19)
    fits = Fits()
    for _ in range(20):
        view = random_view(rng, side_px=60.0, noise=2.0)
        shot = shoot(view, rng)
        fits.add(view, shot, shot.uv)
    print(f"way of tags at rest: at most {max(fits.motion_px):.2f} px")
    # A streak of 1.3 px is a variance of 0.07 px² on either side of none.
    assert max(fits.motion_px) < 1.4


LENS = (1100.0, 1103.0, 640.0, 480.0, -0.2, 0.03, 0.001, -0.001, 0.0)


def test_the_lens_bends_prints_and_is_undone():
    """Large tags off the axis; without intrinsics the edges' bow of a pixel is a misfit, or shifts the corners."""
    rng = np.random.default_rng(20)
    known, unknown = Fits(), Fits()
    for _ in range(14):
        centre = (float(rng.uniform(150, 300)), float(rng.uniform(150, 800)))
        view = random_view(rng, side_px=120.0, tilt_deg=float(rng.uniform(0, 45)), centre=centre, lens=LENS)
        shot = shoot(view, rng)
        known.add(view, shot, shot.uv + rng.normal(0, 0.3, (4, 2)), shot.intrinsics)
        unknown.add(view, shot, shot.uv + rng.normal(0, 0.3, (4, 2)))
    print(
        f"with the lens: rms {known.rms_px:.4f} px, bias {known.bias_px:.4f} px, squares {known.square_8:.2f}; "
        f"without: {unknown.standing} stand, rms {unknown.rms_px if unknown.standing else np.nan:.3f} px"
    )
    assert known.standing == 14
    assert known.rms_px < 0.015
    assert known.bias_px < 0.005
    assert known.square_8 < 1.5
    assert unknown.standing == 0 or unknown.rms_px > 5 * known.rms_px


@pytest.mark.parametrize("family", ["tag25h9", "tag16h5", "tagStandard41h12", "DICT_5X5_100"])
def test_families(family):
    """Corners of the quad each family reports, to the same floor; DESIGN's one contract for all of them."""
    rng = np.random.default_rng(21)
    fits = Fits()
    for _ in range(12):
        view = random_view(
            rng, family=family, tag_id=int(rng.integers(30)), side_px=float(rng.uniform(30, 60)), noise=2.0,
            tilt_deg=float(rng.uniform(0, 45)),
        )  # fmt: skip
        shot = shoot(view, rng)
        fits.add(view, shot, off_by(rng, shot.uv, 0.02 * view.side_px))
    print(f"{family}: rms {fits.rms_px:.4f} px, squares {fits.square_8:.2f}, {set(fits.reasons)}")
    assert set(fits.reasons) == {""}
    assert fits.rms_px < 0.035
    assert fits.square_8 < 1.5


# What is not a tag ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene():
    """One good view."""
    view = View(FAMILY, 7, 60.0, 25.0, 40.0, 15.0)
    return view, shoot(view, np.random.default_rng(1))


@pytest.mark.parametrize("intrinsics", [None, LENS], ids=["no lens", "lens"])
def test_what_is_no_quad_gets_a_reason_in_bounded_time(scene, intrinsics):
    _, shot = scene
    uv = shot.uv
    centre = uv.mean(axis=0)
    nan, infinite = uv.copy(), uv.copy()
    nan[2, 1], infinite[0, 0] = np.nan, np.inf
    odd = {
        "the other way round": uv[::-1],
        "crossed": uv[[0, 2, 1, 3]],
        "turned by a corner": uv[[1, 2, 3, 0]],
        "nan": nan,
        "all nan": np.full((4, 2), np.nan),
        "infinite": infinite,
        "a point": np.repeat(centre[None], 4, axis=0),
        "a line": centre + np.arange(4)[:, None] * [5.0, 3.0],
        "outside": uv + 10_000,
        "outside, negative": uv - 10_000,
        "half outside": uv - centre,
        "a million px": centre + 1e6 * (uv - centre) / 60,
        "not convex": np.array([uv[0], uv[1], centre + 0.1 * (uv[0] - centre), uv[3]]),
    }
    refiner = Refiner(np.array(intrinsics) if intrinsics else None)
    refiner.refine(shot.grey, [FAMILY], [7], uv[None])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        start = time.perf_counter()
        fit = refiner.refine(shot.grey, [FAMILY] * len(odd), [7] * len(odd), np.array(list(odd.values())))
        took_s = time.perf_counter() - start
    print(dict(zip(odd, fit.reason)), f"{1e3 * took_s:.0f} ms")
    assert all(reason in REASONS and reason for reason in fit.reason)
    assert took_s < 2


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (3, 3), (0, 0)])
def test_pictures_of_next_to_nothing(shape):
    fit = Refiner().refine(
        np.zeros(shape, np.uint8), [FAMILY], [7], np.array([[[0, 0], [9, 0], [9, 9], [0, 9.0]]])
    )
    assert fit.reason[0] in REASONS and fit.reason[0]


@pytest.mark.parametrize("value", [0, 128, 255])
def test_plain_pictures(value):
    grey = np.full((80, 80), value, np.uint8)
    fit = Refiner().refine(grey, [FAMILY], [7], np.array([[[20, 20], [60, 20], [60, 60], [20, 60.0]]]))
    assert fit.reason[0] == {0: "under-exposed", 128: "no contrast", 255: "over-exposed"}[value]


def test_no_tags(scene):
    fit = Refiner(np.array(LENS)).refine(scene[1].grey, [], [], np.empty((0, 4, 2)))
    assert len(fit) == 0
    assert fit.uv.shape == (0, 4, 2) and fit.cov.shape == (0, 8, 8) and fit.reason.shape == (0,)


def test_the_same_tag_twice_is_refined_twice_to_the_same_corners(scene):
    """Which of the two is believed is for those who know the network."""
    _, shot = scene
    rng = np.random.default_rng(2)
    starts = np.array([off_by(rng, shot.uv, 0.5), off_by(rng, shot.uv, 1.0)])
    fit = Refiner().refine(shot.grey, [FAMILY] * 2, [7] * 2, starts)
    apart = np.abs(fit.uv[0] - fit.uv[1]).max()
    print(f"from two starts: {apart:.4f} px apart, sigma {np.sqrt(fit.cov[0].max()):.4f} px")
    assert fit.reason.tolist() == ["", ""]
    assert apart < 0.3 * np.sqrt(fit.cov[0].max())


def test_the_same_picture_gives_the_same_bytes_in_any_order_of_tags(scene):
    _, shot = scene
    rng = np.random.default_rng(3)
    starts = np.array([off_by(rng, shot.uv, 0.3 * k) for k in range(6)])
    ids = np.array([7, 7, 8, 7, 9, 7])
    order = rng.permutation(6)

    def bytes_of(fit, back):
        numbers = (fit.uv, fit.cov, fit.blur_px, fit.motion_px, fit.noise, fit.misfit, fit.whole)
        return [a[back].tobytes() for a in numbers], fit.reason[back].tolist()

    first = Refiner(np.array(LENS)).refine(shot.grey, [FAMILY] * 6, ids, starts)
    refiner = Refiner(np.array(LENS))
    again = refiner.refine(shot.grey, [FAMILY] * 6, ids[order], starts[order])
    refiner.refine(255 - shot.grey, [FAMILY] * 6, ids, starts)  # nothing is kept from one picture to the next
    third = refiner.refine(shot.grey, [FAMILY] * 6, ids, starts)
    assert bytes_of(first, slice(None)) == bytes_of(again, np.argsort(order)) == bytes_of(third, slice(None))


def test_a_tag_cut_by_the_border_is_refused_or_right(scene):
    view, shot = scene
    fits = Fits()
    reasons = []
    for cut in range(0, 70, 5):
        fit = fits.add(
            view, replace(shot, grey=shot.grey[:, cut:].copy(), uv=shot.uv - [cut, 0]), shot.uv - [cut, 0]
        )
        reasons.append(fit.reason[0])
        if not fit.reason[0]:
            assert fit.uv[0, :, 0].min() >= 0
    print(reasons)
    assert "cut by the border" in reasons
    assert np.sqrt(2 * fits.squares_2.max()) < 5
