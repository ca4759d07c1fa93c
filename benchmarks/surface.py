"""The swept cutting edge of a shift on cells of 5 cm, and designs as they come, time and memory: `make bench-surface`.

A machine digs a trench of 120 m in cycles of 20 s (drag, lift, swing, return) and retreats; the edge is known at a
million epochs, those of two cameras at 10 Hz and of a sensor at 15 Hz over eight hours. Bars: 30 s and 2 GB for
the surface with its floor, sigmas and states; what is measured is the whole process, input included.

Before that, 100,000 faces are read from LandXML (bar 3 s) and from a drawing, and a million points are put to station
and offset beside a line with spirals.

The same shift is held against 20 buried lines of 50 pieces each, half of them across the trench and half along it, from
above its floor to two metres below: 10 s, and no more memory than a tenth of the input's.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._results import keep_result
from pipeline.surface.alignment import Alignment, from_elements, polyline
from pipeline.surface.approach import Approaches, Line, approaches
from pipeline.surface.as_built import as_built
from pipeline.surface.clothoid import clothoid_to
from pipeline.surface.design import ProfileDesign
from pipeline.surface.dxf import read_dxf
from pipeline.surface.landxml import read_landxml
from pipeline.tracks.poses import CuttingEdge

HOURS = 8
LENGTH_M = 120.0
CELL_M = 0.05
SECONDS_BAR, MEGABYTES_BAR = 30.0, 2000.0
NET = 225
"""Points along a side of the net of faces: 224 squares of two faces each way."""
LANDXML_BAR = 3.0
BESIDE = 1_000_000
LINES, PIECES = 20, 50
LINES_SECONDS_BAR, LINES_MEMORY_BAR = 10.0, 0.1
"""Seconds, and what the process grows by as a share of the edge's arrays."""


@dataclass(frozen=True)
class Row:
    """One run."""

    epochs: int
    cells: int
    cells_cut: int
    passes: int
    seconds: float
    megabytes: float
    """Largest resident size of the process."""


def trench() -> tuple[Alignment, ProfileDesign]:
    """A trench with a bend, 2 m deep, 1.2 m wide."""
    alignment = polyline(np.array([[500_000.0, 4_000_000], [500_060, 4_000_020], [500_120, 4_000_020]]))
    both = np.ones(2)
    return alignment, ProfileDesign("bench", np.array([0, LENGTH_M]), 98 * both, 1.2 * both, 0.5 * both)


