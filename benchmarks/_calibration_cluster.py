"""Clusters, axes and surveys of drawn rigs against their truth; `make bench-calibration` runs it with the others.

Per rig a log is rendered (one picture a stop and camera), searched, and calibrated as the command does it, with the
survey, the lenses and the mounts drawn from the sigmas that the files state. Bars: errors over sigma 0.85 to 1.15 RMS,
92 to 98 % of them within 1.96; camera against camera 0.02 deg and 2 mm at one sigma. Axes and surveys are drawn as
numbers, as many times.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks._results import keep_result
from pipeline.calibration.axes import TOLD, axis_of_motion
from pipeline.calibration.cluster import calibrate_cluster
from pipeline.calibration.corner_survey import SurveyedMarker, marker_pose
from pipeline.geometry import se3, so3
from pipeline.stages.calibration_log import searched
from pipeline.synthetic import calibration_log, calibration_sites

DRAWS = 60
RMS_BAR, COVERED_BAR = (0.85, 1.15), (0.92, 0.98)
ROTATION_DEG_BAR, TRANSLATION_MM_BAR = 0.02, 2.0
REFERENCE, OTHER = "bench", "arm"
SPARSE_HZ = 1 / (calibration_sites.REST_S + calibration_sites.TURN_S)


class Quiet:
    """Nobody watches."""

    @contextmanager
    def stage(self, stage, why):
        yield self

    def done(self, stage, manifest, ran):
        pass

    def total(self, amount, unit=""):
        pass

    def advance(self, amount=1):
        pass

    def warn(self, sentence):
        pass


def cluster_row(seed: int) -> dict:
    """One drawn rig: errors of everything that is told, over their sigmas."""
    with tempfile.TemporaryDirectory() as folder:
        site = calibration_sites.calibration_site(calibration_sites.CLUSTER, seed)
        site = replace(site, spec=replace(site.spec, rate_hz=SPARSE_HZ))
        log = calibration_log.record_site(site, calibration_sites.CLUSTER, Path(folder), jobs=1)
        with searched(log, None, None, Path(folder) / "runs", 1, Quiet()) as found:
            cluster = calibrate_cluster(found.machine, found.site, REFERENCE, found.detections)
    truth = site.truth
    T = se3.inverse(truth.cameras[REFERENCE]) @ truth.cameras[OTHER]
    pair = cluster.pairs[0]
    if pair.first != REFERENCE:
        T = se3.inverse(T)
    error = se3.local(pair.T_first_second, T)
    lenses = []
    for name, (lens, covariance) in cluster.intrinsics.items():
        sigma = np.sqrt(np.diagonal(covariance))[:8]
        lenses += ((lens - truth.intrinsics[name])[:8] / sigma).tolist()
    places = []
    for name, T_true in truth.benchmarks.items():
        static = f"benchmark {name} pose"
        if np.any(cluster.whole.network.markers[_marker(cluster, name)].benchmark):
            sigma = np.sqrt(np.diagonal(cluster.whole.covariance(static)))
            places += (se3.local(cluster.whole.value(static), T_true) / sigma).tolist()
    return {
        "seed": seed,
        "mount": (error / np.sqrt(np.diagonal(pair.covariance))).tolist(),
        "nees": float(error @ np.linalg.solve(pair.covariance, error)),
        "lens": lenses,
        "marker": places,
        "sigma_deg": float(np.rad2deg(pair.sigma_rad)),
        "sigma_mm": 1000 * pair.sigma_m,
        "error_deg": float(np.rad2deg(np.linalg.norm(error[3:]))),
        "error_mm": 1000 * float(np.linalg.norm(error[:3])),
        "sigma0": cluster.whole.sigma0,
    }


def _marker(cluster, name: str) -> int:
    return [m.name for m in cluster.whole.network.markers].index(name)


def axis_errors(rng: np.random.Generator) -> np.ndarray:
    """(4,) errors over sigma of one axis, from drawn poses of a marker that turns about it."""
    A, M = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6) * 0.6)
    n = int(rng.integers(8, 40))
    angle = rng.uniform(-0.9, 0.9, n)
    sigma = np.repeat([rng.uniform(1e-3, 4e-3), rng.uniform(1e-3, 6e-3)], 3)
    Z = se3.from_rotation_translation(so3.exp(angle[:, None] * np.array([0.0, 0.0, 1.0])), np.zeros(3))
    T = A @ Z @ M @ se3.exp(rng.normal(size=(n, 6)) * sigma)
    said = se3.retract(A, rng.normal(size=6) * [0.02, 0.02, 0.0, 0.03, 0.03, 0.0])
    found = axis_of_motion(T, np.tile(np.diag(sigma**2), (n, 1, 1)), said, "joint")
    error = se3.local(found.T_parent_axis, A)[list(TOLD)]
    return np.asarray(error / np.sqrt(np.diagonal(found.covariance)))


def survey_errors(rng: np.random.Generator) -> np.ndarray:
    """(6,) errors over sigma of one marker's pose, from drawn shots of its corners."""
    T = se3.exp(np.concatenate([rng.uniform(-50, 50, 3), rng.normal(size=3)]))
    half = rng.uniform(0.1, 0.5, 2)
    p = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * [*half, 0.0]
    p = p[: rng.integers(3, 5)]
    sigma = rng.uniform(0.5e-3, 3e-3)
    q = se3.transform(T, p) + rng.normal(size=p.shape) * sigma
    found = marker_pose(SurveyedMarker("m", ("a", "b", "c", "d")[: len(p)], p, q, np.full(len(p), sigma)))
    error = se3.local(found.T_world_marker, T)
    return np.asarray(error / np.sqrt(np.diagonal(found.covariance)))


