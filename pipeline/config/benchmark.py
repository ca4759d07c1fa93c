"""Markers fixed on the site: prints with a surveyed pose, or surveyed corners, or neither."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from pipeline.config.quantities import (
    Positive,
    Print,
    Section,
    Triple,
    UncertainPose,
)


class SurveyedPose(UncertainPose):
    """A marker's pose in the grid."""

    enh: Triple
    """Easting, northing, elevation of the marker's centre, grid unit."""
    rpy_deg: Triple
    """``R_grid_marker = Rz(yaw) @ Ry(pitch) @ Rx(roll)``, degrees."""


class SurveyedCorner(Section):
    """One corner of a printed tag, shot with the total station."""

    tag: Annotated[int, Field(ge=0)]
    corner: Annotated[int, Field(ge=0, le=3)]
    """0 top-left, 1 top-right, 2 bottom-right, 3 bottom-left of the print."""
    enh: Triple


class Benchmark(Print):
    """A marker fixed on the site: its surveyed pose, or three or more surveyed corners; neither: the log must tell."""

    pose: SurveyedPose | None = None
    corners: tuple[SurveyedCorner, ...] = ()
    sigma_corner_mm: Positive | None = None

    @model_validator(mode="after")
    def _one_survey(self) -> Benchmark:
        if self.pose is not None and self.corners:
            raise ValueError(
                "give either pose, or at least three surveyed corners with sigma_corner_mm, or neither: "
                "then the log must tell where the marker is"
            )
        if not self.corners and self.sigma_corner_mm is not None:
            raise ValueError("sigma_corner_mm goes with surveyed corners, and there are none")
        if self.corners and (len(self.corners) < 3 or self.sigma_corner_mm is None):
            raise ValueError("surveyed corners need at least three of them and sigma_corner_mm")
        ids = {tag.id for tag in self.tags}
        for shot in self.corners:
            if shot.tag not in ids:
                raise ValueError(
                    f"a corner of tag {shot.tag} was surveyed, but the tags of this benchmark are {sorted(ids)}"
                )
        return self

    @property
    def is_surveyed(self) -> bool:
        """False where the log alone must tell its pose."""
        return self.pose is not None or bool(self.corners)
