"""What logs suffer, one fault at a time: the cutting edge stays within 1.2 times the error of the clean log."""

import numpy as np
import pytest

from pipeline.config.site import EstimationSettings
from tests.estimation.faults import LATE_S, edge_error, inject, rmse, scene, told

WORSE = 1.2
SETTINGS = EstimationSettings(cross_validation=False)


@pytest.fixture(scope="module")
def clean():
    drawn = scene(1, 60.0)
    return drawn, edge_error(drawn, SETTINGS)[0]


@pytest.mark.parametrize("fault", ["flips", "outliers", "blind", "dead", "duplicates"])
def test_the_edge_bears_a_fault(clean, fault):
    """5 % of tags flipped, 5 % of corners 3 to 20 px off, nothing seen for 20 s, a camera dead for half the log, one
    row in five twice.
    """
    drawn, reference = clean
    injected = inject(drawn, [fault], seed=1, blind_s=20.0)
    error, solution = edge_error(injected.drawn, SETTINGS)
    outside = injected.outside()
    ratio = rmse(error, outside) / rmse(reference, outside)
    rejected = sum(m["rejected"] for m in solution.diagnostics["pixels"]["markers"].values())
    print(f"\n{fault}: RMSE {1000 * rmse(error, outside):.2f} mm, {ratio:.3f} times the clean one; "
          f"{rejected} of {4 * len(injected.drawn.observations.uv)} corners left out")  # fmt: skip
    assert solution.diagnostics["converged"] and solution.diagnostics["changes"]["found"] == []
    assert ratio < WORSE
    tool = solution.body("tool")
    bridged = ~tool.seen
    if fault == "blind":
        sigma = np.sqrt(np.trace((tool.own + tool.common)[:, :3, :3], axis1=1, axis2=2))
        print(
            f"sigma {1000 * np.median(sigma[~bridged]):.1f} mm seen, {1000 * sigma.max():.0f} mm in the gap"
        )
        assert sigma[bridged].max() > 10 * np.median(sigma[~bridged])
    else:
        assert not np.any(bridged)
    if fault == "outliers":
        # Of those nearer than 7.5 sigma (1.5 px) there are none.
        assert rejected > 0.9 * 0.05 * 4 * len(injected.drawn.observations.uv)


def test_a_clock_that_is_set_by_50_ms_is_named_and_the_edge_mended(clean):
    drawn, reference = clean
    injected = inject(drawn, ["offset"], at_s=40.0)
    found = edge_error(injected.drawn, SETTINGS)[1].diagnostics["changes"]["found"]
    assert [one["static"] for one in found] == ["sensor pot time offset"]
    size, sigma = found[0]["shift"][0], found[0]["sigma"][0]
    split = SETTINGS.model_copy(update={"split": (told(found[0]),)})
    error, _ = edge_error(injected.drawn, split)
    ratio = rmse(error, injected.outside()) / rmse(reference, injected.outside())
    late = (found[0]["at_ns"] - drawn.frame_ns[0]) * 1e-9 - 30.0
    print(
        f"\noffset {1000 * size:.1f} ± {1000 * sigma:.1f} ms, {late:+.1f} s, RMSE {ratio:.3f} times the clean one"
    )
    assert abs(size - LATE_S) < 3 * sigma and abs(late) < 5 and ratio < WORSE
