"""The ground as it was before digging: without it nobody can say how much was cut.

The cutting edge tells how low the ground is where it dug, never how high it was before.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from pipeline.config.site import Site
from pipeline.errors import SurfaceError
from pipeline.surface.alignment import Alignment
from pipeline.surface.design import check_elevation, check_unit, tin_of
from pipeline.surface.landxml import read_landxml


class Elevations(Protocol):
    """What is asked of a ground; metres."""

    def elevation(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Elevation; nan where the ground is not known."""


@dataclass(frozen=True)
class Ground:
    """Where the soil began."""

    surface: Elevations
    sigma_m: float
    """Standard deviation of its level, common to all of it, metres."""

    def elevation(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Elevation at station and offset, metres; nan where the ground is not known."""
        return self.surface.elevation(station, offset)


@dataclass(frozen=True)
class LevelGround:
    """One level everywhere, such as a yard."""

    level: float
    """Elevation, metres."""

    def elevation(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        station, offset = np.broadcast_arrays(np.asarray(station, float), np.asarray(offset, float))
        return np.full(station.shape, self.level)


def read_ground(path: Path | None, site: Site, alignment: Alignment) -> Ground | None:
    """The ground of a site in grid metres, or None where site.toml has none.

    Parameters
    ----------
    path : Path or None
        The file that ``ground.file`` names.
    site : Site
        Its grid and ``[ground]``.
    alignment : Alignment
        The axis of the trench.

    Raises
    ------
    SurfaceError
        The file cannot be used, or lies far from the site.
    """
    wanted = site.ground
    if wanted is None:
        return None
    scale = site.grid.metres_per_unit
    origin_h = float(site.grid.to_grid_metres(np.zeros(3))[2])
    sigma_m = wanted.sigma_mm / 1000
    if wanted.elevation is not None:
        level = wanted.elevation * scale
        check_elevation(np.array([level]), origin_h, "ground.elevation", scale)
        return Ground(LevelGround(level), sigma_m)
    assert path is not None
    landxml = read_landxml(path)
    check_unit(landxml, site.grid.unit)
    surface = landxml.surface(wanted.surface, "ground.surface")
    try:
        return Ground(tin_of(surface, landxml.source, alignment, site), sigma_m)
    except SurfaceError as error:
        raise SurfaceError(f"the ground before digging (ground.file in site.toml): {error}") from None