def shift(alignment: Alignment, epochs: int) -> CuttingEdge:
    """The cutting edge of a shift."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, HOURS * 3600, epochs)
    cycle, phase = np.divmod(t, 20.0)
    phase /= 20.0
    drag = phase < 0.3
    station = 5 + cycle * (LENGTH_M - 10) / cycle.max()
    station += np.where(drag, 4 * (1 - phase / 0.3), 4 * (phase - 0.3) / 0.7)
    bowl = np.maximum(-2.0, -2.0 + 1.5 * np.abs(phase / 0.15 - 1) ** 8) + 0.3 * (cycle % 4) / 4
    h = 100 + np.where(drag, bowl, 1.0) + rng.normal(0, 0.003, epochs)
    offset = np.where(drag, 0.0, 6 * np.sin(np.pi * (phase - 0.3) / 0.7))
    p = np.empty((epochs, 3, 3))
    for i, x in enumerate((-0.6, 0.0, 0.6)):
        p[:, i, :2], p[:, i, 2] = alignment.points(station, offset + x), h
    cov, common = np.zeros((epochs, 3, 6)), np.zeros((epochs, 3, 6))
    cov[..., [0, 3, 5]], common[..., [0, 3, 5]] = 3e-5, 1e-5
    time_ns = 1_750_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
    return CuttingEdge(time_ns, p, np.ones(epochs, bool), cov, common)


@dataclass(frozen=True)
class Reading:
    """One design that was read, or one line that points were put to."""

    what: str
    count: int
    seconds: float


def landxml_net(path: Path) -> None:
    """A LandXML surface of a rolling net."""
    n, e = np.divmod(np.arange(NET * NET), NET)
    h = 50 + 0.01 * (n * e % 97)
    at = np.flatnonzero((n < NET - 1) & (e < NET - 1)) + 1
    with path.open("w", encoding="utf-8") as out:
        out.write(
            '<LandXML><Units><Metric linearUnit="meter"/></Units><Surfaces><Surface name="t"><Definition><Pnts>\n'
        )
        for i in range(len(n)):
            out.write(f'<P id="{i + 1}">{4_123_000 + n[i]:.6f} {512_000 + e[i]:.6f} {h[i]:.6f}</P>\n')
        out.write("</Pnts><Faces>\n")
        for i in at:
            out.write(f"<F>{i} {i + 1} {i + NET}</F>\n<F>{i + 1} {i + NET + 1} {i + NET}</F>\n")
        out.write("</Faces></Definition></Surface></Surfaces></LandXML>\n")


def dxf_net(path: Path) -> None:
    """The same net as 3DFACE of a drawing."""
    n, e = np.divmod(np.arange(NET * NET), NET)
    points = np.stack([512_000.0 + e, 4_123_000.0 + n, 50 + 0.01 * (n * e % 97)], axis=1)
    at = np.flatnonzero((n < NET - 1) & (e < NET - 1))
    corners = np.stack(
        [at, at + 1, at + NET, at + NET, at + 1, at + NET + 1, at + NET, at + NET], axis=1
    ).reshape(-1, 4)
    with path.open("w", encoding="ascii") as out:
        out.write("0\nSECTION\n2\nHEADER\n9\n$INSUNITS\n70\n6\n0\nENDSEC\n0\nSECTION\n2\nENTITIES\n")
        for face in points[corners]:
            out.write("0\n3DFACE\n100\nAcDbEntity\n8\nt\n100\nAcDbFace\n")
            for k, (x, y, z) in enumerate(face):
                out.write(f"{10 + k}\n{x:.6f}\n{20 + k}\n{y:.6f}\n{30 + k}\n{z:.6f}\n")
        out.write("0\nENDSEC\n0\nEOF\n")


def winding() -> Alignment:
    """A straight, a spiral into a curve of 120 m, and one out of it."""
    first = clothoid_to(np.array([75.0, 15.0]), (0.0, 1 / 120), 77.0)
    last = clothoid_to(np.array([70.0, 50.0]), (1 / 120, 0.0), 86.0)
    turn = first.turned(first.length) - last.heading
    c, s = np.cos(turn), np.sin(turn)
    middle = np.array([75.0, 15.0])
    start = np.array([500_000.0, 4_000_000.0])
    away = -50 * np.array([np.cos(first.heading), np.sin(first.heading)])
    corners = start + np.array([away, [0, 0], middle, middle + np.array([[c, -s], [s, c]]) @ [70.0, 50.0]])
    nan = np.nan
    return from_elements(
        corners[:-1],
        corners[1:],
        np.full((3, 2), nan),
        np.array([0, -1, -1]),
        0.0,
        "bench",
        curvature=np.array([[nan, nan], [0, -1 / 120], [-1 / 120, 0]]),
        spiral_length=np.array([nan, first.length, last.length]),
    )


def readings() -> list[Reading]:
    """Designs that are read, and points beside a line with spirals."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        xml, drawing = Path(folder) / "net.xml", Path(folder) / "net.dxf"
        landxml_net(xml)
        dxf_net(drawing)
        started = time.perf_counter()
        faces = len(read_landxml(xml).surface(None).faces)
        found.append(Reading("LandXML faces", faces, time.perf_counter() - started))
        started = time.perf_counter()
        faces = len(read_dxf(drawing, "t", None).surface.faces)
        found.append(Reading("DXF faces", faces, time.perf_counter() - started))
    line = winding()
    rng = np.random.default_rng(0)
    along = np.sort(rng.uniform(0, line.length, BESIDE))  # a sweep's points lie together
    p = line.points(along, rng.uniform(-5, 5, BESIDE))
    started = time.perf_counter()
    station, _ = line.station_offset(p)
    found.append(Reading("points beside spirals", BESIDE, time.perf_counter() - started))
    assert np.abs(station - along).max() < 1e-6
    return found


