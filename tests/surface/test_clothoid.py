"""Spirals against Fresnel integrals, adaptive integration of the heading, and brute force for the nearest point."""

import time

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.special import fresnel

from pipeline.errors import SurfaceError
from pipeline.surface.alignment import from_elements
from pipeline.surface.clothoid import clothoid_to
from pipeline.surface.plan_geometry import without_spirals

FAR = np.array([21_530_239.0, 6_782_560.0])
NAN = np.nan


def integrated(heading, curvature, length, along):
    """Point at a length along, by adaptive integration; counter-clockwise positive."""
    k0, k1 = curvature

    def angle(u):
        return heading + k0 * u + 0.5 * (k1 - k0) * u * u / length

    x = quad(lambda u: np.cos(angle(u)), 0, along, epsabs=1e-12, epsrel=1e-13, limit=500)[0]
    y = quad(lambda u: np.sin(angle(u)), 0, along, epsabs=1e-12, epsrel=1e-13, limit=500)[0]
    return np.array([x, y]), angle(along)


def road(lengths=(50.0, 80.0, 60.0, 40.0, 30.0), radius=120.0, other=200.0, shift=FAR):
    """Line, spiral in, arc to the right, spiral to a flatter arc, straight: as elements, and as a walk of its own.

    Returns what `from_elements` takes, and a function from length along to point and heading.
    """
    k = np.array([[0, 0], [0, 1 / radius], [1 / radius] * 2, [1 / radius, 1 / other], [1 / other, 0]])
    corner, heading, corners, headings = shift + 0.0, 0.7, [shift + 0.0], [0.7]
    for (k0, k1), length in zip(k, lengths, strict=True):
        step, heading = integrated(heading, (-k0, -k1), length, length)
        corner = corner + step
        corners.append(corner)
        headings.append(heading)
    center = np.full((5, 2), NAN)
    center[2] = corners[2] + radius * np.array([np.sin(headings[2]), -np.cos(headings[2])])
    spiral = np.array([1, 3, 4])
    curvature, stated = np.full((5, 2), NAN), np.full(5, NAN)
    curvature[spiral], stated[spiral] = k[spiral], np.array(lengths)[spiral]
    elements = {
        "start": np.array(corners[:-1]),
        "end": np.array(corners[1:]),
        "center": center,
        "turn": [0, 1, 1, 1, 1],
        "curvature": curvature,
        "spiral_length": stated,
    }
    border = np.concatenate([[0], np.cumsum(lengths)])

    def walk(along):
        i = min(int(np.searchsorted(border, along, side="right")) - 1, 4)
        step, angle = integrated(headings[i], -k[i], lengths[i], along - border[i])
        return corners[i] + step, angle

    return elements, walk


def alignment(**changes):
    elements, walk = road()
    return from_elements(**{**elements, **changes}, start_station_m=1000.0, name="road"), walk


def test_a_spiral_from_a_straight_is_the_fresnel_integral():
    length, radius = 80.0, 120.0
    scale = np.sqrt(np.pi * radius * length)
    s, c = fresnel(length / scale)
    end = scale * np.array([c, s])
    spiral = clothoid_to(end, (0.0, 1 / radius), 80.003)
    assert spiral.length == pytest.approx(80.0, abs=1e-9)
    assert spiral.heading == pytest.approx(0.0, abs=1e-12)
    along = np.linspace(0, length, 400)
    s, c = fresnel(along / scale)
    point, direction = spiral.walk(along)
    assert np.abs(point - scale * np.stack([c, s], axis=1)).max() < 1e-10
    angle = along**2 / (2 * radius * length)
    assert np.abs(direction - np.stack([np.cos(angle), np.sin(angle)], axis=1)).max() < 1e-12


@pytest.mark.parametrize(
    "curvature, length",
    [
        ((0.0, 0.05), 60.0),
        ((0.05, 0.01), 70.0),
        ((-0.02, 0.03), 90.0),
        ((-1 / 500, 0.0), 250.0),
        ((0.1, 0.15), 18.0),
    ],
)
def test_a_spiral_between_two_points_is_the_integral_of_its_curvature(curvature, length):
    end, _ = integrated(2.0, curvature, length, length)
    spiral = clothoid_to(end, curvature, length * 1.0001)
    assert spiral.length == pytest.approx(length, abs=1e-8)
    for along in np.linspace(0, length, 23):
        wanted, angle = integrated(2.0, curvature, length, along)
        point, direction = spiral.walk(np.array([along]))
        assert np.abs(point[0] - wanted).max() < 1e-8
        assert direction[0] == pytest.approx([np.cos(angle), np.sin(angle)], abs=1e-9)


