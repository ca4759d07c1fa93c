"""Station and offset against shapely on lines and on finely cut arcs."""

import numpy as np
import pytest
import shapely

from pipeline.errors import SurfaceError
from pipeline.surface.alignment import from_elements, polyline

FAR = np.array([2_123_456.0, 7_654_321.0])
CORNERS = np.array([[0, 0], [10, 4], [7, 19], [-5, 14.0]])


def arcs():
    """Straight 20 m north, a right turn of 90 degrees with radius 10, straight 15 m east, a left one of 270."""
    nan = (np.nan, np.nan)
    return from_elements(
        start=[(0, 0), (0, 20), (10, 30), (25, 30)],
        end=[(0, 20), (10, 30), (25, 30), (20, 35)],
        center=[nan, (10, 20), nan, (25, 35)],
        turn=[0, 1, 0, -1],
        start_station_m=1000.0,
        name="road",
    )


def worst(found, wanted, where):
    """Largest difference among the points that count."""
    return np.max(np.abs(found - wanted)[where])


def finely(alignment, step=0.005):
    station = np.arange(alignment.start_station, alignment.end_station, step)
    return station, alignment.points(station, 0.0)


def test_offset_is_positive_to_the_right_looking_along_the_alignment():
    north = polyline([[0, 0], [0, 10]])
    station, offset = north.station_offset(np.array([[2.0, 5.0], [-2.0, 5.0]]))
    assert station.tolist() == [5, 5]
    assert offset.tolist() == [2, -2]


def test_a_polyline_agrees_with_shapely_far_from_the_origin():
    alignment = polyline(CORNERS + FAR, start_station_m=100.0)
    rng = np.random.default_rng(0)
    p = rng.uniform(CORNERS.min(0) - 8, CORNERS.max(0) + 8, (20_000, 2)) + FAR
    station, offset = alignment.station_offset(p)
    line, points = shapely.LineString(CORNERS + FAR), shapely.points(p)
    beside = (station > alignment.start_station) & (station < alignment.end_station)
    assert np.count_nonzero(beside) > 13_000
    # 1e-9 m is what seven million metres leave of double precision.
    assert worst(np.abs(offset), shapely.distance(line, points), beside) < 1e-8
    located = 100 + shapely.line_locate_point(line, points)
    assert worst(station, located, beside) < 1e-8


def test_the_side_is_right_behind_a_corner_sharper_than_a_right_angle():
    hairpin = polyline([[0, 0], [0, 10], [1, 0]])
    _, offset = hairpin.station_offset(np.array([[0.02, 10.5], [-3.0, 10.2], [3.0, 10.2], [0.3, 4.0]]))
    assert np.sign(offset).tolist() == [-1, -1, -1, 1]  # everything outside the hairpin is to its left


def test_beyond_the_ends_the_tangent_goes_on():
    alignment = polyline([[0, 0], [10, 0], [10, 10]], start_station_m=50.0)
    station, offset = alignment.station_offset(np.array([[-3.0, 1.0], [12.0, 14.0]]))
    assert np.allclose(station, [47, 74])
    assert np.allclose(offset, [-1, 2])
    assert np.allclose(alignment.points([47.0, 74.0], [-1.0, 2.0]), [[-3, 1], [12, 14]])
    # On an arc as well, where the angle about the centre would lead round instead.
    station, offset = arcs().station_offset(np.array([[20.0, 34.0]]))
    assert station[0] == pytest.approx(arcs().end_station + 1.0)
    assert offset[0] == pytest.approx(0.0, abs=1e-9)


def test_arcs_have_the_length_of_their_angle():
    lengths = np.diff(arcs().station)
    assert np.allclose(lengths, [20, 10 * np.pi / 2, 15, 5 * 1.5 * np.pi])
    station, p = finely(arcs())
    walked = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    assert np.allclose(station - 1000.0, walked, rtol=0, atol=1e-4)


def test_arcs_agree_with_a_finely_cut_line():
    alignment = arcs()
    rng = np.random.default_rng(1)
    p = rng.uniform([-6, -6], [36, 46], (4000, 2))
    station, offset = alignment.station_offset(p)
    _, fine = finely(alignment)
    line = shapely.LineString(fine)
    distance, located = (
        shapely.distance(line, shapely.points(p)),
        shapely.line_locate_point(line, shapely.points(p)),
    )
    inside = (station > 1000.01) & (station < alignment.end_station - 0.01)
    assert worst(np.abs(offset), distance, inside) < 1e-5
    # Near the centre of an arc all of it is equally near.
    clear = inside & (np.abs(offset) < 4.5)
    assert worst(station - 1000.0, located, clear) < 5e-3


def test_points_and_station_offset_are_inverse_near_the_alignment():
    alignment = arcs()
    rng = np.random.default_rng(2)
    station = rng.uniform(990, alignment.end_station + 10, 2000)
    offset = rng.uniform(-2, 2, 2000)
    again = alignment.station_offset(alignment.points(station, offset))
    # The tangent beyond the last arc crosses the straight before it, whose own stations are the nearest there.
    alone = station < alignment.end_station + 1
    assert np.count_nonzero(alone) > 1500
    assert worst(again[0], station, alone) < 1e-9
    assert worst(again[1], offset, alone) < 1e-9


def test_many_elements_give_what_few_give():
    rng = np.random.default_rng(3)
    corners = np.cumsum(rng.uniform(-1, 3, (800, 2)), axis=0)
    alignment = polyline(corners)
    p = corners[rng.integers(0, 800, 3000)] + rng.normal(0, 5, (3000, 2))
    _, offset = alignment.station_offset(p)
    line = shapely.LineString(corners)
    inside = shapely.line_locate_point(line, shapely.points(p)) > 0
    inside &= shapely.line_locate_point(line, shapely.points(p)) < line.length
    assert worst(np.abs(offset), shapely.distance(line, shapely.points(p)), inside) < 1e-9


@pytest.mark.parametrize(
    "change, sentence",
    [
        ({"start": [(0, 0), (0, 21)]}, r"element 2 starts 1\.000 m from the end of element 1"),
        ({"center": [(np.nan, np.nan), (10, 21)]}, r"arc 2 are 10\.050 m and 9\.000 m from its centre"),
        ({"end": [(0, 0), (10, 30)], "start": [(0, 0), (0, 0)]}, "no length|from its centre"),
    ],
)
def test_elements_that_do_not_fit_are_refused(change, sentence):
    sound = {
        "start": [(0, 0), (0, 20)],
        "end": [(0, 20), (10, 30)],
        "center": [(np.nan, np.nan), (10, 20)],
    }
    with pytest.raises(SurfaceError, match=sentence):
        from_elements(**{**sound, **change}, turn=[0, 1], start_station_m=0.0, name="road")


def test_a_point_given_twice_is_named():
    with pytest.raises(SurfaceError, match="points 2 and 3 are the same"):
        polyline([[0, 0], [1, 1], [1, 1], [2, 2]])
