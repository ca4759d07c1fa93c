"""The main job against the truth: `make bench-main-job`.

Runs `gradetrace report` as a user would, on the committed sample and on drawn 1280x960 logs of three
minutes, and compares the published cutting edge and stations with the truth that lies beside
each log. Only this file and tests read that truth.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from benchmarks._results import keep_result
from pipeline.tables import read_table

SAMPLE = Path("sample_logs/trench/trench.mcap")
SEEDS = (1, 2, 3, 4, 5)

RMSE_BAR_M = {"sample": 0.015, "drawn": 0.010}
SIGMA_RATIO_BAR = 3.0
COVERAGE_BAR = (0.90, 0.99)
STATION_BAR_M = 0.0254


@dataclass(frozen=True)
class Score:
    """One log against its truth."""

    name: str
    epochs: int
    """Digging epochs with the edge's middle observed."""
    rmse_m: float
    """Of the vertical of the middle of the cutting edge."""
    median_sigma_m: float
    covered: int
    """Epochs whose 95 % interval holds the truth."""
    worst_station_m: float
    station_errors_m: tuple[float, ...]
    verdict: str
    seconds: float


def score(log: Path, runs: Path) -> Score:
    """Run the main job on one log and hold what came out against the truth beside the log."""
    start = time.monotonic()
    subprocess.run(
        [sys.executable, "-m", "pipeline", "report", str(log), "--runs", str(runs)],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return score_of(log, runs / log.stem, time.monotonic() - start)


def score_of(log: Path, run: Path, seconds: float = float("nan")) -> Score:
    """What a run of a log came to, held against the truth beside the log."""
    edge = read_table(run / "cutting_edge.parquet", "cutting_edge")
    truth = pq.read_table(log.parent / "truth" / "cutting_edge.parquet").to_pandas()
    truth = truth[truth["point"] == "middle"].sort_values("time_ns")

    middle = (edge["point"] == "middle") & edge["seen"]
    time_ns, height, sigma = edge["time_ns"][middle], edge["h"][middle], np.sqrt(edge["cov_h_h"][middle])
    digging = _phase_at(truth, time_ns) == "dig"
    reference_ns = time_ns[0]
    true_height = np.interp(
        time_ns - reference_ns, truth["time_ns"].to_numpy() - reference_ns, truth["h"].to_numpy()
    )
    error = (height - true_height)[digging]
    sigma = sigma[digging]
    stations = read_table(run / "stations.parquet", "stations")
    true_stations = pq.read_table(log.parent / "truth" / "stations.parquet").to_pandas()
    station_errors = _station_errors(stations, true_stations)
    verdict = json.loads((run / "survey.json").read_text())["verdict"]
    return Score(
        name=log.stem if log == SAMPLE else log.parent.name,
        epochs=len(error),
        rmse_m=float(np.sqrt(np.mean(error**2))),
        median_sigma_m=float(np.median(sigma)),
        covered=int(np.sum(np.abs(error) < 1.96 * sigma)),
        worst_station_m=float(np.max(np.abs(station_errors))),
        station_errors_m=tuple(station_errors),
        verdict=verdict,
        seconds=seconds,
    )


def _phase_at(truth, time_ns: np.ndarray) -> np.ndarray:
    """Phase of the work at each time: that of the nearest earlier sample of the truth."""
    index = np.clip(
        np.searchsorted(truth["time_ns"].to_numpy(), time_ns, side="right") - 1, 0, len(truth) - 1
    )
    return truth["phase"].to_numpy().astype(str)[index]


def _station_errors(stations: dict, truth) -> np.ndarray:
    """As-built floor of each station that was judged, minus the true floor there, metres."""
    judged = np.isfinite(stations["h"]) & (stations["verdict"] != "NOT REACHED")
    true_floor = dict(zip(np.round(truth["station"], 4), truth["h"], strict=True))
    # A station that the truth does not have is a fault of one of the two, not a station to leave out.
    errors = [
        h - true_floor[round(s, 4)]
        for s, h in zip(stations["station"][judged], stations["h"][judged], strict=True)
    ]
    assert np.isfinite(errors).all(), "a station was judged where the truth has no floor"
    return np.array(errors)


def draw(seed: int, folder: Path) -> Path:
    """A drawn 1280x960 log of three minutes."""
    from pipeline.synthetic import command

    kept = sorted((folder / f"seed{seed}").glob("*.mcap"))  # the same seed gives the same bytes
    return (
        kept[0]
        if kept
        else command.make(folder / f"seed{seed}", "trench", minutes=3.0, size="1280", seed=seed)
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=list(SEEDS), help="seeds of the drawn logs")
    parser.add_argument("--keep", type=Path, help="folder where drawn logs and runs stay")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        scores = [score(SAMPLE, folder / "runs")]
        for seed in options.seeds:
            scores.append(score(draw(seed, folder), folder / f"seed{seed}" / "runs"))
    print(
        f"{'log':<10}{'epochs':>7}{'RMSE mm':>9}{'sigma mm':>10}{'ratio':>7}"
        f"{'95 % holds':>12}{'worst station mm':>18}{'verdict':>13}{'s':>7}"
    )
    for row in scores:
        print(
            f"{row.name:<10}{row.epochs:>7}{1e3 * row.rmse_m:>9.1f}{1e3 * row.median_sigma_m:>10.1f}"
            f"{row.rmse_m / row.median_sigma_m:>7.2f}{row.covered / row.epochs:>12.1%}"
            f"{1e3 * row.worst_station_m:>18.1f}{row.verdict:>13}{row.seconds:>7.1f}"
        )
    sample, drawn = scores[0], scores[1:]
    coverage = sum(row.covered for row in scores) / sum(row.epochs for row in scores)
    worst_drawn = max((row.rmse_m for row in drawn), default=0.0)
    worst_station = max((row.worst_station_m for row in drawn), default=0.0)
    worst_ratio = max(row.rmse_m / row.median_sigma_m for row in scores)
    met = (
        sample.rmse_m <= RMSE_BAR_M["sample"]
        and worst_drawn <= RMSE_BAR_M["drawn"]
        and worst_ratio <= SIGMA_RATIO_BAR
        and COVERAGE_BAR[0] <= coverage <= COVERAGE_BAR[1]
        and worst_station <= STATION_BAR_M
    )
    line = (
        f"main-job: sample RMSE {1e3 * sample.rmse_m:.1f} mm (15), drawn {1e3 * worst_drawn:.1f} mm (10), "
        f"RMSE/sigma {worst_ratio:.2f} (3), coverage {coverage:.1%} (90 to 99 %), "
        f"worst station {1e3 * worst_station:.1f} mm (25.4)"
    )
    keep_result("main-job", scores, line)
    print(line)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
