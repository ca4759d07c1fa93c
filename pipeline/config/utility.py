"""`[utilities.<name>]` of site.toml: what lies buried where the machine digs, and how well its place is known."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.config.quantities import NonNegative, Positive, Section, Triple

MAX_UTILITIES = 200
MAX_POINTS = 2000
"""Of one line; a digitised plan has some dozens."""
SAME_POINT = 1e-6

Kind = Literal["gas", "water", "power", "telecom", "sewer", "other"]


class Utility(Section):
    """A buried line by its points, or the pipes of a LandXML file."""

    kind: Kind
    points: Annotated[tuple[Triple, ...], Field(max_length=MAX_POINTS)] = ()
    """Easting, northing, elevation along the line's axis (not its top), grid unit."""
    file: str | None = None
    """LandXML file with pipes, beside site.toml (or beside the log, when site.toml came as an attachment)."""
    network: str | None = None
    """LandXML: name of the pipe network; left out, all pipes of the file."""
    radius_mm: Annotated[float, Field(ge=0, le=5000)] | None = None
    """Outer radius. With a file it may be left out: then half the diameter that the file states for each pipe."""
    sigma_mm: tuple[NonNegative, NonNegative] | NonNegative
    """Standard deviation of the located axis; two numbers are horizontal and vertical."""
    clearance_mm: Positive = 500.0
    """An approach nearer than this to the line's surface is a near miss."""

    @model_validator(mode="after")
    def _one_line(self) -> Utility:
        if bool(self.points) == (self.file is not None):
            raise ValueError("give either points of the line's axis, or file, a LandXML file with pipes")
        if self.network is not None and self.file is None:
            raise ValueError("network goes with file, and there is none")
        if self.points and self.radius_mm is None:
            raise ValueError("points need radius_mm, the outer radius of the line")
        if (
            self.points
            and max(abs(a - b) for p in self.points for a, b in zip(p, self.points[0])) < SAME_POINT
        ):
            raise ValueError("points: a line needs at least two different points")
        return self

    @property
    def sigmas_m(self) -> tuple[float, float]:
        """Horizontal (along each axis of the plan) and vertical standard deviation of the axis, metres."""
        horizontal, vertical = self.sigma_mm if isinstance(self.sigma_mm, tuple) else (self.sigma_mm,) * 2
        return horizontal / 1000, vertical / 1000
