"""Columns by name, times and kinds: the same shots however they are written, and a sentence for what is unclear."""

import datetime

import numpy as np
import pytest

from pipeline.errors import SurfaceError
from pipeline.surface.shots import NO_TIME, read_shots
from tests.surface.test_checks import written

NAMED = (
    "time,kind,point,easting,northing,elevation,code,sigma_mm,edge_point\n"
    "2026-05-04T10:42:31.250Z,edge,007,512345.25,4123456.5,50.125,CE left,1.5,\n"
    ",floor,NA,512346.0,4123457.0,50.0,FL,,\n"
    "2026-05-04 13:00:00+02:00,control,CP1,512300.0,4123400.0,51.0,CP,,middle\n"
)


def test_named_columns_stand_in_any_order(tmp_path):
    shots = read_shots(written(tmp_path, NAMED), "named", 1.0)
    assert shots.point.tolist() == ["007", "NA", "CP1"] and shots.code.tolist() == ["CE left", "FL", "CP"]
    assert shots.p_grid.tolist()[0] == [512345.25, 4123456.5, 50.125]
    assert shots.kind.tolist() == ["edge", "floor", "control"]
    assert shots.edge_point.tolist() == ["left", "", "middle"]
    assert shots.sigma_m[0] == 0.0015 and np.isnan(shots.sigma_m[1:]).all()
    when = datetime.datetime(2026, 5, 4, 10, 42, 31, 250_000, datetime.UTC)
    assert shots.time_ns[0] == round(when.timestamp() * 1000) * 10**6
    assert shots.time_ns[1] == NO_TIME
    assert (
        shots.time_ns[2] == int(datetime.datetime(2026, 5, 4, 11, 0, tzinfo=datetime.UTC).timestamp()) * 10**9
    )


@pytest.mark.parametrize(
    "text",
    [
        NAMED.replace(",", "\t"),
        NAMED.replace(",", ";"),
        NAMED.replace(",", ";").replace(".", ","),
        NAMED.replace("point", "Name").replace("easting", "E").replace("northing", "N").replace("elevation", "Z")
        .replace("edge_Name", "edge_point"),
    ],
)  # fmt: skip
def test_separators_and_decimal_commas_do_not_matter_to_named_columns(tmp_path, text):
    shots, plain = (read_shots(written(tmp_path, t), "named", 1.0) for t in (text, NAMED))
    for name in ("point", "code", "kind", "edge_point", "time_ns", "p_grid"):
        assert np.array_equal(getattr(shots, name), getattr(plain, name)), name


def test_further_named_columns_may_follow_a_stated_order(tmp_path):
    text = "point,northing,easting,elevation,code,time,kind\n1,4123456.5,512345.25,50.1,CE,2026-05-04T10:00:00Z,edge\n"
    shots = read_shots(written(tmp_path, text), "PNEZD", 1.0)
    assert shots.p_grid[0].tolist() == [512345.25, 4123456.5, 50.1]
    assert shots.kind.tolist() == ["edge"] and shots.code.tolist() == ["CE"] and shots.time_ns[0] != NO_TIME


def test_codes_of_the_site_file_tell_kinds_where_no_column_does(tmp_path):
    text = "1,2.0,3.0,4.0,CE right end\n2,2.0,3.0,4.0,FL\n3,2.0,3.0,4.0,\n"
    shots = read_shots(written(tmp_path, text), "PNEZD", 1.0, "", {"CE": "edge"})
    assert shots.kind.tolist() == ["edge", "floor", "floor"] and shots.edge_point.tolist() == [
        "right",
        "",
        "",
    ]


@pytest.mark.parametrize("comma", [False, True])
def test_columns_lined_up_with_blanks_are_read_where_each_line_has_one_reading(tmp_path, comma):
    text = "  007   4123456.5   512345.25   50.125   FL wet floor\n  NA    4123457.0   512346.0    50.0\n"
    text = text.replace(".", ",") if comma else text
    shots = read_shots(written(tmp_path, text), "PNEZD", 1.0)
    assert shots.point.tolist() == ["007", "NA"] and shots.code.tolist() == ["FL wet floor", ""]
    assert shots.p_grid[0].tolist() == [512345.25, 4123456.5, 50.125]
    heading = read_shots(written(tmp_path, "point northing easting elevation code\n" + text), "PNEZD", 1.0)
    assert np.array_equal(heading.p_grid, shots.p_grid)


def test_a_local_time_is_that_of_the_site_and_one_that_is_twice_is_refused(tmp_path):
    def read(time, zone):
        text = f"point,northing,easting,elevation,time\n1,2.0,3.0,4.0,{time}\n2,2.0,3.0,4.0,\n"
        return read_shots(written(tmp_path, text), "PNEZD", 1.0, zone).time_ns[0]

    summer = int(datetime.datetime(2026, 7, 1, 5, 30, tzinfo=datetime.UTC).timestamp()) * 10**9
    assert read("2026-07-01T08:30:00", "Europe/Helsinki") == summer
    assert read("2026-07-01T05:30Z", "") == summer
    for time, zone, sentence in (
        ("2026-07-01T08:30:00", "", "does not say which clock.*report.time_zone in site.toml"),
        ("2026-10-25T03:30:00", "Europe/Helsinki", "is twice on the clocks of Europe/Helsinki"),
        ("2026-03-29T03:30:00", "Europe/Helsinki", "is skipped by the clocks of Europe/Helsinki"),
        ("2026-07-01T08:30:00", "Mars/Olympus", "not in the database of time zones"),
        ("01.07.2026 08:30", "Europe/Helsinki", r"checks\.csv:2: expected a date and time such as 2026"),
        ("2026-13-01T08:30Z", "", "is no date and time"),
        ("2926-01-01T08:30Z", "", "is no time of a log: check the year"),
    ):
        with pytest.raises(SurfaceError, match=sentence):
            read(time, zone)


@pytest.mark.parametrize(
    "text, order, sentence",
    [
        ("1,2,3,4,x\n2,2,3,4,x\n", "named", "no column is headed point or easting or northing or elevation"),
        ("point,x,y,elevation\n1,2,3,4\n2,3,4,5\n", "named", "no column is headed easting or northing"),
        ("point,n,e,z,northing\n1,2,3,4,5\n", "named", "two columns are headed as northing"),
        ("code,point,northing,easting,elevation\na,1,2,3,4\n", "PNEZD", "write 'named'"),
        ("point,n,e,z,kind\n1,2,3,4,bucket\n", "PNEZD", "kind 'bucket' is none of floor, edge, control"),
        ("point,n,e,z,edge_point\n1,2,3,4,top\n", "PNEZD", "edge_point 'top' is none of left, middle, right"),
        ("point,n,e,z,sigma_mm\n1,2,3,4,0\n", "PNEZD", "sigma_mm 0 is not above zero"),
        ("P 1  2.0  3.0  4.0\nP 2  2.0  3.0  4.0\n", "PNEZD", "blanks that can be read in one way only"),
        ("point n e z code time\n1 2.0 3.0 4.0 a b c\n", "named", "6 columns are headed, and between blanks stand 7"),
    ],
)  # fmt: skip
def test_what_could_be_read_in_two_ways_is_refused(tmp_path, text, order, sentence):
    with pytest.raises(SurfaceError, match=sentence):
        read_shots(written(tmp_path, text), order, 1.0)
