"""Shots from files, and shots against the surface."""

import numpy as np
import pytest

from pipeline.errors import SurfaceError
from pipeline.surface.as_built import as_built
from pipeline.surface.checks import COMPARED, OUTSIDE_ALIGNMENT, OUTSIDE_CUT, compare, summarise
from pipeline.surface.design import ProfileDesign
from pipeline.surface.shots import Shots, check_order, read_shots

PLAIN = "007,4123456.5,512345.25,50.125,FL\nNA,4123457.0,512346.0,50.0,\n"


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "checks.csv"
    path.write_bytes(text.encode(encoding))
    return path


def test_ids_are_strings_and_northing_comes_first(tmp_path):
    shots = read_shots(written(tmp_path, PLAIN), "PNEZD", 1.0)
    assert shots.point.tolist() == ["007", "NA"]
    assert shots.code.tolist() == ["FL", ""]
    assert shots.p_grid[0].tolist() == [512345.25, 4123456.5, 50.125]  # easting, northing, elevation
    assert read_shots(written(tmp_path, PLAIN), "PENZD", 1.0).p_grid[0, 0] == 4123456.5


def test_lengths_are_converted_from_the_grid_unit(tmp_path):
    foot = 1200 / 3937
    shots = read_shots(written(tmp_path, PLAIN), "PNEZD", foot)
    assert shots.p_grid[1] == pytest.approx(np.array([512346.0, 4123457.0, 50.0]) * foot, rel=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        PLAIN.replace(",", "\t"),
        PLAIN.replace(",", ";"),
        PLAIN.replace(",", ";").replace(".", ","),
        "point,northing,easting,elevation,description\n" + PLAIN,
        "\ufeff\n" + PLAIN.replace("\n", "\r\n\r\n"),
        PLAIN.replace(",FL", ",FL,floor").replace(",floor", ""),
    ],
)
def test_separators_headings_decimal_commas_and_line_ends_do_not_matter(tmp_path, text):
    shots = read_shots(written(tmp_path, text), "PNEZD", 1.0)
    plain = read_shots(written(tmp_path, PLAIN), "PNEZD", 1.0)
    assert shots.point.tolist() == plain.point.tolist() and shots.code.tolist() == plain.code.tolist()
    assert np.array_equal(shots.p_grid, plain.p_grid)


def test_a_description_may_hold_the_separator_and_other_alphabets(tmp_path):
    shots = read_shots(
        written(tmp_path, '1,2,3,4,"floor, wet"\n2,2,3,4,Sohle,links\n3,2,3,4,Grün\n', "latin-1"), "PNEZD", 1
    )
    assert shots.code.tolist() == ["floor, wet", "Sohle,links", "Grün"]


def test_a_missing_separator_after_the_name_is_put_back_and_told(tmp_path):
    text = "1\t10.5\t20.5\t1.5\tFL\nFS968 B 11.5\t21.5\t2.5\t\nFS 12\t12.5\t22.5\t3.5\tB\n"
    shots = read_shots(written(tmp_path, text), "PENZD", 1.0)
    assert shots.point.tolist() == ["1", "FS968 B", "FS 12"]
    assert shots.p_grid[1:].tolist() == [[11.5, 21.5, 2.5], [12.5, 22.5, 3.5]]
    assert shots.mended == (2,)


