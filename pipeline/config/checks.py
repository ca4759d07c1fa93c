"""`[checks]` of site.toml: what the result is compared with."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.config.quantities import Positive, Section, Triple


class ControlPoint(Section):
    """A known point on which the bucket is set down to check the machine."""

    enh: Triple
    """Easting, northing, elevation, grid unit."""
    sigma_mm: Positive = 2.0
    """Of each coordinate, with what setting down a tooth on the mark adds."""


class Checks(Section):
    """Total-station shots to compare with: of the floor, of the cutting edge while it stood, and known points."""

    file: str
    order: Literal["PNEZD", "PENZD", "named"]
    """The first two cannot be told apart from the file; `named` goes by the file's line of headings."""
    sigma_mm: Positive = 2.0
    """Of a shot's coordinates, where the file has no column `sigma_mm`."""
    codes: dict[str, Literal["floor", "edge", "control"]] = {}
    """First word of a description -> kind of shot, for files without a column `kind`; all others are of the floor."""
    used_in_calibration: tuple[str, ...] = ()
    """Ids or codes of points that the machine was calibrated with: shown, and kept out of the statistics."""
    control: dict[Annotated[str, Field(min_length=1)], ControlPoint] = {}
    """By id, as text; a shot of kind `control` with that id gives the time only."""
    control_radius_m: Annotated[float, Field(gt=0, le=2)] = 0.15
    """The edge was set on a known point where it rested within this of it."""
    time_tolerance_s: Annotated[float, Field(ge=0, le=60)] = 5.0
    """How far the clock of the total station may be from that of the log."""
