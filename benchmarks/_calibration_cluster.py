"""Clusters of drawn machines, calibrated from rendered logs, and drawn surveys of markers.

A log is what the documented procedure makes: fourteen stops of the swing before nine surveyed boards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks._calibration_bars import AtMost, Row, normalised
from benchmarks._calibration_rigs import drawn, recorded
from pipeline.calibration.cluster import Cluster, calibrate_cluster
from pipeline.calibration.corner_survey import SurveyedMarker, marker_pose
from pipeline.errors import CalibrationError
from pipeline.geometry import se3
from pipeline.synthetic.calibration_sites import CLUSTER
from pipeline.synthetic.excavator import Mounts

FIRST, SURVEYS = 1000, 400
FALSE_ALARMS = 0.01
"""One in a thousand is meant."""
ROTATION_DEG, TRANSLATION_MM = 0.02, 2.0
REFERENCE, OTHER = "bench", "arm"


@dataclass(frozen=True)
class Rig:
    """Errors of one calibrated cluster over their sigmas."""

    mount: np.ndarray
    """(6,) camera against camera."""
    together: float
    """Mean square of the six with their correlations."""
    lenses: np.ndarray
    """(cameras, 9)."""
    markers: np.ndarray
    """(boards, 6)."""
    sigma_deg: float
    sigma_mm: float
    error_deg: float
    error_mm: float


def cluster_of_rig(seed: int) -> Rig:
    """One drawn machine, calibrated."""
    with recorded(CLUSTER, seed) as (site, found):
        cluster = calibrate_cluster(found.machine, found.site, REFERENCE, found.detections)
    truth, pair = site.truth, cluster.pairs[0]
    T = se3.inverse(truth.cameras[pair.first]) @ truth.cameras[pair.second]
    error = se3.local(T, pair.T_first_second)
    lenses = [
        (k - truth.intrinsics[name]) / np.sqrt(np.diagonal(cov))
        for name, (k, cov) in cluster.intrinsics.items()
    ]
    return Rig(
        mount=error / np.sqrt(np.diagonal(pair.covariance)),
        together=float(error @ np.linalg.solve(pair.covariance, error)) / 6,
        lenses=np.array(lenses),
        markers=_markers(cluster, truth),
        sigma_deg=float(np.rad2deg(pair.sigma_rad)),
        sigma_mm=1000 * pair.sigma_m,
        error_deg=float(np.rad2deg(np.linalg.norm(error[3:]))),
        error_mm=1000 * float(np.linalg.norm(error[:3])),
    )


def _markers(cluster: Cluster, truth: Mounts) -> np.ndarray:
    out = []
    for name, T in truth.benchmarks.items():
        static = f"benchmark {name} pose"
        sigma = np.sqrt(np.diagonal(cluster.whole.covariance(static)))
        out.append(se3.local(T, cluster.whole.value(static)) / sigma)
    return np.array(out)


def surveyed_marker(seed: int) -> np.ndarray:
    """(6,) errors over sigma of one marker's pose, from drawn shots of its corners; NaN where they were refused."""
    rng = np.random.default_rng([seed, 607])
    T = se3.exp(np.concatenate([rng.uniform(-50, 50, 3), rng.normal(size=3)]))
    half = rng.uniform(0.1, 0.5, 2)
    p = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * [*half, 0.0]
    p = p[: rng.integers(3, 5)]
    sigma = rng.uniform(0.5e-3, 3e-3)
    q = se3.transform(T, p) + rng.normal(size=p.shape) * sigma
    try:
        found = marker_pose(SurveyedMarker("m", ("a", "b", "c", "d")[: len(p)], p, q, np.full(len(p), sigma)))
    except CalibrationError:
        return np.full(6, np.nan)
    error = se3.local(T, found.T_world_marker)
    return np.asarray(error / np.sqrt(np.diagonal(found.covariance)))


def clusters(draws: int) -> list[Row]:
    """Camera against camera, lenses and markers of drawn machines."""
    rigs = drawn(cluster_of_rig, draws, FIRST)
    mount = np.array([rig.mount for rig in rigs])
    together = np.sqrt(np.mean([rig.together for rig in rigs]))

    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    turned, moved = rms([rig.error_deg for rig in rigs]), rms([rig.error_mm for rig in rigs])
    return [
        normalised("camera to camera", mount, note=f"with correlations {together:.2f}"),
        normalised("lenses of a cluster", np.array([rig.lenses for rig in rigs])),
        normalised("markers of a cluster", np.array([rig.markers for rig in rigs])),
        AtMost(
            "camera to camera, largest sigma of rotation",
            draws,
            max(rig.sigma_deg for rig in rigs),
            ROTATION_DEG,
            "deg",
            f"errors in space {turned:.4f} deg RMS",
        ),
        AtMost(
            "camera to camera, largest sigma of translation",
            draws,
            max(rig.sigma_mm for rig in rigs),
            TRANSLATION_MM,
            "mm",
            f"errors in space {moved:.2f} mm RMS",
        ),
    ]


def surveys(draws: int) -> list[Row]:
    """Markers from surveyed corners: numbers only, so there are many."""
    z = np.array([surveyed_marker(seed) for seed in range(max(draws, SURVEYS))])
    refused = int(np.sum(np.isnan(z[:, 0])))
    return [
        normalised("surveyed marker", z),
        AtMost("surveys without a fault that are refused", len(z), refused / len(z), FALSE_ALARMS, ""),
    ]