def run(draws: int) -> list[dict]:
    """Rows: one per quantity, with its figures and whether they are at their bars."""
    with multiprocessing.get_context("spawn").Pool(min(os.cpu_count() or 1, draws)) as pool:
        rigs = list(pool.imap(cluster_row, range(1000, 1000 + draws)))
    rng = np.random.default_rng(7)
    normalised = {
        "camera to camera": np.array([rig["mount"] for rig in rigs]),
        "lenses of a cluster": np.array([rig["lens"] for rig in rigs]),
        "markers of a cluster": np.array([rig["marker"] for rig in rigs]),
        "axis of a joint": np.array([axis_errors(rng) for _ in range(max(draws, 200))]),
        "surveyed marker": np.array([survey_errors(rng) for _ in range(max(draws, 200))]),
    }
    rows = []
    for name, z in normalised.items():
        z = z[np.isfinite(z)]
        rms, covered = float(np.sqrt(np.mean(z**2))), float(np.mean(np.abs(z) <= 1.96))
        good = RMS_BAR[0] <= rms <= RMS_BAR[1] and COVERED_BAR[0] <= covered <= COVERED_BAR[1]
        rows.append({"quantity": name, "draws": draws, "rms": rms, "covered": covered, "good": good})
    for name, key, bar in (
        ("rotation, sigma deg", "sigma_deg", ROTATION_DEG_BAR),
        ("translation, sigma mm", "sigma_mm", TRANSLATION_MM_BAR),
    ):
        values = np.array([rig[key] for rig in rigs])
        rows.append(
            {"quantity": name, "draws": draws, "median": float(np.median(values)), "worst": float(values.max()),
             "good": bool(values.max() <= bar)}
        )  # fmt: skip
    return rows


def main() -> int:
    """Run, print the rows, keep the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=DRAWS)
    draws = parser.parse_args().draws
    rows = run(draws)
    for row in rows:
        figures = ", ".join(f"{k} {v:.3f}" for k, v in row.items() if isinstance(v, float))
        print(f"{row['quantity']}: {figures}{'' if row['good'] else '  MISSED'}")
    missed = [row["quantity"] for row in rows if not row["good"]]
    line = f"clusters: {draws} drawn rigs; " + (
        "all at their bars" if not missed else f"missed: {', '.join(missed)}"
    )
    keep_result("calibration_cluster", rows, line)
    print(line)
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
