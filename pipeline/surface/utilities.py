"""Buried utilities: where they lie, how near the cutting edge came, and what that says of each.

The rule, printed on the report:

* The distance is that from the cutting edge to the line's surface: to its axis, less its radius. Only the edge is
  followed; the bucket's sides and back, and the stick, are not.
* Each distance has a lower bound that holds with 95 % confidence, one-sided: errors of the edge (own and common) and
  of the line's own place (see `distance_bound`).
* **STRIKE LIKELY**: the estimated distance is 0 or less. **STRIKE POSSIBLE**: it is not, but its bound is. **NEAR
  MISS**: the bound is below the line's clearance. **CLEAR**: the edge came within `REACH_M` and no nearer than the
  clearance. **NOT APPROACHED**: it did not even come that near.
* Where the edge was not seen for some time within `REACH_M`, a line is at best **CLEAR WHILE SEEN**.

The smallest of many noisy distances is too small, by one to three of their own sigmas; it is not corrected, because the
error is to the safe side: of draws with one look 95 in 100 bounds hold, with many looks more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import Site
from pipeline.config.site import MAX_FROM_ORIGIN_M
from pipeline.config.utility import Utility
from pipeline.errors import SurfaceError
from pipeline.surface.alignment import Alignment
from pipeline.surface.approach import Approaches, Line, approaches
from pipeline.surface.design import check_unit
from pipeline.surface.landxml import LandXml, read_landxml
from pipeline.tracks.poses import CuttingEdge

STRIKE_LIKELY, STRIKE_POSSIBLE, NEAR_MISS = "STRIKE LIKELY", "STRIKE POSSIBLE", "NEAR MISS"
CLEAR, CLEAR_WHILE_SEEN, NOT_APPROACHED = "CLEAR", "CLEAR WHILE SEEN", "NOT APPROACHED"
VERDICTS = (STRIKE_LIKELY, STRIKE_POSSIBLE, NEAR_MISS, CLEAR_WHILE_SEEN, CLEAR, NOT_APPROACHED)
"""The gravest first."""
REACH_M = 2.0
MAX_SEGMENTS = 20_000
"""Of all lines of a site."""


@dataclass(frozen=True)
class Buried:
    """One utility of the site, in grid metres."""

    name: str
    kind: str
    line: Line


@dataclass(frozen=True)
class Finding:
    """What the log says of one utility."""

    utility: Buried
    approaches: Approaches
    verdict: str
    bound: float
    """The lowest of the log, metres; nan where the edge was never seen."""


def read_utilities(site: Site, files: Mapping[str, Path]) -> tuple[Buried, ...]:
    """The site's utilities in grid metres.

    Parameters
    ----------
    site : Site
        Its `utilities`, grid unit and origin.
    files : mapping
        Path of each LandXML file, by ``utilities.<name>``.

    Raises
    ------
    SurfaceError
        A file cannot be read, is in another unit, has no such pipes or pipes far away; too many lines.
    """
    read: dict[Path, LandXml] = {}
    found = []
    for name, utility in site.utilities.items():
        if utility.file is None:
            points = np.array(utility.points) * site.grid.metres_per_unit
            assert utility.radius_mm is not None
            start, end, radius = points[:-1], points[1:], np.full(len(points) - 1, utility.radius_mm / 1000)
        else:
            path = files[f"utilities.{name}"]
            if path not in read:
                read[path] = read_landxml(path)
            start, end, radius = pipes_of(read[path], utility, site, name)
        line = Line(start, end, radius, *utility.sigmas_m, utility.clearance_mm / 1000)
        found.append(Buried(name, utility.kind, line))
    segments = sum(len(buried.line.radius) for buried in found)
    if segments > MAX_SEGMENTS:
        raise SurfaceError(
            f"utilities in site.toml: {segments} straight pieces in all, at most {MAX_SEGMENTS} are followed; "
            "leave out what lies far from the job"
        )
    return tuple(found)


def pipes_of(
    landxml: LandXml, utility: Utility, site: Site, name: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start and end of the axes of a network's pipes and their radii, grid metres.

    The file gives the invert, the lowest place inside; the axis lies half the inside diameter above it. `radius_mm`, if
    given, is the outer radius in place of that half; it stands for the height of the axis too where the file states no
    diameter.

    Raises
    ------
    SurfaceError
        See `read_utilities`.
    """
    where = f"{landxml.source} (utilities.{name} in site.toml)"
    check_unit(landxml, site.grid.unit)
    pipes = [pipe for pipe in landxml.pipes if utility.network in (None, pipe.network)]
    if not pipes:
        networks = sorted({pipe.network for pipe in landxml.pipes})
        held = ", ".join(f"'{network}'" for network in networks[:8]) if networks else "no pipes at all"
        wanted = f"network '{utility.network}'" if utility.network else "pipe"
        raise SurfaceError(f"{where}: holds no {wanted}, but {held}; mend utilities.{name}")
    scale = site.grid.metres_per_unit
    stated = np.array([np.nan if pipe.diameter is None else pipe.diameter for pipe in pipes]) * scale / 2
    given = np.nan if utility.radius_mm is None else utility.radius_mm / 1000
    radius = np.where(np.isnan(given), stated, given)
    inside = np.where(np.isnan(stated), given, stated)
    if np.any(np.isnan(radius)):
        silent = pipes[int(np.argmax(np.isnan(radius)))].name
        raise SurfaceError(
            f"{where}: states no diameter of pipe '{silent}'; give radius_mm of utilities.{name}"
        )
    start = np.array([pipe.start for pipe in pipes]) * scale
    end = np.array([pipe.end for pipe in pipes]) * scale
    origin = site.grid.to_grid_metres(np.zeros(3))
    away = np.maximum(np.linalg.norm(start - origin, axis=1), np.linalg.norm(end - origin, axis=1))
    if not away.max() <= MAX_FROM_ORIGIN_M:
        raise SurfaceError(
            f"{where}: pipe '{pipes[int(np.argmax(away))].name}' lies {away.max() / 1000:,.0f} km from grid.origin "
            f"(limit {MAX_FROM_ORIGIN_M / 1000:.0f} km); check the unit and the axes of the file"
        )
    start[:, 2] += inside
    end[:, 2] += inside
    return start, end, radius


