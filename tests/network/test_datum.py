"""Ties to the datum: whose pose is kept in which frame, and what is said about what is not tied."""

import copy

import numpy as np
import pytest

from pipeline.errors import NetworkError
from pipeline.estimation import adjust
from pipeline.geometry import se3
from pipeline.network.datum import tie
from tests.estimation.simulator import MACHINE, Options, draw


def _parents(tied):
    return {
        frame.removeprefix("body "): e.parent
        for frame, e in tied.frames.edges.items()
        if frame.startswith("body ")
    }


def _markers(drawn, *names):
    wanted = [k for k, m in enumerate(drawn.network.markers) if m.name in names]
    return np.isin(drawn.network.tag_marker[drawn.observations.tag], wanted)


def test_a_body_is_kept_in_the_frame_that_sees_it():
    drawn = draw(0, Options(epochs=3))
    seen = drawn.observations
    dig_alone = seen.take((seen.camera == 1) | ~_markers(drawn, "stick"))
    assert _parents(tie(drawn.network, dig_alone, drawn.readings)) == {
        "cab": "world",
        "stick": "camera dig",
        "bucket": "axis bucket",
    }


def test_a_surveyed_site_camera_and_a_marker_on_the_stick_are_enough():
    """Fig. 2 of the paper, the second way; the bucket's angle comes from a marker of its own."""
    machine = copy.deepcopy(MACHINE)
    del machine["cameras"]["bench"], machine["bodies"]["cab"], machine["motion"]["cab"]
    machine["cameras"]["dig"] |= {
        "body": "world",
        "mount": {
            "xyz_m": [0.8, 0.5, 2.5],
            "rpy_deg": [-105.0, 0.0, 3.0],
            "sigma_mm": 2.0,
            "sigma_deg": 0.05,
        },
    }
    # Simulate with the whole machine, its cab standing still; the file knows of the site camera only.
    drawn = draw(1, Options(epochs=10, bucket_marker=True, potentiometer=False))
    machine["markers"]["bucket"] = drawn.machine.model_dump(exclude_none=True)["markers"]["bucket"]
    machine.pop("sensors")
    from pipeline.config import Machine
    from pipeline.network import Observations, network_of

    network = network_of(Machine.model_validate(machine), drawn.site)
    seen = drawn.observations
    rows = _markers(drawn, "stick", "bucket") & (seen.camera == 1)
    ids = drawn.network.tag_id[seen.tag[rows]]
    tags = network.tag_index(["tag36h11"] * len(ids), ids)
    alone = Observations(np.zeros(len(ids), int), tags, seen.time_ns[rows], seen.uv[rows], seen.cov[rows])
    tied = tie(network, alone, {})
    assert _parents(tied) == {"stick": "camera dig", "bucket": "axis bucket"}
    assert any("benchmark 'B1' was never seen" in w for w in tied.warnings)
    solution = adjust(network, alone, {})
    assert solution.diagnostics["converged"]
    # The cab's camera moved a little in truth; here it is taken as standing, so only the chain from it is compared.
    tool = solution.body("tool")
    rows = np.searchsorted(drawn.time_ns, tool.time_ns)
    camera = (
        drawn.T_world["cab"][rows]
        @ drawn.statics[[s.name for s in drawn.network.statics].index("camera dig mount")]
    )
    relative = se3.inverse(camera) @ drawn.T_world["tool"][rows]
    at = [s.name for s in network.statics].index("camera dig mount")
    error = se3.local(se3.inverse(network.statics[at].value) @ tool.T_world_body, relative)
    assert np.abs(error[:, :3]).max() < 0.05


def test_two_single_camera_networks_share_nothing_but_the_survey():
    """Fig. 3: two cameras on the cab and a surveyed third one; loops through the world couple cab and stick."""
    machine = copy.deepcopy(MACHINE)
    machine["cameras"]["site"] = copy.deepcopy(machine["cameras"]["dig"])
    machine["cameras"]["site"] |= {
        "body": "world",
        "topic": "/site",
        "mount": {"xyz_m": [3.0, 1.0, 1.5], "rpy_deg": [-90.0, 0.0, 25.0], "sigma_mm": 3.0, "sigma_deg": 0.1},
    }
    drawn = draw(2, Options(epochs=12, machine=machine))
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    assert ["cab", "stick"] in solution.diagnostics["chains"]
    assert solution.diagnostics["converged"] and solution.diagnostics["corners"]["passed"]
    tool = solution.body("tool")
    error, rows = drawn.error(tool)
    P = (tool.own + tool.common)[rows]
    assert np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error).mean() < 16.8  # 99 % of chi-square, 6


