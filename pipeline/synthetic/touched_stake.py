"""Sites where nothing is dug: logs made to calibrate a machine."""

from __future__ import annotations

from dataclasses import replace

from pipeline.synthetic.specification import Specification, trench
from pipeline.synthetic.touch_plan import TouchPlan


def calibration_bucket() -> Specification:
    """The sample's machine with a curve and an edge that were measured by tape, set on a stake eight times."""
    spec = trench()
    taped = replace(
        spec.sigmas,
        curve_zero=0.010,
        curve_scale=0.004,
        linkage_mm=0.5,
        horn_deg=0.1,
        tool_mm=4.0,
        tool_deg=0.3,
    )
    return replace(
        spec,
        name="calibration-bucket",
        title="Bucket calibration",
        cycles=1,
        utilities=(),
        sigmas=taped,
        touches=TouchPlan(directions_deg=(-178.0, -163.0, -148.0, -133.0, -117.0, -101.0, -86.0, -72.0)),
    )


SITES = {"calibration-bucket": calibration_bucket}
