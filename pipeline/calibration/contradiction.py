"""What pictures and files say of each other, before anything that was told of them is written.

The adjustment spreads a wrong size or a wrong survey over everything that is free: prints one in a hundred larger than
the file says left corners at 1.7 of their sigma, the mount of a camera 77 mm off and its stated sigma at 2.8 mm
(`tests/calibration/test_cluster.py` prints it).
"""

from __future__ import annotations

import numpy as np

from pipeline.calibration.adjusted import Adjusted
from pipeline.errors import CalibrationError
from pipeline.estimation.validation import left_out

WRONG_SIGMA0 = 3.0
"""Corners this many times as far off as detection says are no noise."""
WRONG_CHANCE = 1e-6
"""Of a benchmark as far from its survey as it is."""


def refuse_contradiction(whole: Adjusted) -> dict[str, dict]:
    """Each benchmark as everything else predicts it (`estimation.validation.left_out`).

    Raises
    ------
    CalibrationError
        Corners are too far from where they should be, or a benchmark is.
    """
    benchmarks = left_out(whole.problem, whole.optimum.values, whole.found)
    off = {name: found for name, found in benchmarks.items() if found.get("chance", 1.0) < WRONG_CHANCE}
    if off:
        worst = max(off, key=lambda name: off[name]["normalised"])
        mm = float(np.linalg.norm(off[worst]["difference_mm"]))
        said = (
            f"'{worst}' lies {mm:.0f} mm ({off[worst]['normalised']:.0f} sigma) from its survey, by all else"
        )
        if 2 * len(off) > len(benchmarks):
            said += (
                f", and {len(off)} of {len(benchmarks)} benchmarks are off: most likely the prints are of another size "
                "than size_m says (measure one with a rule), or the cameras' intrinsics are of another lens or size"
            )
        else:
            said += "; check its survey in site.toml and its tags' size_m"
    elif whole.sigma0 > WRONG_SIGMA0:
        said = (
            f"corners are {whole.sigma0:.1f} times as far from where they should be as detection says, those of "
            f"'{_worst_marker(whole)}' most of all; check its tags' size_m and its survey in site.toml, and that the "
            "cameras' intrinsics are of this lens and size"
        )
    else:
        return benchmarks
    raise CalibrationError(f"the pictures contradict the files: {said}; nothing was written")


def _worst_marker(whole: Adjusted) -> str:
    worst: dict[str, float] = {}
    for k, marker in enumerate(whole.network.markers):
        rows = whole.residuals.marker == k
        if np.any(rows):
            worst[marker.name] = float(np.median(whole.residuals.normalised[rows]))
    return max(worst, key=lambda name: worst[name])
