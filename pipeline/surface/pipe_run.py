"""A run of pipes, one after the other, as the bottom of a trench: the line along it and the level under it; metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import SurfaceError
from pipeline.surface.alignment import Alignment, polyline
from pipeline.surface.landxml_pipes import XmlPipe
from pipeline.surface.plan_geometry import MAX_LENGTH_M

_STEP_M = 1e-6
"""Two inverts at one manhole are two rows of a profile, and its stations must grow."""
_SAMPLE_M = 0.25
_SAME = 1e-6


@dataclass(frozen=True)
class PipeRun:
    """Pipes end to end."""

    network: str
    ends: np.ndarray
    """(n, 2, 3) easting, northing, invert of each pipe's start and end, grid metres, in order along the run."""
    names: tuple[str, ...]
    """(n,) names of the pipes; the chords of a curved one share theirs."""

    def line(self, start_station_m: float) -> Alignment:
        """The alignment from structure to structure."""
        corners = np.concatenate([self.ends[:, 0, :2], self.ends[-1:, 1, :2]])
        return polyline(corners, start_station_m, self.network)

    def rows(self, alignment: Alignment, reach_m: float, where: str) -> tuple[np.ndarray, np.ndarray]:
        """Stations and inverts (m,), ascending, along an alignment.

        Parameters
        ----------
        alignment : Alignment
            That of the run itself, or another beside which it lies.
        reach_m : float
            How far from it the pipes may lie.
        where : str
            For messages.

        Raises
        ------
        SurfaceError
            When a pipe lies further away, or the run turns back along the alignment.
        """
        stations, inverts = [], []
        for (start, end), name in zip(self.ends, self.names, strict=True):
            length = float(np.hypot(*(end - start)[:2]))
            share = np.linspace(0.0, 1.0, max(2, int(length / _SAMPLE_M) + 1))[:, None]
            points = start + share * (end - start)
            station, offset = alignment.station_offset(points[:, :2])
            if np.abs(offset).max() > reach_m:
                raise SurfaceError(
                    f"{where}: pipe '{name}' lies up to {np.abs(offset).max():.2f} m beside the alignment, outside the "
                    "floor that design.width makes; name the alignment of this run, or none"
                )
            stations.append(station)
            inverts.append(points[:, 2])
        station, invert = np.concatenate(stations), np.concatenate(inverts)
        if station[-1] < station[0]:
            station, invert = station[::-1], invert[::-1]
        if np.any(np.diff(station) < -1e-3):
            raise SurfaceError(
                f"{where}: its pipes turn back along the alignment; name pipes of one run with design.pipe_run"
            )
        keep = np.concatenate(
            [[True], (np.abs(np.diff(station)) > _STEP_M) | (np.abs(np.diff(invert)) > _SAME)]
        )
        station, invert = station[keep], invert[keep]
        # Rounding leaves two rows at a structure a little in the wrong order, or at one place.
        station = np.maximum.accumulate(station + _STEP_M * _repeats(station))
        return station, invert


def _repeats(station: np.ndarray) -> np.ndarray:
    """0 for a station beyond the one before, 1 for one that is not."""
    return np.concatenate([[0.0], (np.diff(station) < _STEP_M).astype(float)])


def run_of(
    pipes: Sequence[XmlPipe], network: str, names: Sequence[str], scale: float, source: str
) -> PipeRun:
    """The run of pipes of a network.

    Parameters
    ----------
    pipes : sequence of XmlPipe
        All of the file.
    network : str
        Its name.
    names : sequence of str
        The pipes of the run; none means all of the network.
    scale : float
        Metres per unit of the file.
    source : str
        For messages.

    Raises
    ------
    SurfaceError
        When there is no such network or pipe, or the pipes are no single line from one end to the other.
    """
    known = sorted({pipe.network for pipe in pipes})
    own = [pipe for pipe in pipes if pipe.network == network]
    if not own:
        listed = ", ".join(f"'{name}'" for name in known) or "none with pipes"
        raise SurfaceError(
            f"{source}: has no pipe network '{network}'; it holds {listed}; mend design.pipes in site.toml"
        )
    missing = [name for name in names if name not in {pipe.name for pipe in own}]
    if missing:
        raise SurfaceError(
            f"{source}: network '{network}' has no pipe '{missing[0]}'; mend design.pipe_run in site.toml"
        )
    if names:
        own = sorted(
            (pipe for pipe in own if pipe.name in set(names)), key=lambda pipe: list(names).index(pipe.name)
        )
    ends = [np.array([pipe.start, pipe.end]) * scale for pipe in own]
    length = sum(float(np.hypot(*(pair[1] - pair[0])[:2])) for pair in ends)
    if not length <= MAX_LENGTH_M:
        raise SurfaceError(
            f"{source}: the pipes of network '{network}' are {length / 1000:.0f} km long in all; name those of this "
            "job with design.pipe_run"
        )
    order = _in_order(ends, [pipe.name for pipe in own], f"{source}: network '{network}'")
    return PipeRun(
        network,
        np.array([ends[k][::-1] if turned else ends[k] for k, turned in order]),
        tuple(own[k].name for k, _ in order),
    )


def _in_order(ends: list[np.ndarray], names: list[str], where: str) -> list[tuple[int, bool]]:
    """Indices of the pipes along the run, and whether each is turned round."""
    at: dict[tuple[float, float], list[int]] = {}
    for k, pair in enumerate(ends):
        for end in pair:
            at.setdefault((float(end[0]), float(end[1])), []).append(k)
    advice = "say which pipes are the run with design.pipe_run"
    for touching in at.values():
        if len(touching) > 2:
            listed = ", ".join(f"'{names[k]}'" for k in dict.fromkeys(touching))
            raise SurfaceError(f"{where}: the pipes {listed} meet at one structure; {advice}")
    tips = [k for touching in at.values() if len(touching) == 1 for k in touching]
    if len(tips) != 2:
        raise SurfaceError(
            f"{where}: its pipes make {len(tips) // 2 or 'no'} separate lines with two ends; {advice}"
        )
    # From the end where water comes in: the one whose pipe begins there; if both or neither do, the first in the file.
    upstream = [k for k in tips if len(at[_key(ends[k][0])]) == 1]
    here = _key(ends[upstream[0]][0]) if upstream else _key(ends[min(tips)][1])
    order: list[tuple[int, bool]] = []
    used: set[int] = set()
    while following := [k for k in at[here] if k not in used]:
        k = following[0]
        used.add(k)
        turned = _key(ends[k][0]) != here
        order.append((k, turned))
        here = _key(ends[k][0] if turned else ends[k][1])
    if len(order) < len(ends):
        raise SurfaceError(f"{where}: its pipes do not hang together; {advice}")
    return order


def _key(end: np.ndarray) -> tuple[float, float]:
    return float(end[0]), float(end[1])
