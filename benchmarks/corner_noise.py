"""The error of detected corners and the sigma they leave with: `make bench-corner-noise`.

Tags of known place are rendered in many sizes, tilts and blurs (`_tag_picture`, which shares nothing with
detection or with the synthetic site), found, and compared. The bar: errors divided by the covariance that
`pipeline.detection.noise` states have an RMS between 0.8 and 1.25 in every cell of the grid.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import numpy as np

from benchmarks._results import keep_result
from benchmarks._tag_picture import View, picture
from pipeline.detection.apriltag import TagFinder

SIDES_PX = (16, 20, 25, 30, 40, 60, 80, 120, 160)
TILTS_DEG = (0, 45, 60)
BARS = (0.80, 1.25)
ENOUGH = 0.75
"""Part of the tags of a cell that must be found for it to be judged: of fewer, only the lucky ones are seen."""
IDS = {"tag36h11": 587, "tag25h9": 35, "tag16h5": 30, "tagStandard41h12": 2115}


@dataclass(frozen=True)
class Cell:
    """One size and tilt."""

    family: str
    side_px: float
    tilt_deg: float
    trials: int
    found: int
    rms_px: float
    """Per axis."""
    outward_px: float
    """Mean error away from the tag's centre."""
    sigma_px: float
    """RMS of the stated standard deviation, per axis."""
    normalised: float
    """RMS of the whitened errors."""


def measure(family: str, side_px: float, tilt_deg: float, trials: int, seed: int) -> Cell:
    """Corner errors of random views of one size and tilt: blur 0.5 to 0.8 px, noise 1 to 3, JPEG 75 to 90."""
    rng = np.random.default_rng([seed, int(side_px), int(tilt_deg)])
    finder = TagFinder([family])
    errors, covariances, outward = [], [], []
    for _ in range(trials):
        offset = rng.uniform(-0.5, 0.5, 2) + rng.integers(0, 8, 2)
        view = View(
            family,
            int(rng.integers(IDS[family])),
            side_px,
            tilt_deg,
            axis_deg=rng.uniform(0, 360),
            roll_deg=rng.uniform(0, 360),
            centre=(float(offset[0]), float(offset[1])),
            blur_px=rng.uniform(0.5, 0.8),
            noise=rng.uniform(1, 3),
            quality=int(rng.integers(75, 91)),
            black=rng.uniform(25, 60),
            white=rng.uniform(150, 220),
        )
        grey, uv = picture(view, rng, fine=6 if side_px < 100 else 4)
        found = finder.find(grey)
        mine = np.flatnonzero(found.tag_id == view.tag_id)
        if len(mine) != 1:
            continue
        error = found.uv[mine[0]] - uv
        away = uv - uv.mean(axis=0)
        outward.append(np.sum(error * away, axis=1) / np.linalg.norm(away, axis=1))
        errors.append(error)
        covariances.append(found.cov[mine[0]])
    if not errors:
        return Cell(family, side_px, tilt_deg, trials, 0, np.nan, np.nan, np.nan, np.nan)
    error, cov = np.array(errors), np.array(covariances)
    white = np.linalg.solve(np.linalg.cholesky(cov), error[..., None])
    return Cell(
        family,
        side_px,
        tilt_deg,
        trials,
        len(errors),
        rms_px=float(np.sqrt(np.mean(error**2))),
        outward_px=float(np.mean(outward)),
        sigma_px=float(np.sqrt(np.mean(np.trace(cov, axis1=-2, axis2=-1)) / 2)),
        normalised=float(np.sqrt(np.mean(white**2))),
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=120, help="views per cell (default 120)")
    parser.add_argument("--family", default="tag36h11", choices=sorted(IDS))
    parser.add_argument("--seed", type=int, default=11)
    options = parser.parse_args()
    print(f"{options.family}, {options.trials} views per cell; px")
    print("side  tilt  found    RMS   outward   sigma   normalised")
    cells = []
    for side_px in SIDES_PX:
        for tilt_deg in TILTS_DEG:
            cell = measure(options.family, side_px, tilt_deg, options.trials, options.seed)
            cells.append(cell)
            few = "" if cell.found >= ENOUGH * cell.trials else "   (too few)"
            print(
                f"{side_px:4d}  {tilt_deg:4d}  {cell.found / cell.trials:5.2f}  {cell.rms_px:5.3f}   "
                f"{cell.outward_px:+6.3f}   {cell.sigma_px:5.3f}   {cell.normalised:5.2f}{few}"
            )
    judged = [cell for cell in cells if cell.found >= ENOUGH * cell.trials]
    low, high = min(cell.normalised for cell in judged), max(cell.normalised for cell in judged)
    facing = {cell.side_px: cell for cell in judged if cell.tilt_deg == 0}
    line = (
        f"corner-noise: normalised errors {low:.2f} to {high:.2f} (bars {BARS[0]} to {BARS[1]}); RMS facing "
        + ", ".join(f"{side} px {facing[side].rms_px:.3f}" for side in (20, 40, 80, 160))
    )
    if options.family == "tag36h11":
        keep_result("corner-noise", cells, line)
    print(line)
    return 0 if BARS[0] <= low and high <= BARS[1] else 1


if __name__ == "__main__":
    sys.exit(main())
