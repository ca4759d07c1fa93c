"""Whether corners of half-covered tags are ever believed that should not be: `make bench-occlusion`.

Ten thousand tags of 25 to 120 px, tilted up to 60 degrees, 5 to 40 % of each under a half-plane, a disc, a strip or a
blob of any grey or texture, the print's own white and black among them. Each is refined twice: from what the search
found (if its decoding is one that `judge` lets pass), and from where its cells fit best around a prediction 2 % of
its side off, as when a known tag is followed that the decoder lost. Bar: no corner that stands is more than 5 of
its own sigmas off.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from benchmarks._draws import LOST, Outcome, draw_view, follow, refine, rms
from benchmarks._results import keep_result
from benchmarks._tag_picture import Shot, View, shoot
from pipeline.config.site import DetectionSettings
from pipeline.detection.apriltag import TagFinder

BAR_SIGMAS = 5.0
SIDES_PX, TILTS_DEG, SHARES = (25, 120), (0, 60), (0.05, 0.40)
BANDS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40)
OFF, OFF_EACH = 0.02, 0.01
"""Standard deviations of a prediction's common shift, and of each corner besides, in sides; half a cell is 0.06."""
STEPS = (1, 2, 3, 4, 5, 7, 10, 20)
STARTS = ("found", "predicted")


@dataclass(frozen=True)
class Draw:
    """One covered tag."""

    seed: int
    view: View
    outcomes: dict[str, Outcome]

    def furthest(self, start: str) -> float:
        """Largest Mahalanobis distance of a corner, nan where none stands."""
        outcome = self.outcomes[start]
        return float(outcome.corner_distances().max()) if outcome.stands else float("nan")


@dataclass(frozen=True)
class Row:
    """Tags of one band of covered shares and one way to start."""

    start: str
    covered: tuple[float, float]
    draws: int
    tried: int
    """That there was a start for."""
    stand: int
    normalised: float
    """RMS of corner errors over their own sigma."""
    rms_px: float
    furthest: float
    over: int
    """Tags with a corner over the bar."""


_settings = DetectionSettings()
_finder: TagFinder | None = None


def _begin() -> None:
    global _finder
    cv2.setNumThreads(1)
    _finder = TagFinder(["tag36h11"], _settings)


def draw(seed: int, number: int) -> Draw:
    """One tag, covered, searched and refined."""
    assert _finder is not None
    rng = np.random.default_rng([seed, number])
    view = replace(
        draw_view(rng, rng.uniform(*SIDES_PX), rng.uniform(*TILTS_DEG)),
        covered=rng.uniform(*SHARES),
        blur_px=rng.uniform(0.5, 1.0),
    )
    shot = shoot(view, rng, fine=4)
    narrow_px = view.side_px * np.cos(np.deg2rad(view.tilt_deg))
    predicted = shot.uv + narrow_px * (rng.normal(0, OFF, 2) + rng.normal(0, OFF_EACH, (4, 2)))
    predicted = follow(view, shot, predicted, 4 * OFF * narrow_px)
    return Draw(
        number,
        view,
        {
            "found": refine(view, shot, _believed(view, shot, _finder, _settings)),
            "predicted": refine(view, shot, predicted),
        },
    )


def _believed(view: View, shot: Shot, finder: TagFinder, settings: DetectionSettings) -> np.ndarray | None:
    """(4, 2) corners of the tag where its decoding is good enough to be believed."""
    found = finder.find(shot.grey)
    mine = np.flatnonzero(
        (found.tag_id == view.tag_id)
        & (found.hamming <= settings.max_hamming)
        & (found.margin >= settings.min_margin)
    )
    return found.uv[mine[0]] if len(mine) == 1 else None


def summary(start: str, covered: tuple[float, float], draws: list[Draw]) -> Row:
    """What some draws amount to."""
    good = [each.outcomes[start] for each in draws if each.outcomes[start].stands]
    furthest = np.array([outcome.corner_distances().max() for outcome in good])
    return Row(
        start,
        covered,
        len(draws),
        sum(each.outcomes[start].reason != LOST.reason for each in draws),
        len(good),
        normalised=rms([outcome.corners_whitened() for outcome in good]),
        rms_px=rms([outcome.error for outcome in good]),
        furthest=float(furthest.max()) if len(furthest) else float("nan"),
        over=int(np.sum(furthest > BAR_SIGMAS)),
    )


def main() -> int:
    """Print the tables and the verdict; 1 if a corner that stands is over the bar."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=17)
    parser.add_argument(
        "--worst", type=int, default=10, help="how many of the worst draws to list (default 10)"
    )
    options = parser.parse_args()
    started = time.monotonic()
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), _begin) as pool:
        numbers = range(options.trials)
        draws = list(pool.map(draw, itertools.repeat(options.seed), numbers, chunksize=50))
    rows = []
    print(
        "start      covered      draws  tried  stand   share   RMS px   normalised   furthest   over 5 sigma"
    )
    for start in STARTS:
        bands = [*itertools.pairwise(BANDS), SHARES]
        for low, high in bands:
            row = summary(start, (low, high), [each for each in draws if low <= each.view.covered < high])
            rows.append(row)
            if row.draws:
                print(
                    f"{start:10} {100 * low:3.0f} to {100 * high:2.0f} % {row.draws:7d} {row.tried:6d} {row.stand:6d} "
                    f"{row.stand / row.draws:7.3f} {row.rms_px:8.3f} {row.normalised:12.2f} {row.furthest:10.1f} "
                    f"{row.over:14d}"
                )
    for start in STARTS:
        furthest = np.array([each.furthest(start) for each in draws if each.outcomes[start].stands])
        if len(furthest):
            print(
                f"{start}: largest of a tag's corners, share of tags over "
                + ", ".join(f"{step} sigma {np.mean(furthest > step):.5f}" for step in STEPS)
            )
        reasons = Counter(each.outcomes[start].reason for each in draws if not each.outcomes[start].stands)
        print(f"{start}: not used: " + ", ".join(f"{why} {number}" for why, number in reasons.most_common()))
        worst = sorted(
            (each for each in draws if each.outcomes[start].stands), key=lambda each: -each.furthest(start)
        )
        for each in worst[: options.worst]:
            outcome = each.outcomes[start]
            print(
                f"    draw {each.seed}: {each.furthest(start):.1f} sigma, {np.abs(outcome.error).max():.2f} px; side "
                f"{each.view.side_px:.0f} px, tilt {each.view.tilt_deg:.0f}, covered {each.view.covered:.2f}, contrast "
                f"{each.view.white - each.view.black:.0f}, noise {each.view.noise:.1f}"
            )
    totals = {row.start: row for row in rows if row.covered == SHARES}
    line = f"occlusion: of {options.trials} tags covered by 5 to 40 % " + "; ".join(
        f"{start} {row.stand} stand, {row.over} with a corner over {BAR_SIGMAS:.0f} sigma (furthest {row.furthest:.1f})"
        for start, row in totals.items()
    )
    keep_result("occlusion", rows, line)
    print(f"{line}; {time.monotonic() - started:.0f} s")
    return int(any(row.over for row in totals.values()))


if __name__ == "__main__":
    sys.exit(main())
