"""Corner errors against the Cramer-Rao bound, and against their own sigma: `make bench-corners`.

Tags of five sizes and three tilts, each trial with its own lens, place, blur, noise, slope of light, contrast and
JPEG quality (`_draws`), are rendered by `_tag_picture`, which shares nothing with detection, searched, and refined
from what the search found. An error counts divided by the bound of its own trial, so that noisy trials do not speak
for quiet ones. Beside it stand the corners of AprilTag's library with its own fit of the edges, and under "ideal"
what a linear fit attains that starts from the truth and knows the renderer. Bars, per size and tilt: RMS 1.5 times
the bound (2.5 under 30 px), bias 0.02 px (mean error away from the centre, along the picture's axes, and of each
corner of the print away from and across the line from the centre), errors over their own sigma 0.9 to 1.15 in RMS.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections import Counter
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pyapriltags

from benchmarks._bound import ideal_fit
from benchmarks._draws import IDS, Outcome, draw_view, fair_weather, refine, rms, search
from benchmarks._results import keep_result
from benchmarks._tag_picture import Shot, View, shoot
from pipeline.detection.apriltag import TagFinder

SIDES_PX = (20, 30, 40, 80, 160)
TILTS_DEG = (0, 45, 60)
SMALL_PX = 30
RATIO_BAR, RATIO_BAR_SMALL = 1.5, 2.5
BIAS_BAR_PX = 0.02
NORMALISED_BARS = (0.9, 1.15)
ENOUGH = 20
"""Corners that must stand for a cell to be judged."""
HARDER: dict[str, dict[str, tuple[float, float]]] = {
    "defocus disc": {"disc_px": (0.8, 1.6)},
    "motion 1 to 3 px": {"motion_px": (1, 3)},
    "motion 3 to 6 px": {"motion_px": (3, 6)},
    "response 2.2": {"gamma": (2.2, 2.2)},
    "no JPEG": {},
    "fair weather": {},
}
"""Beyond what the bars speak of (the last two: below), at 40 to 100 px and 0 to 60 degrees; printed without a bar."""
BANDS = {
    "blur_px": (0.5, 0.8, 1.2, 1.5),
    "noise": (1, 2.5, 4, 6),
    "quality": (70, 79, 87, 96),
    "slope": (0, 0.1, 0.2),
}


@dataclass(frozen=True)
class Trial:
    """One tag, once."""

    seed: tuple[int, ...]
    view: View
    outcome: Outcome
    edges: np.ndarray
    """(4, 2) errors of the library's corners with its edges fitted, px; nan where it does not find the tag."""
    bound_px: float
    """RMS per axis."""
    ideal_px: float
    """RMS error of a linear fit that starts from the truth."""
    outward: np.ndarray
    """(4, 2) unit vectors from the centre to the corners."""

    @property
    def ratio(self) -> float:
        """RMS error of the refined corners over the bound."""
        return rms(self.outcome.error) / self.bound_px

    @property
    def edges_ratio(self) -> float:
        """RMS error of the corners with fitted edges over the bound."""
        return rms(self.edges) / self.bound_px


@dataclass(frozen=True)
class Cell:
    """Trials of one size and tilt, or of one band."""

    name: str
    trials: int
    found: int
    stand: int
    bound_px: float
    rms_px: float
    ratio: float
    ideal_ratio: float
    """Of a linear fit that starts from the truth and knows the renderer, `_bound.ideal_fit`."""
    outward_px: float
    worst_bias_px: float
    """Largest of the mean errors: outward, along u, along v, and of each corner outward and across."""
    normalised: float
    """By the 8 x 8."""
    normalised_corner: float
    """By the 2 x 2."""
    edges_px: float
    edges_ratio: float
    reasons: dict[str, int]


def run(side_px: float, tilt_deg: float, number: int, seed: int, family: str = "tag36h11") -> list[Trial]:
    """Some trials of one size and tilt."""
    finder = TagFinder([family])
    trials = []
    for k in range(number):
        own = (seed, int(side_px), int(tilt_deg), k)
        rng = np.random.default_rng(own)
        trials.append(_trial(own, draw_view(rng, side_px, tilt_deg, family), rng, finder))
    return trials


