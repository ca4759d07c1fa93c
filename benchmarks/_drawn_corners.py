"""Corners of long logs straight from the geometry, no pictures: what the benchmarks of the adjustment draw alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pipeline.geometry import camera as camera_model
from pipeline.geometry import se3
from pipeline.network import Network, Observations
from tests.estimation.simulator import T0_NS

FRAME_S, SIGMA_PX = 0.1, 0.2
CYCLE_S = 18.0
BLIND_S = 4.0


def true_statics(rng, network: Network) -> dict[str, Any]:
    """By name, off the files' values by draws from their priors."""
    truth = {}
    for s in network.statics:
        error = s.scale @ rng.standard_normal(s.scale.shape[1])
        truth[s.name] = s.value @ se3.exp(error) if s.is_pose else s.value + error
    return truth


def blind(rng, epochs: int, share: float) -> np.ndarray:
    """(epochs,) bool: gaps of up to ``BLIND_S`` that fill about this share; never the first second."""
    out = np.zeros(epochs, dtype=bool)
    for start in rng.integers(10, max(epochs, 11), round(share * epochs * FRAME_S / (0.5 * BLIND_S))):
        out[start : start + rng.integers(1, round(BLIND_S / FRAME_S))] = True
    return out


def noisy_corners(
    rng,
    network: Network,
    truth: dict[str, Any],
    T_world: dict[str, np.ndarray],
    hidden: Callable[[int, int], np.ndarray | None],
) -> Observations:
    """Every tag that is inside a picture, at 10 Hz.

    Parameters
    ----------
    rng : numpy.random.Generator
        Of the noise.
    network : Network
        With the nominal values.
    truth : dict
        Of ``true_statics``.
    T_world : dict of str to (epochs, 4, 4) arrays
        Bodies, the world among them.
    hidden : function
        Of a camera and a marker, their indices: (epochs,) bool where it does not see it; None where it never does.
    """
    parts = []
    for c, camera in enumerate(network.cameras):
        T_camera_world = se3.inverse(T_world[camera.body] @ truth[f"camera {camera.name} mount"])
        size = np.array([camera.width, camera.height])
        for k, m in enumerate(network.tag_marker):
            marker, unseen = network.markers[m], hidden(c, m)
            if unseen is None:
                continue
            name = f"benchmark {marker.name} pose" if marker.benchmark else f"marker {marker.name} mount"
            T = T_camera_world @ T_world[marker.body] @ truth[name]
            p = se3.transform(T[:, None], network.tag_corners[k])
            uv = camera_model.project(p, truth[f"camera {camera.name} intrinsics"])
            inside = np.all((uv > 5) & (uv < size - 5), axis=(1, 2)) & (p[..., 2].min(axis=1) > 0.5)
            rows = np.flatnonzero(inside & ~unseen)
            parts.append((np.full(len(rows), c), np.full(len(rows), k), rows, uv[rows]))
    camera_index, tag, frame, uv = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort([tag, camera_index, frame])
    uv = uv[order] + SIGMA_PX * rng.standard_normal(uv.shape)
    cov = np.broadcast_to(SIGMA_PX**2 * np.eye(2), (len(order), 4, 2, 2)).copy()
    time_ns = T0_NS + frame[order] * round(FRAME_S * 1e9)
    return Observations(camera_index[order], tag[order], time_ns, uv, cov)
