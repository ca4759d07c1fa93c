"""A sensor's clock that drifts: readings come later and later, and a marker that the joint moves tells by how much."""

import numpy as np
import pytest
import scipy.stats

from pipeline.config import Machine, Site
from pipeline.estimation import adjust
from pipeline.network import Readings, network_of
from pipeline.network.epochs import epochs_of
from tests.estimation.simulator import DRIFTING, MACHINE, SITE, T0_NS, Options, draw

NAME = "sensor pot time offset"
RUNS = 25
LOG = Options(200, 0.04, 0.04, bucket_marker=True, machine=DRIFTING)


@pytest.mark.slow
def test_drifts_of_drawn_clocks_are_off_by_what_their_covariance_says():
    """25 logs of 8 s, the clock 1 +- 10 ms a second off; the bucket's marker is what tells."""
    errors, edge, told = [], [], []
    for run in range(RUNS):
        drawn = draw(300 + run, LOG)
        solution = adjust(drawn.network, drawn.observations, drawn.readings)
        assert solution.diagnostics["converged"]
        static = next(s for s in solution.statics if s.quantity == NAME)
        assert (static.components, static.units) == (("offset", "drift"), ("s", "ppm"))
        errors.append((static.value[1] - drawn.by_name[NAME][1]) / static.sigma[1])
        told.append(static.sigma[1] / static.prior_sigma[1])
        tool = solution.body("tool")
        error, rows = drawn.error(tool)
        cov = (tool.own + tool.common)[rows[-1], :3, :3]
        edge.append(error[-1, :3] @ np.linalg.solve(cov, error[-1, :3]))
    low, high = scipy.stats.chi2.ppf([0.005, 0.995], RUNS) / RUNS
    square = float(np.mean(np.square(errors)))
    edge_low, edge_high = scipy.stats.chi2.ppf([0.005, 0.995], 3 * RUNS) / RUNS
    print(f"mean square of the drift over sigma {square:.2f} ({low:.2f} to {high:.2f})")
    print(f"NEES of the edge {np.mean(edge):.2f} ({edge_low:.2f} to {edge_high:.2f})")
    print(f"sigma over the file's {np.median(told):.2f}")
    assert low < square < high
    assert edge_low < np.mean(edge) < edge_high
    assert np.median(told) < 0.5


def test_readings_lie_where_the_files_drift_puts_them():
    drawn = draw(1, Options(epochs=5, machine=DRIFTING))
    stamps = T0_NS + np.array([0, 1_000_000_000, 3_600_000_000_000])
    laid = epochs_of(drawn.network, drawn.observations, {"pot": Readings(stamps, np.full(3, 1.0))})
    offset, drift = drawn.network.statics[drawn.network.sensors[0].offset].value
    assert (offset, drift) == (0.02, 1000.0)
    found_ns = laid.time_ns[laid.sensors[0].epoch] + np.rint(laid.sensors[0].dt_s * 1e9).astype(np.int64)
    begins_ns = min(T0_NS + 20_000_000, int(drawn.frame_ns[0]))
    due_ns = stamps + 20_000_000 + (stamps + 20_000_000 - begins_ns) // 1000
    assert np.abs(found_ns - due_ns).max() <= 1


def test_without_a_drift_in_the_file_there_is_none_to_tell():
    network = network_of(Machine.model_validate(MACHINE), Site.model_validate(SITE))
    offset = network.statics[network.sensors[0].offset]
    assert (offset.components, len(offset.value)) == (("offset",), 1)
    with pytest.raises(ValueError, match="sigma_clock_drift_ppm"):
        document = {**MACHINE, "sensors": {"pot": MACHINE["sensors"]["pot"] | {"sigma_clock_drift_ppm": -1}}}
        Machine.model_validate(document)