def test_points_along_an_alignment_with_spirals_are_those_of_the_integral_to_a_micrometre():
    line, walk = alignment()
    assert line.length == pytest.approx(260.0, abs=1e-6)
    for along in np.linspace(0.0, 260.0, 131):
        point, heading = walk(along)
        right = np.array([np.sin(heading), -np.cos(heading)])
        found = line.points(1000.0 + along, np.array([-3.0, 0.0, 7.0]))
        assert np.abs(found - (point + np.array([[-3.0], [0.0], [7.0]]) * right)).max() < 1e-6


def test_station_and_offset_beside_spirals_are_those_of_the_nearest_point_by_brute_force():
    line, walk = alignment()
    rng = np.random.default_rng(4)
    fine = np.linspace(0.0, 260.0, 2601)
    curve = np.array([walk(s)[0] for s in fine])
    # Within 40 m of a curve of radius 120 m and more the nearest point is the only one.
    p = curve[rng.integers(300, 2200, 150)] + rng.uniform(-28, 28, (150, 2))
    station, offset = line.station_offset(p)
    for point, s, o in zip(p, station, offset, strict=True):
        k = int(np.argmin(np.sum((curve - point) ** 2, axis=1)))
        bracket = (fine[max(k - 2, 0)], fine[min(k + 2, 2600)])
        best = minimize_scalar(
            lambda u, point=point: np.sum((walk(u)[0] - point) ** 2),
            bounds=bracket,
            method="bounded",
            options={"xatol": 1e-9},
        )
        foot, heading = walk(best.x)
        side = (point - foot) @ np.array([np.sin(heading), -np.cos(heading)])
        assert abs(o) == pytest.approx(np.linalg.norm(point - foot), abs=1e-6)
        assert np.sign(o) == np.sign(side)
        assert s - 1000.0 == pytest.approx(best.x, abs=2e-4)  # a minimum is flat: this is what it tells


def test_points_and_station_offset_are_inverse_along_spirals():
    line, _ = alignment()
    rng = np.random.default_rng(5)
    station, offset = rng.uniform(1000, 1260, 100_000), rng.uniform(-60, 60, 100_000)
    p = line.points(station, offset)
    started = time.process_time()
    again = line.station_offset(p)
    assert time.process_time() - started < 3.0  # 0.2 s where compiled code is ready
    assert np.abs(again[0] - station).max() < 1e-6
    assert np.abs(again[1] - offset).max() < 1e-6


def test_beyond_a_spiral_at_the_end_its_tangent_goes_on():
    line, walk = alignment()
    foot, heading = walk(260.0)
    ahead, right = np.array([np.cos(heading), np.sin(heading)]), np.array([np.sin(heading), -np.cos(heading)])
    station, offset = line.station_offset((foot + 5.0 * ahead - 2.0 * right)[None])
    assert station[0] == pytest.approx(1265.0, abs=1e-6)
    assert offset[0] == pytest.approx(-2.0, abs=1e-6)


def test_near_the_centre_of_curvature_the_search_still_ends_at_the_nearest_point():
    end, _ = integrated(0.0, (0.1, 0.2), 15.0, 15.0)
    spiral = clothoid_to(end, (0.1, 0.2), 15.0)
    rng = np.random.default_rng(6)
    p = rng.uniform(-2, 14, (500, 2))
    fine, _ = spiral.walk(np.linspace(0, 15, 15_001))
    least = np.min(np.linalg.norm(fine[None] - p[:, None], axis=2), axis=1)
    found, _ = spiral.walk(spiral.nearest(p))
    assert np.all(np.linalg.norm(found - p, axis=1) < least + 1e-3)


def test_chords_in_place_of_spirals_keep_to_the_line_and_to_its_stations():
    line, _ = alignment()
    plain = without_spirals(line, 1e-4)
    assert plain.curvature is None and len(plain.turn) > 30
    station = np.linspace(1000, 1260, 5001)
    away = np.linalg.norm(plain.points(station, 0.0) - line.points(station, 0.0), axis=1)
    assert 2e-5 < away.max() < 1.05e-4
    assert np.count_nonzero(plain.turn) == 1  # the arc is an arc still
    assert np.array_equal(plain.end[:-1], plain.start[1:])
    assert np.array_equal(plain.start[[0]], line.start[[0]]) and set(line.station) <= set(plain.station)
    assert without_spirals(plain, 1e-4) is plain


def test_spirals_that_do_not_fit_are_refused():
    elements, _ = road()
    wrong = [
        ({"curvature": -elements["curvature"]}, "meet at an angle of .* are its rot and radii right"),
        ({"curvature": elements["curvature"][:, ::-1]}, "rot and radii right"),
        (
            {"spiral_length": elements["spiral_length"] + 0.02},
            r"spiral 2 is stated as 80\.020 m long, .* 80\.000 m",
        ),
        ({"curvature": 30 * elements["curvature"]}, "spiral 2 turns by more than half a circle"),
    ]
    for change, sentence in wrong:
        with pytest.raises(SurfaceError, match=sentence):
            from_elements(**{**elements, **change}, start_station_m=0.0, name="road")
