"""Trenches dug by a drawn operator: the cutting edge as it was, and as a survey with drawn errors has it.

No pixel is drawn: the errors of the edge are, with the covariance that the tracks state. The own part wanders over
time as an adjusted path does, the common part is one vector for the whole log.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.surface.alignment import Alignment, polyline
from pipeline.surface.design import ProfileDesign
from pipeline.tracks.poses import CuttingEdge

HZ = 20.0
DRAG_S, SWING_S = 3.0, 2.0
T0 = 1_750_000_000_000_000_000
CORNER = np.array([512_345.0, 4_123_456.0])


@dataclass(frozen=True)
class DrawnTrench:
    """One job."""

    alignment: Alignment
    design: ProfileDesign
    ground_h: float
    truth: CuttingEdge
    """Without errors; its covariances are next to nothing."""
    measured: CuttingEdge


def draw_trench(rng: np.random.Generator, length_m: float = 12.0, deviation_m: float = 0.012) -> DrawnTrench:
    """A trench with a bend, dug from its far end in cycles that retreat.

    Parameters
    ----------
    rng : Generator
        Everything is drawn from it.
    length_m : float
        Of the trench.
    deviation_m : float
        Standard deviation of how far the operator leaves the floor from its design.
    """
    bearing = rng.uniform(0, 2 * np.pi)
    first = np.array([np.sin(bearing), np.cos(bearing)])
    turned = bearing + rng.uniform(-0.2, 0.2)
    second = np.array([np.sin(turned), np.cos(turned)])
    half = 0.5 * length_m
    points = CORNER + np.array([[0.0, 0.0], half * first, half * first + half * second])
    alignment = polyline(points, start_station_m=float(rng.integers(0, 20)) * 10.0)
    start = alignment.start_station
    width = float(rng.choice([0.8, 1.0, 1.2]))
    both = np.ones(2)
    design = ProfileDesign(
        "drawn",
        np.array([start, start + length_m]),
        np.array([50.0, 50.0 + rng.uniform(-0.02, 0.02) * length_m]),
        width * both,
        float(rng.choice([0.0, 0.5])) * both,
    )
    station, offset, height = _dig(rng, alignment, design, length_m, deviation_m)
    truth = _edge(alignment, station, offset, height, width, np.zeros((len(station), 3)), 1e-6, 1e-7)
    own, common = rng.uniform(0.002, 0.006), rng.uniform(0.001, 0.005)
    errors = _wander(rng, len(station), own) + common * rng.normal(size=3)
    measured = _edge(alignment, station, offset, height, width, errors, own, common)
    return DrawnTrench(alignment, design, 50.0 + rng.uniform(1.2, 2.0), truth, measured)


def _dig(rng, alignment: Alignment, design: ProfileDesign, length_m: float, deviation_m: float):
    """Station, offset and height of the edge's middle at each epoch."""
    start = alignment.start_station
    knots = np.arange(start - 2.0, start + length_m + 2.0, 0.1)
    rough = rng.normal(size=len(knots))
    smooth = np.convolve(rough, np.exp(-0.5 * (np.arange(-20, 21) / 8.0) ** 2), mode="same")
    wanted = deviation_m * smooth / smooth.std() + rng.normal(0, 0.5 * deviation_m)
    drag, swing = round(DRAG_S * HZ), round(SWING_S * HZ)
    station, offset, height = [], [], []
    reach = 3.0
    for far in np.arange(start + length_m - 0.5, start + reach - 0.5, -0.6):
        # Lifts first, then cleaning passes that come near the floor that stays.
        for above in (0.45, 0.2, *np.abs(rng.normal(0, 0.012, 3))):
            u = np.linspace(0.0, 1.0, drag)
            s = far + 0.3 - reach * u + rng.normal(0, 0.05)
            dive = 0.5 * np.maximum(0.0, 1 - u / 0.12) ** 2 + 0.6 * np.maximum(0.0, (u - 0.88) / 0.12) ** 2
            floor = design.floor_level(np.clip(s, start, start + length_m)) + np.interp(s, knots, wanted)
            h = floor + above + dive
            o = np.full(drag, rng.normal(0, 0.012))
            station += [s, np.linspace(s[-1], far + 0.3, swing)]
            offset += [o, np.full(swing, 0.0)]
            height += [h, np.full(swing, float(floor.max()) + 3.0)]
    return np.concatenate(station), np.concatenate(offset), np.concatenate(height)


def _wander(rng, n: int, sigma: float, seconds: float = 0.7) -> np.ndarray:
    """(n, 3) errors along, across and up that forget themselves within `seconds`."""
    from scipy.signal import lfilter

    keep = np.exp(-1 / (HZ * seconds))
    noise = rng.normal(size=(n, 3)) * np.sqrt(1 - keep**2)
    noise[0] = rng.normal(size=3)
    return sigma * lfilter([1.0], [1.0, -keep], noise, axis=0)


def _edge(alignment, station, offset, height, width, errors, own, common) -> CuttingEdge:
    """The edge across the alignment, moved by errors (n, 3) along, across, up."""
    n = len(station)
    p = np.empty((n, 3, 3))
    for i, x in enumerate((-0.5 * width, 0.0, 0.5 * width)):
        p[:, i, :2] = alignment.points(station + errors[:, 0], offset + errors[:, 1] + x)
        p[:, i, 2] = height + errors[:, 2]
    cov, shared = np.zeros((n, 3, 6)), np.zeros((n, 3, 6))
    cov[..., [0, 3, 5]], shared[..., [0, 3, 5]] = own**2 + common**2, common**2
    time_ns = T0 + np.round(np.arange(n) / HZ * 1e9).astype(np.int64)
    return CuttingEdge(time_ns, p, np.ones(n, bool), cov, shared)