def run_harder(name: str, number: int, seed: int) -> list[Trial]:
    """Some trials of one of `HARDER`."""
    finder = TagFinder(["tag36h11"])
    trials = []
    for k in range(number):
        own = (seed, list(HARDER).index(name), k)
        rng = np.random.default_rng(own)
        view = draw_view(rng, rng.uniform(40, 100), rng.uniform(0, 60))
        if name.startswith(("motion", "defocus")):
            view = replace(view, blur_px=rng.uniform(0.5, 0.8), motion_deg=rng.uniform(0, 180))
        if name == "fair weather":
            view = fair_weather(view)
        drawn: dict[str, Any] = {field: rng.uniform(*ends) for field, ends in HARDER[name].items()}
        if name == "no JPEG":
            drawn["quality"] = 0
        view = replace(view, **drawn)
        trials.append(_trial(own, view, rng, finder))
    return trials


def _trial(own: tuple[int, ...], view: View, rng: np.random.Generator, finder: TagFinder) -> Trial:
    shot = shoot(view, rng)
    outcome = refine(view, shot, search(view, shot, finder))
    edges = fitted_edges(view, shot)
    bound, ideal = ideal_fit(view, shot)
    bound_px = float(np.sqrt(np.trace(bound) / 8))
    away = shot.uv - shot.uv.mean(axis=0)
    return Trial(
        own, view, outcome, edges, bound_px, rms(ideal), away / np.linalg.norm(away, axis=1)[:, None]
    )


@cache
def _library(family: str) -> pyapriltags.Detector:
    return pyapriltags.Detector(families=family, quad_decimate=1.0, refine_edges=1)


def fitted_edges(view: View, shot: Shot) -> np.ndarray:
    """(4, 2) errors of the corners that AprilTag's library gives with its edges fitted; nan without just one."""
    mine = [tag.corners for tag in _library(view.family).detect(shot.grey) if tag.tag_id == view.tag_id]
    if len(mine) != 1:
        return np.full((4, 2), np.nan)
    # Its pixel centres are at 0.5; its corners are another one first, and the classic prints are upside down to it.
    turns = [np.roll(mine[0][::-1], k, axis=0) for k in range(4)]
    return min((turn - 0.5 - shot.uv for turn in turns), key=rms)


def summary(name: str, trials: list[Trial]) -> Cell:
    """What some trials amount to."""
    found = [trial for trial in trials if np.all(np.isfinite(trial.outcome.start_uv))]
    with_edges = [trial for trial in trials if np.all(np.isfinite(trial.edges))]
    good = [trial for trial in trials if trial.outcome.stands]
    outward = worst = float("nan")
    if good:
        error = np.array([trial.outcome.error for trial in good])
        away = np.array([trial.outward for trial in good])
        radial = np.sum(error * away, axis=-1)
        across = error[..., 1] * away[..., 0] - error[..., 0] * away[..., 1]
        outward = float(radial.mean())
        means = [outward, *error.mean(axis=(0, 1)), *radial.mean(axis=0), *across.mean(axis=0)]
        worst = float(np.abs(means).max())
    return Cell(
        name,
        len(trials),
        len(found),
        len(good),
        bound_px=rms([trial.bound_px for trial in trials]),
        rms_px=rms([trial.outcome.error for trial in good]),
        ratio=rms([trial.ratio for trial in good]),
        ideal_ratio=rms([trial.ideal_px / trial.bound_px for trial in good]),
        outward_px=outward,
        worst_bias_px=worst,
        normalised=rms([trial.outcome.whitened() for trial in good]),
        normalised_corner=rms([trial.outcome.corners_whitened() for trial in good]),
        edges_px=rms([trial.edges for trial in with_edges]),
        edges_ratio=rms([trial.edges_ratio for trial in with_edges]),
        reasons=dict(Counter(trial.outcome.reason for trial in trials if not trial.outcome.stands)),
    )


def missed_bars(cell: Cell, small: bool) -> list[str]:
    """Which bars a cell misses."""
    missed = []
    if not cell.ratio <= (RATIO_BAR_SMALL if small else RATIO_BAR):
        missed.append("ratio")
    if not cell.worst_bias_px <= BIAS_BAR_PX:
        missed.append("bias")
    if not NORMALISED_BARS[0] <= cell.normalised <= NORMALISED_BARS[1]:
        missed.append("normalised 8x8")
    if not NORMALISED_BARS[0] <= cell.normalised_corner <= NORMALISED_BARS[1]:
        missed.append("normalised 2x2")
    return missed


def print_head() -> None:
    print(
        f"{'':18} found stand |  bound    RMS  ratio ideal | outward  worst | norm8 norm2 | edges: RMS  ratio |"
    )