def test_an_empty_file_has_no_shots(tmp_path):
    assert len(read_shots(written(tmp_path, ""), "PNEZD", 1.0)) == 0
    assert (
        len(read_shots(written(tmp_path, "point,northing,easting,elevation,description\n"), "PNEZD", 1.0))
        == 0
    )


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("hello\nworld\n", "the first one is 'hello'"),
        (PLAIN + "3,abc,2,3,x\n", r"checks\.csv:3: expected a number, found 'abc'"),
        (PLAIN + "3,1e400,2,3,x\n", r"checks\.csv:3: expected a number, found '1e400'"),
        (PLAIN + "3,1,2,\n", r"checks\.csv:3: expected a number, found ''"),
        (PLAIN + "3,1\n", r"checks\.csv:3: .* found 2 columns"),
        (PLAIN + "3,inf,2,3,x\n", "found 'inf'"),
        ("p,easting,northing,z,d\n" + PLAIN, "headings are p, easting, northing, z, but .* write 'PENZD'"),
        ("PK\0\3" + PLAIN, "not a text file"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_with_its_line(tmp_path, text, sentence):
    with pytest.raises(SurfaceError, match=sentence):
        read_shots(written(tmp_path, text), "PNEZD", 1.0)


def test_a_wrong_order_is_told_by_where_the_design_is(tmp_path):
    low, high = np.array([512_300.0, 4_123_400]), np.array([512_400.0, 4_123_500])
    right = read_shots(written(tmp_path, PLAIN), "PNEZD", 1.0)
    check_order(right, low, high, "PNEZD", "checks.csv")
    wrong = read_shots(written(tmp_path, PLAIN), "PENZD", 1.0)
    with pytest.raises(
        SurfaceError, match=r"0 of 2 shots lie near.* exchanged 2 do\. Write checks\.order = 'PNEZD'"
    ):
        check_order(wrong, low, high, "PENZD", "checks.csv")
    # Where northing and easting look alike nothing can be told, and nothing is said.
    local = Shots(right.point, right.code, np.array([[1000.0, 1010, 5], [1003, 1001, 5]]))
    check_order(local, np.array([990.0, 990]), np.array([1020.0, 1020]), "PENZD", "checks.csv")


def shots_at(trench, station, offset, h):
    station, offset, h = np.broadcast_arrays(np.asarray(station, float), offset, h)
    p = np.column_stack([trench.alignment.points(station, offset), h])
    names = np.array([f"P{i}" for i in range(len(p))], dtype=object)
    return Shots(names, np.full(len(p), "FL", object), p)


@pytest.fixture(scope="module")
def built(trench):
    return as_built(trench.passes([50.02], sigma=0.003, common=0.004), trench.alignment, trench.design, 0.05)


def test_difference_is_as_built_minus_total_station(trench, built):
    shots = shots_at(trench, [3, 4, 5], [0, 0.2, -0.3], 50.0)
    found = compare(shots, built, trench.alignment, 0.002)
    assert np.allclose(found.difference, 0.02, rtol=0, atol=1e-9)
    assert np.allclose(found.sigma, 0.005, rtol=1e-6)
    assert np.allclose(found.z, 0.02 / np.hypot(0.005, 0.002), rtol=1e-6)
    assert np.allclose(found.station, [3, 4, 5]) and np.allclose(found.offset, [0, 0.2, -0.3])
    assert set(found.result) == {COMPARED}


def test_shots_where_nothing_was_cut_are_kept_and_not_compared(trench, built):
    shots = shots_at(trench, [9.5, 5.0, 5.0, -1.0, 11.0], [0, 0.9, 500.0, 0, 0], 50.0)
    found = compare(shots, built, trench.alignment, 0.002)
    assert found.result.tolist() == [OUTSIDE_CUT] * 3 + [OUTSIDE_ALIGNMENT] * 2
    assert np.isnan(found.difference).all() and np.isnan(found.z).all()
    assert summarise(shots, found).n == 0 and summarise(shots, found).indicative_only


def test_a_control_point_beside_the_floor_is_not_a_shot_of_the_floor(trench):
    wide = as_built(trench.passes([50.0], width=2.0), trench.alignment, trench.design, 0.05)
    shots = shots_at(trench, [5.0] * 3, [0.0, 0.8, 0.54], 50.0)  # the last within reach of cells of the floor
    found = compare(shots, wide, trench.alignment, 0.002)
    assert found.result.tolist() == [COMPARED, OUTSIDE_CUT, OUTSIDE_CUT]


def test_the_slope_beside_the_floor_does_not_tilt_it_under_a_shot_at_its_edge(trench):
    sloped = ProfileDesign("s", np.array([0.0, 10.0]), np.array([50.0, 50.0]), np.ones(2), np.full(2, 0.5))
    surface = as_built(trench.passes([50.0]), trench.alignment, sloped, 0.05)
    found = compare(shots_at(trench, [5.0, 5.0], [0.47, -0.49], 50.0), surface, trench.alignment, 0.002)
    assert set(found.result) == {COMPARED}
    assert np.allclose(found.difference, 0.0, rtol=0, atol=1e-6)


def test_a_gradient_of_the_floor_does_not_enter_the_difference(trench):
    """At the end of the cut the cells around a shot lie all on one side of it."""
    steep = ProfileDesign("s", np.array([0.0, 10.0]), np.array([50.0, 51.0]), np.ones(2), np.zeros(2))
    t = np.arange(0, 3, 0.05)
    edge = trench.edge(t, 3 + t, 0.0, 50 + 0.1 * (3 + t))
    surface = as_built(edge, trench.alignment, steep, 0.05)
    shots = shots_at(trench, [2.95, 4.0, 4.013], [0, 0.1, 0.49], np.array([50.295, 50.4, 50.4013]))
    found = compare(shots, surface, trench.alignment, 0.002)
    assert np.allclose(found.difference, 0.0, rtol=0, atol=1e-6)


def test_the_statistics_are_those_of_the_differences(trench, built):
    rng = np.random.default_rng(0)
    error = rng.normal(0.003, 0.004, 40)
    shots = shots_at(trench, rng.uniform(2.2, 7.8, 40), rng.uniform(-0.4, 0.4, 40), 50.02 - error)
    summary = summarise(shots, compare(shots, built, trench.alignment, 0.002))
    worst = int(np.argmax(np.abs(error)))
    assert summary.n == 40 and not summary.indicative_only
    assert summary.bias_m == pytest.approx(error.mean(), abs=1e-9)
    assert summary.rmse_m == pytest.approx(np.sqrt(np.mean(error**2)), abs=1e-9)
    assert (summary.worst_point, summary.worst_m) == (f"P{worst}", pytest.approx(error[worst], abs=1e-9))
    assert summary.reduced_chi_square == pytest.approx(np.mean(error**2) / (25e-6 + 4e-6), rel=1e-6)
