"""Pipes as the bottom of a trench: their order, the line along them, and the level under them."""

import numpy as np
import pytest

from pipeline.errors import SurfaceError
from pipeline.surface.alignment import polyline
from pipeline.surface.landxml import XmlPipe
from pipeline.surface.pipe_run import run_of

A, B, C, D = (0.0, 0.0), (30.0, 0.0), (30.0, 40.0), (80.0, 40.0)


def pipe(name, start, end, levels, network="storm"):
    return XmlPipe(network, name, (*start, levels[0]), (*end, levels[1]), 0.3)


RUN = (pipe("p", A, B, (50.0, 49.7)), pipe("q", B, C, (49.6, 49.2)), pipe("r", C, D, (49.2, 48.7)))


def run(pipes=RUN, names=(), network="storm", scale=1.0):
    return run_of(pipes, network, names, scale, "d.xml")


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_a_run_goes_from_its_upper_end_whatever_the_order_in_the_file(order):
    found = run([RUN[k] for k in order])
    assert found.names == ("p", "q", "r")
    line = found.line(100.0)
    assert line.station.tolist() == [100, 130, 170, 220]


def test_a_pipe_that_is_drawn_the_other_way_is_turned():
    back = pipe("q", C, B, (49.2, 49.6))
    found = run([RUN[0], back, RUN[2]])
    assert found.names == ("p", "q", "r")
    assert found.ends[1].tolist() == [[*B, 49.6], [*C, 49.2]]


def test_inverts_are_linear_along_pipes_and_step_at_structures():
    found = run()
    station, invert = found.rows(found.line(100.0), 0.5, "x")
    assert np.all(np.diff(station) > 0)
    at = [100, 115, 129.999, 130.001, 150, 170, 195, 220]
    wanted = [50, 49.85, 49.7, 49.6, 49.4, 49.2, 48.95, 48.7]
    assert np.interp(at, station, invert) == pytest.approx(wanted, abs=1e-4)
    assert np.interp([115.0, 150.0, 195.0], station, invert) == pytest.approx([49.85, 49.4, 48.95], abs=1e-9)


def test_along_another_alignment_that_runs_the_other_way_the_levels_follow_its_stations():
    other = polyline(np.array([[90.0, 40.2], [30.2, 40.2], [30.2, -10.0]]), 500.0)
    station, invert = run(names=("q", "r")).rows(other, 0.5, "x")
    assert np.all(np.diff(station) > 0)
    assert (station[0], invert[0]) == pytest.approx((510.0, 48.7))
    assert (station[-1], invert[-1]) == pytest.approx((600.0, 49.6))
    assert np.interp(580.0, station, invert) == pytest.approx(49.4, abs=1e-3)


def test_feet_become_metres():
    found = run(scale=0.3048)
    assert found.line(0.0).length == pytest.approx(120 * 0.3048)
    assert found.ends[0, 0, 2] == pytest.approx(50 * 0.3048)


@pytest.mark.parametrize(
    "pipes, names, network, sentence",
    [
        (RUN, (), "sewer", "has no pipe network 'sewer'; it holds 'storm'"),
        ((), (), "sewer", "it holds none with pipes"),
        (RUN, ("p", "x"), "storm", "network 'storm' has no pipe 'x'"),
        (
            (*RUN, pipe("s", B, (30.0, -20.0), (49.6, 49.0))),
            (),
            "storm",
            "pipes 'p', 'q', 's' meet .*design.pipe_run",
        ),
        (RUN, ("p", "r"), "storm", "make 2 separate lines"),
        ((*RUN[:2], pipe("z", C, A, (49.2, 50.0))), (), "storm", "make no separate lines with two ends"),
    ],
)
def test_networks_that_are_no_single_line_are_refused_with_the_way_out(pipes, names, network, sentence):
    with pytest.raises(SurfaceError, match=sentence):
        run(pipes, names, network)


def test_a_branch_is_left_out_by_naming_the_run():
    branched = (*RUN, pipe("s", B, (30.0, -20.0), (49.6, 49.0)))
    assert run(branched, ("p", "q", "r")).names == ("p", "q", "r")
    assert run(branched, ("p", "s")).names == ("p", "s")


def test_pipes_beside_the_alignment_or_back_along_it_are_refused():
    found = run()
    with pytest.raises(SurfaceError, match=r"pipe 'p' lies up to 5\.00 m beside the alignment"):
        found.rows(polyline(np.array([[0.0, 5.0], [100.0, 5.0]])), 1.0, "x")
    bent = run([pipe("p", A, B, (50, 49)), pipe("q", B, (5.0, 0.3), (49, 48))])
    with pytest.raises(SurfaceError, match="turn back along the alignment"):
        bent.rows(polyline(np.array([[0.0, 0.0], [100.0, 0.0]])), 1.0, "x")


def test_a_wrong_coordinate_does_not_ask_for_all_memory():
    with pytest.raises(SurfaceError, match="the pipes of network 'storm' are 2000000 km long in all"):
        run([pipe("p", A, (2e9, 0.0), (50, 49))])