def print_row(cell: Cell, remark: str) -> None:
    print(
        f"{cell.name:18} {cell.found / cell.trials:5.2f} {cell.stand / cell.trials:5.2f} | {cell.bound_px:6.4f} "
        f"{cell.rms_px:6.4f} {cell.ratio:6.2f} {cell.ideal_ratio:5.2f} | {cell.outward_px:+7.4f} "
        f"{cell.worst_bias_px:6.4f} | "
        f"{cell.normalised:5.2f} {cell.normalised_corner:5.2f} | {cell.edges_px:10.4f} "
        f"{cell.edges_ratio:6.2f} | {remark}",
        flush=True,
    )


def main() -> int:
    """Print the tables and the verdict; 1 if a bar is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=60, help="views per cell (default 60)")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--family", default="tag36h11", choices=sorted(IDS))
    parser.add_argument("--worst", type=int, default=0, metavar="N", help="list the N worst trials of a cell")
    parser.add_argument("--sides", type=int, nargs="+", default=list(SIDES_PX))
    parser.add_argument("--tilts", type=int, nargs="+", default=list(TILTS_DEG))
    options = parser.parse_args()
    print(f"{options.family}, {options.trials} views per cell; px")
    print_head()
    everything: list[Trial] = []
    rows, missed = [], []
    for side_px in options.sides:
        for tilt_deg in options.tilts:
            trials = run(side_px, tilt_deg, options.trials, options.seed, options.family)
            everything += trials
            cell = summary(f"{side_px} px {tilt_deg} deg", trials)
            rows.append(cell)
            faults = missed_bars(cell, side_px < SMALL_PX)
            if cell.stand < ENOUGH:
                faults = []
            missed += [f"{cell.name}: {', '.join(faults)}"] if faults else []
            few = f"only {cell.stand} stand" if cell.stand < ENOUGH else ""
            print_row(
                cell,
                "; ".join(part for part in (few, "MISSED " + ", ".join(faults) if faults else "") if part),
            )
            print_worst(trials, options.worst)
    print("by band, all sizes and tilts")
    for field, edges in BANDS.items():
        for low, high in itertools.pairwise(edges):
            band = [trial for trial in everything if low <= getattr(trial.view, field) < high]
            if band:
                cell = summary(f"{field} {low} to {high}", band)
                rows.append(cell)
                print_row(cell, "")
    print("beside the bars, 40 to 100 px, 0 to 60 degrees")
    for name in HARDER:
        trials = run_harder(name, 2 * options.trials, options.seed)
        rows.append(summary(name, trials))
        print_row(rows[-1], ", ".join(f"{why} {number}" for why, number in rows[-1].reasons.items()))
        print_worst(trials, options.worst)
    reasons = Counter(trial.outcome.reason for trial in everything if not trial.outcome.stands)
    print("not used: " + (", ".join(f"{why} {number}" for why, number in reasons.most_common()) or "none"))
    judged = [cell for cell in rows[: len(options.sides) * len(options.tilts)] if cell.stand >= ENOUGH]
    line = (
        f"corners: RMS {min(c.ratio for c in judged):.2f} to {max(c.ratio for c in judged):.2f} times the bound "
        f"(bars {RATIO_BAR}, {RATIO_BAR_SMALL} under {SMALL_PX} px), worst bias "
        f"{max(c.worst_bias_px for c in judged):.3f} px (bar {BIAS_BAR_PX}), normalised "
        f"{min(c.normalised for c in judged):.2f} to {max(c.normalised for c in judged):.2f} "
        f"(bars {NORMALISED_BARS[0]} to {NORMALISED_BARS[1]})"
        + (f"; MISSED {len(missed)} cells" if missed else "")
    )
    if options.family == "tag36h11" and (options.sides, options.tilts) == (list(SIDES_PX), list(TILTS_DEG)):
        keep_result("corners", rows, line)
    print(line)
    return 1 if missed else 0


def print_worst(trials: list[Trial], number: int) -> None:
    """The trials whose refined corners are furthest off in their own sigma."""
    good = sorted((t for t in trials if t.outcome.stands), key=lambda t: -rms(t.outcome.whitened()))
    for trial in good[:number]:
        v, o = trial.view, trial.outcome
        print(
            f"    seed {trial.seed} norm8 {rms(o.whitened()):.1f} ratio {trial.ratio:.1f} RMS {rms(o.error):.3f} "
            f"start {rms(o.start_uv):.3f} blur {v.blur_px:.2f} noise {v.noise:.1f} JPEG {v.quality} "
            f"contrast {v.white - v.black:.0f} slope {v.slope:.2f} "
            + (f"focal {v.lens[0]:.0f} k1 {v.lens[4]:+.2f}" if v.lens else "")
        )


if __name__ == "__main__":
    sys.exit(main())
