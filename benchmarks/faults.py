"""Injected faults, alone and together: what they do to the cutting edge, and whether what changed is found.

Corners are drawn, no pictures; the adjustment is told of the changes that it named itself, as its sentences say. Bars:
RMSE of the cutting edge at most 1.2 times the clean one outside the gaps; every change found within 60 s of data, its
size within 3 sigma; no false alarm in the clean logs, half of which have corner errors that drift.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from benchmarks._results import keep_result
from pipeline.config.site import EstimationSettings, Split
from pipeline.estimation import adjust
from tests.estimation.faults import FAULTS, inject, scene
from tests.estimation.simulator import T0_NS

SECONDS, SEEDS, QUIET = 240.0, (1,), range(200, 210)
WORSE, LATE_S, SIGMAS, MARGIN_S = 1.2, 60.0, 3.0, 1.0
TOGETHER = tuple(f for f in FAULTS if f != "dead")
CASES = ((), *((f,) for f in FAULTS), TOGETHER, FAULTS)


def main() -> int:
    """Print the table and the verdict; 1 if a bar is missed."""
    print(f"{'faults':34} {'rmse mm':>8} {'clean':>7} {'ratio':>6} {'untold':>6} {'s':>4}  changes")
    missed: list[str] = []
    rows: list[dict] = []
    alarms = 0
    for seed in SEEDS:
        clean = scene(seed, SECONDS)
        reference = None
        for faults in CASES:
            name = "+".join(faults) if len(faults) < 4 else f"{len(faults)} together"
            name += " with dead" if len(faults) > 4 and "dead" in faults else ""
            injected = inject(clean, faults, seed)
            started = time.monotonic()
            error, found = _run(injected.drawn, EstimationSettings())
            untold = error
            if found:
                error, _ = _run(injected.drawn, EstimationSettings(split=tuple(map(_told, found))))
            reference = error if reference is None else reference
            outside = _outside(injected)
            ratio, raw = (_rms(e, outside) / _rms(reference, outside) for e in (error, untold))
            said, faulty = _judge(injected, found)
            if ratio > WORSE or faulty:
                missed.append(name or "clean")
            seconds = time.monotonic() - started
            rows.append(
                {"faults": list(faults), "seed": seed, "ratio": ratio, "ratio_untold": raw, "changes": said}
            )
            print(f"{name or 'clean':34} {1000 * _rms(error, outside):8.2f} {1000 * _rms(reference, outside):7.2f} "
                  f"{ratio:6.2f} {raw:6.2f} {seconds:4.0f}  {'; '.join(said)}", flush=True)  # fmt: skip
    for seed in QUIET:
        _, found = _run(scene(seed, SECONDS, 0.1 * (seed % 2)), EstimationSettings(cross_validation=False))
        alarms += len(found)
    if alarms:
        missed.append(f"{alarms} false alarms")
    line = (f"faults: {len(CASES) * len(SEEDS)} cases, worst edge RMSE {max(r['ratio'] for r in rows):.2f} times the "
            f"clean one (bar {WORSE}), {alarms} false alarms in {len(QUIET)} logs")  # fmt: skip
    line += f"; MISSED: {', '.join(missed)}" if missed else ""
    keep_result("faults", rows, line)
    print(line)
    return 1 if missed else 0


def _run(drawn, settings):
    """Error of the cutting edge's middle by frame, (F, 3) with nan where there is none; and the changes named."""
    solution = adjust(drawn.network, drawn.observations, drawn.readings, settings)
    tool = solution.body("tool")
    error, rows = drawn.error(tool)
    out = np.full((len(drawn.frame_ns), 3), np.nan)
    out[np.searchsorted(drawn.frame_ns, tool.time_ns[rows])] = error[:, :3]
    return out, solution.diagnostics["changes"]["found"]


def _told(change: dict) -> Split:
    at = np.datetime64(change["at_ns"], "ns").astype("datetime64[ms]").item()
    return Split.model_validate({"static": change["static"], "at": f"{at.isoformat()}Z"})


def _outside(injected):
    t = (injected.drawn.frame_ns - T0_NS) * 1e-9
    keep = np.ones(len(t), dtype=bool)
    for low, high in injected.gaps:
        keep &= (t < low - MARGIN_S) | (t > high + MARGIN_S)
    return keep


def _rms(error, rows):
    return float(np.sqrt(np.nanmean(np.sum(error[rows] ** 2, axis=1))))


def _judge(injected, found):
    """What is said of the changes, and whether one is missed, late, of a wrong size, or was never there."""
    said, faulty, left = [], False, list(found)
    for static, (at, size) in injected.steps.items():
        hit = next((c for c in left if static in (c["static"], *c["or"])), None)
        if hit is None:
            said.append(f"{static} MISSED")
            faulty = True
            continue
        left.remove(hit)
        amount = max(hit["amounts"], key=lambda a: abs(a["size"]) / max(a["sigma"], 1e-9))
        if "turn" in static or "mount" in static:
            amount = next((a for a in hit["amounts"] if a["unit"] == "deg"), amount)
            size = np.rad2deg(size)
        elif amount["unit"] == "mm" or amount["unit"] == "ms":
            size = 1000 * size
        z = (abs(amount["size"]) - size) / max(amount["sigma"], 1e-9)
        late = (hit["at_ns"] - T0_NS) * 1e-9 - at
        bad = abs(z) > SIGMAS or abs(late) > LATE_S
        faulty |= bad
        said.append(f"{static} {amount['text']} ({z:+.1f} sigma) {late:+.1f} s{' BAD' if bad else ''}")
    for change in left:
        faulty = True
        said.append(f"{change['static']} was never there")
    return said, faulty


if __name__ == "__main__":
    sys.exit(main())