def find_approaches(edge: CuttingEdge, utilities: tuple[Buried, ...]) -> list[Finding]:
    """What the log says of each utility, in the order of the site."""
    found = approaches(edge, [utility.line for utility in utilities], REACH_M)
    return [_finding(utility, near) for utility, near in zip(utilities, found)]


def verdict_of(distance: float, bound: float, clearance: float) -> str:
    """The word for a distance with its lower bound, metres."""
    if distance <= 0:
        return STRIKE_LIKELY
    if bound <= 0:
        return STRIKE_POSSIBLE
    if bound < clearance:
        return NEAR_MISS
    return CLEAR if distance < REACH_M else NOT_APPROACHED


def _finding(utility: Buried, near: Approaches) -> Finding:
    if near.closest is None:
        return Finding(utility, near, CLEAR_WHILE_SEEN if near.unseen else NOT_APPROACHED, np.nan)
    bounds = np.append(near.events.bound, near.closest.bound)
    verdict = verdict_of(float(near.closest.distance[0]), float(bounds.min()), utility.line.clearance)
    if near.unseen and verdict in (CLEAR, NOT_APPROACHED):
        verdict = CLEAR_WHILE_SEEN
    return Finding(utility, near, verdict, float(bounds.min()))


def facts_of(finding: Finding, alignment: Alignment) -> dict[str, Any]:
    """What `survey.json` says of one utility, metres; null where the edge was never seen."""
    near, line = finding.approaches, finding.utility.line
    facts: dict[str, Any] = {
        "name": finding.utility.name,
        "kind": finding.utility.kind,
        "verdict": finding.verdict,
        "clearance": line.clearance,
        "radius": float(line.radius.max()),
        "sigma_horizontal": line.sigma_horizontal,
        "sigma_vertical": line.sigma_vertical,
        "bound": finding.bound,
        "approaches": {STRIKE_LIKELY: near.inside, STRIKE_POSSIBLE: near.touching, NEAR_MISS: near.near},
        "listed": len(near.start_ns),
        "unseen": {
            "stretches": near.unseen,
            "seconds": near.unseen_s,
            "longest_seconds": near.longest_unseen_s,
            "longest_from_ns": near.longest_unseen_ns if near.unseen else None,
        },
    }
    for key in ("distance", "sigma_own", "sigma_common", "sigma_line", "time_ns", "station", "offset"):
        facts[key] = None
    if (closest := near.closest) is not None:
        station, offset = alignment.station_offset(closest.edge[:, :2])
        facts |= {
            key: float(getattr(closest, key)[0])
            for key in ("distance", "sigma_own", "sigma_common", "sigma_line")
        }
        facts |= {
            "time_ns": int(closest.time_ns[0]),
            "station": float(station[0]),
            "offset": float(offset[0]),
        }
    return facts
