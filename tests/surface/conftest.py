"""A straight trench far from the origin, and edges that sweep it in known ways."""

from dataclasses import dataclass

import numpy as np
import pytest

from pipeline.surface.alignment import Alignment, polyline
from pipeline.surface.design import ProfileDesign
from pipeline.tracks.poses import CuttingEdge

START = np.array([512_345.0, 4_123_456.0])
DIRECTION = np.array([0.6, 0.8])
T0 = 1_750_000_000_000_000_000


@dataclass(frozen=True)
class Trench:
    alignment: Alignment
    design: ProfileDesign

    def edge(
        self, time_s, station, offset, h, width=1.0, sigma=0.0, common=0.0, seen=None, noise=None
    ) -> CuttingEdge:
        """An edge across the alignment with its middle at station, offset, h; vertical sigmas in metres."""
        time_s, station, offset, h = np.broadcast_arrays(time_s, station, offset, h)
        n = len(time_s)
        points = [
            np.column_stack([self.alignment.points(station, offset + x), h if noise is None else h + noise])
            for x in (-0.5 * width, 0.0, 0.5 * width)
        ]
        shared, cov = np.zeros((n, 3, 6)), np.zeros((n, 3, 6))
        shared[..., 5] = common**2
        cov[..., 5] = common**2 + sigma**2
        return CuttingEdge(
            time_ns=T0 + np.round(np.asarray(time_s) * 1e9).astype(np.int64),
            p_grid=np.stack(points, axis=1),
            seen=np.ones(n, bool) if seen is None else seen,
            cov=cov,
            common=shared,
        )

    def passes(
        self, heights, start=2.0, end=8.0, seconds=3.0, hz=20.0, sigma=0.0, common=0.0, noise=None, **more
    ):
        """Level passes along the trench, one after the other, four seconds apart, lifted out of it in between."""
        count = round(seconds * hz)
        t, station, h, e = [], [], [], []
        for k, height in enumerate(heights):
            t.append(k * (seconds + 4) + np.arange(count) / hz)
            station.append(np.linspace(start, end, count))
            h.append(np.full(count, height))
            e.append(np.full(count, 0.0 if noise is None else noise[k]))
        return self.edge(
            np.concatenate(t), np.concatenate(station), 0.0, np.concatenate(h),
            sigma=sigma, common=common, noise=np.concatenate(e), **more,
        )  # fmt: skip


@pytest.fixture(scope="session")
def trench() -> Trench:
    """Ten metres, floor at 50 m and 1 m wide, vertical walls, stations from 0."""
    alignment = polyline([START, START + 10 * DIRECTION])
    design = ProfileDesign(
        "design.csv",
        np.array([0.0, 10.0]),
        np.array([50.0, 50.0]),
        np.array([1.0, 1.0]),
        np.array([0.0, 0.0]),
    )
    return Trench(alignment, design)