@dataclass(frozen=True)
class LinesRow:
    """One run over buried lines."""

    epochs: int
    lines: int
    pieces: int
    approaches: int
    seconds: float
    grown_share: float
    """Growth of the process over the size of the edge's arrays."""


def buried(alignment: Alignment) -> list[Line]:
    """Lines across the trench and along it."""
    rng = np.random.default_rng(1)
    made = []
    for number in range(LINES):
        if number % 2:
            offset = np.linspace(-12, 12, PIECES + 1)
            station, h = rng.uniform(0, LENGTH_M) + 0.05 * offset, 98 - rng.uniform(-0.5, 2.0)
        else:
            station = np.linspace(0, LENGTH_M, PIECES + 1)
            offset, h = np.full(PIECES + 1, rng.uniform(-3, 3)), 98 - rng.uniform(-0.5, 0.6)
        points = np.column_stack([alignment.points(station, offset), np.full(PIECES + 1, h)])
        made.append(Line(points[:-1], points[1:], np.full(PIECES, 0.1), 0.05, 0.05, 0.5))
    return made


def follow_lines(edge: CuttingEdge, alignment: Alignment) -> LinesRow:
    """Approaches of a shift to all lines, after the code is compiled."""
    lines = buried(alignment)
    few = CuttingEdge(edge.time_ns[:50], edge.p_grid[:50], edge.seen[:50], edge.cov[:50], edge.common[:50])
    approaches(few, lines[:1], 2.0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    started = time.perf_counter()
    found: list[Approaches] = approaches(edge, lines, 2.0)
    seconds = time.perf_counter() - started
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    size = sum(part.nbytes for part in (edge.time_ns, edge.p_grid, edge.seen, edge.cov, edge.common))
    count = sum(near.inside + near.touching + near.near for near in found)
    return LinesRow(len(edge), LINES, LINES * PIECES, count, seconds, grown / size)


def main() -> int:
    """Run, print the table and the line, keep the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--epochs", type=int, default=1_000_000)
    epochs = parser.parse_args().epochs
    read = readings()
    for one in read:
        print(f"{one.count:9d} {one.what:<24} {one.seconds:6.2f} s")
    alignment, design = trench()
    edge = shift(alignment, epochs)
    # First, because later the largest size of the process is that of the surface.
    lines = follow_lines(edge, alignment)
    started = time.perf_counter()  # numba's compiling included: a first run has it too
    built = as_built(edge, alignment, design, CELL_M)
    seconds = time.perf_counter() - started
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    row = Row(epochs, built.grid.size, int(built.cut.sum()), int(built.passes.sum()), seconds, megabytes)
    print(f"{'epochs':>9} {'cells':>8} {'cut':>8} {'passes':>9} {'s':>6} {'MB':>6}")
    print(
        f"{row.epochs:9d} {row.cells:8d} {row.cells_cut:8d} {row.passes:9d} {row.seconds:6.1f} {row.megabytes:6.0f}"
    )
    line = (
        f"surface: {epochs / 1e6:g} M epochs into {CELL_M * 1000:.0f} mm cells in {seconds:.1f} s, {megabytes:.0f} MB "
        f"(bars {SECONDS_BAR:.0f} s, {MEGABYTES_BAR:.0f} MB); "
        f"{read[0].count:,} faces of LandXML in {read[0].seconds:.1f} s (bar {LANDXML_BAR:.0f} s)"
    )
    print(
        f"lines: {lines.lines} of {PIECES} pieces, {lines.approaches} approaches in {lines.seconds:.1f} s, grown by "
        f"{100 * lines.grown_share:.0f} % of the input (bars {LINES_SECONDS_BAR:.0f} s, {100 * LINES_MEMORY_BAR:.0f} %)"
    )
    keep_result("surface", [row, *read, lines], line)
    print(line)
    slow = seconds > SECONDS_BAR or read[0].seconds > LANDXML_BAR or lines.seconds > LINES_SECONDS_BAR
    return int(slow or megabytes > MEGABYTES_BAR or lines.grown_share > LINES_MEMORY_BAR)


if __name__ == "__main__":
    sys.exit(main())