def test_a_static_tripod_that_nobody_surveyed_finds_its_place():
    machine = copy.deepcopy(MACHINE)
    machine["bodies"]["tripod"] = {"kind": "static"}
    machine["cameras"]["site"] = copy.deepcopy(machine["cameras"]["dig"])
    machine["cameras"]["site"] |= {
        "body": "tripod",
        "topic": "/site",
        "mount": {"xyz_m": [0.0, 0.0, 0.0], "rpy_deg": [-90.0, 0.0, 0.0], "sigma_mm": 0.0, "sigma_deg": 0.0},
    }
    place = {"xyz_m": [3.0, 1.0, 1.5], "rpy_deg": [0.0, 0.0, 25.0], "sigma_mm": 0.0, "sigma_deg": 0.0}
    surveyed = copy.deepcopy(machine)
    surveyed["bodies"]["tripod"]["pose"] = place
    truth = draw(3, Options(epochs=8, machine=surveyed))
    from pipeline.config import Machine
    from pipeline.network import network_of

    network = network_of(Machine.model_validate(machine), truth.site)
    solution = adjust(network, truth.observations, truth.readings)
    assert solution.diagnostics["converged"]
    found = next(s for s in solution.statics if s.quantity == "body tripod pose")
    assert np.abs(found.value[:3] - place["xyz_m"]).max() < 4 * found.sigma[:3].max() < 0.2


def test_a_bucket_without_reading_or_marker_is_named_with_the_way_out():
    drawn = draw(4, Options(epochs=3))
    with pytest.raises(NetworkError, match=r"joint 'bucket' has no reading.*'pot'.*put a marker on it"):
        tie(drawn.network, drawn.observations, {})


def test_without_any_benchmark_the_cab_is_named():
    drawn = draw(5, Options(epochs=3))
    with pytest.raises(
        NetworkError, match=r"bodies 'cab', 'stick' see each other but are not tied to the datum.*benchmark"
    ):
        tie(drawn.network, drawn.observations.take(~_markers(drawn, "B1", "B2", "B3")), drawn.readings)


def test_a_benchmark_never_seen_and_an_idle_marker_are_named_but_do_not_stop_the_job():
    machine = copy.deepcopy(MACHINE)
    machine["bodies"]["boom"] = {"kind": "moving"}
    machine["markers"]["boom"] = copy.deepcopy(machine["markers"]["stick"])
    machine["markers"]["boom"] |= {"body": "boom", "tags": [{"id": 90, "size_m": 0.3}]}
    drawn = draw(6, Options(epochs=3))
    from pipeline.config import Machine
    from pipeline.network import network_of

    network = network_of(Machine.model_validate(machine), drawn.site)
    rows = ~_markers(drawn, "B3")
    ids = drawn.network.tag_id[drawn.observations.tag[rows]]
    seen = drawn.observations.take(rows)
    seen = type(seen)(
        seen.camera, network.tag_index(["tag36h11"] * len(ids), ids), seen.time_ns, seen.uv, seen.cov
    )
    solution = adjust(network, seen, drawn.readings)
    assert [s for s in solution.warnings if "benchmark 'B3' was never seen" in s]
    assert [s for s in solution.warnings if "marker 'boom' on 'boom' was never seen" in s]
    assert [s for s in solution.warnings if "body 'boom' is not tied to the datum" in s and "left out" in s]
    assert "boom" not in [s.body for s in solution.states]
    assert solution.diagnostics["warnings"] == list(solution.warnings)


def test_an_empty_site_of_observations_says_so():
    drawn = draw(7, Options(epochs=3))
    with pytest.raises(NetworkError, match="not tied to the datum"):
        adjust(
            drawn.network,
            drawn.observations.take(np.zeros(len(drawn.observations.camera), bool)),
            drawn.readings,
        )
