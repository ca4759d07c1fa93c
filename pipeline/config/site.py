"""`site.toml`: one job, its grid, benchmarks, design, tolerances, check shots and settings."""

from __future__ import annotations

import datetime
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from pipeline.config.benchmark import Benchmark
from pipeline.config.checks import Checks
from pipeline.config.quantities import (
    Identifier,
    Name,
    NonNegative,
    Pose,
    Positive,
    Section,
)
from pipeline.config.utility import MAX_UTILITIES, Utility

FORMAT = "gradetrace/site/1"
MAX_FROM_ORIGIN_M = 20_000.0
"""No job is that long: further away, two coordinates were swapped or the unit is another."""
METRES_PER_UNIT = {"m": 1.0, "international_foot": 0.3048, "us_survey_foot": 1200.0 / 3937.0}


class SiteIdentity(Section):
    id: Identifier
    name: str = ""


class Grid(Section):
    """The survey grid all coordinates of this file and of the files it names are in."""

    unit: Literal["m", "international_foot", "us_survey_foot"]
    """'ft' alone is refused: the two feet differ by 1.2 m at 2,000,000 ft."""
    origin: tuple[int, int, int]
    """Easting, northing, elevation of the world's origin in the grid unit, whole numbers near the job."""
    name: str = ""
    """What the surveyor calls this grid and its height datum; printed on the report."""

    @field_validator("unit", mode="before")
    @classmethod
    def _which_foot(cls, value: object) -> object:
        if value in ("ft", "foot", "feet"):
            raise ValueError("'ft' does not say which foot: write 'international_foot' or 'us_survey_foot'")
        return value

    @property
    def metres_per_unit(self) -> float:
        return METRES_PER_UNIT[self.unit]

    def to_world(self, enh: np.ndarray) -> np.ndarray:
        """Grid coordinates (..., 3) in the grid unit -> world metres (..., 3)."""
        return (np.asarray(enh, float) - np.array(self.origin)) * self.metres_per_unit

    def to_grid_metres(self, p_world: np.ndarray) -> np.ndarray:
        """World metres (..., 3) -> grid easting, northing, elevation in metres (..., 3)."""
        return np.asarray(p_world, float) + np.array(self.origin) * self.metres_per_unit


class Alignment(Section):
    """A polyline in the grid along which stations run."""

    points: Annotated[tuple[tuple[float, float], ...], Field(min_length=2)]
    """Easting, northing, grid unit."""
    start_station: float = 0.0
    """Station of the first point, grid unit."""


DESIGN_KEYS = (
    "surface", "alignment", "profile", "pipes", "pipe_run", "bedding", "width", "side_slope", "layer",
    "alignment_layer", "start_station", "unit",
)  # fmt: skip
"""Which of them a design has tells what it is."""


class Design(Section):
    file: str
    """Beside site.toml (or beside the log, when site.toml came as an attachment)."""
    kind: Literal["profile_csv", "landxml", "dxf"]
    surface: str | None = None
    """LandXML: name of the surface; may be left out if there is only one."""
    alignment: str | None = None
    """LandXML: name of the alignment; may be left out if [alignment] stands in this file."""
    profile: str | None = None
    """LandXML: name of a profile of `alignment`, whose levels are those of the trench floor; instead of a surface."""
    pipes: str | None = None
    """LandXML: name of a pipe network; the floor lies `bedding` under its inverts; instead of a surface."""
    pipe_run: tuple[str, ...] = ()
    """Names of the pipes that are dug for; left out, all of the network, which must then be one line."""
    bedding: NonNegative | None = None
    """From the inverts down to the trench floor (wall of the pipe and bedding), grid unit."""
    width: Positive | None = None
    """With `profile` or `pipes`: width of the trench floor, grid unit."""
    side_slope: NonNegative | None = None
    """With `profile` or `pipes`: run per rise of both sides; left out, vertical walls."""
    layer: str | None = None
    """DXF: layer of the faces."""
    alignment_layer: str | None = None
    """DXF: layer of the alignment; may be left out if [alignment] stands in this file."""
    start_station: float | None = None
    """Station at which the line of `alignment_layer`, or of `pipes` without `alignment`, begins, grid unit; else 0."""
    unit: Literal["m", "international_foot", "us_survey_foot"] | None = None
    """DXF: the unit it is drawn in, for drawings that do not say; it must be that of the grid."""

    @model_validator(mode="after")
    def _one_kind(self) -> Design:
        what, needed, allowed = self._keys()
        given = {name for name in DESIGN_KEYS if getattr(self, name) not in (None, ())}
        missing = [name for name in needed if name not in given]
        if missing:
            raise ValueError(f"a design that is {what} needs {' and '.join(missing)}")
        foreign = sorted(given - set(needed) - set(allowed))
        if foreign:
            raise ValueError(f"a design that is {what} has no use for {', '.join(foreign)}: remove it")
        return self

    def _keys(self) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
        """What the design is, in words; the keys it needs, and those it may have besides."""
        if self.kind == "profile_csv":
            return "a CSV profile", (), ()
        if self.kind == "dxf":
            return "a DXF drawing", ("layer",), ("alignment_layer", "start_station", "unit")
        if self.profile is not None:
            return "a LandXML profile", ("profile", "alignment", "width"), ("side_slope",)
        if self.pipes is not None:
            start = () if self.alignment else ("start_station",)
            return (
                "a run of LandXML pipes",
                ("pipes", "bedding", "width"),
                ("pipe_run", "side_slope", "alignment", *start),
            )
        return "a LandXML surface", (), ("surface", "alignment")

    @property
    def brings_alignment(self) -> bool:
        """Whether stations can run along a line of the design's own file."""
        return bool(self.alignment or self.pipes or self.alignment_layer)


class Ground(Section):
    """The ground before digging, for volumes: one level, or a surface of a LandXML file."""

    elevation: float | None = None
    """Grid unit."""
    file: str | None = None
    """Beside site.toml; it may be the file of the design."""
    surface: str | None = None
    """Name of the surface in that file; may be left out if there is only one."""
    sigma_mm: Positive
    """Of the level of the ground, the same error everywhere: stubble, ruts, the age of the survey."""

    @model_validator(mode="after")
    def _one_source(self) -> Ground:
        if (self.elevation is None) == (self.file is None):
            raise ValueError("give either elevation, or file with the LandXML surface of the ground")
        if self.surface is not None and self.file is None:
            raise ValueError("surface names a surface of a file: give file as well")
        return self


class Tolerance(Section):
    """Deviation = as-built minus design; + is high (under-dug), - is low (over-dug)."""

    high_mm: NonNegative
    low_mm: NonNegative
    wide_mm: NonNegative | None = None
    """How far a side of the floor may lie outside the designed one; with narrow_mm, or the sides are not judged."""
    narrow_mm: NonNegative | None = None
    """How far inside."""
    coverage_factor: Positive = 2.0
    """k in U = k sigma."""

    @model_validator(mode="after")
    def _both_sides(self) -> Tolerance:
        if (self.wide_mm is None) != (self.narrow_mm is None):
            raise ValueError("the sides are judged with both wide_mm and narrow_mm; give both or neither")
        return self


class DetectionSettings(Section):
    quad_decimate: Annotated[float, Field(ge=1, le=4)] = 1.0
    """1 searches every pixel; 2 is three times faster and loses tags under 25 px."""
    decode_sharpening: Annotated[float, Field(ge=0, le=2)] = 0.5
    """Of the cells before they are read: 0.5 reads 1 to 5 in a hundred tags under 18 px more than 0.25, and 1 hardly
    more than 0.5. Decision margins grow with it: 39, 57 and 92 in the median of tags 14 px wide."""
    max_hamming: Annotated[int, Field(ge=0, le=2)] = 1
    """Wrong bits that are corrected; in families of short codes (tag16h5, DICT_4X4) none whatever stands here."""
    min_margin: NonNegative = 20.0
    """Decision margin below which a decoded tag is rejected."""


class Split(Section):
    """A quantity that changed during the log, by its name in the table of statics: two from an instant on."""

    static: Annotated[str, Field(min_length=1)]
    """Such as `benchmark B2 pose`, `camera cab_left mount`, `sensor pot time offset`."""
    at: datetime.datetime
    """First instant of the new one, with its offset from UTC, for example `2026-05-04T10:42:31Z`."""

    @field_validator("at")
    @classmethod
    def _which_clock(cls, value: datetime.datetime) -> datetime.datetime:
        if value.tzinfo is None:
            raise ValueError("say which clock: write the offset from UTC, such as 2026-05-04T10:42:31Z")
        return value

    @property
    def at_ns(self) -> int:
        """Nanoseconds UTC."""
        since = self.at - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
        return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


class EstimationSettings(Section):
    huber: Positive = 2.5
    """Corner residual, in its own sigmas, beyond which its weight falls."""
    max_iterations: Annotated[int, Field(ge=1, le=200)] = 60
    max_gap_s: Positive = 0.3
    """States further than this from an observation of their body are marked `bridged`: a frame and a half at 5 Hz.
    Further out the motion prior alone speaks; at 0.5 s a swinging bucket was 20 cm off, 3.6 of its sigmas."""
    split: tuple[Split, ...] = ()
    """Benchmarks, mounts and sensors that changed during the log: what the files say holds before, and after it the
    quantity is free. The change test names what and when."""
    cross_validation: bool = True
    """Adjust odd and even frames apart and compare; costs about two of the adjustment's iterations."""


class SurveySettings(Section):
    cell_m: Annotated[float, Field(gt=0, le=1)] = 0.05
    station_step_m: Annotated[float, Field(gt=0, le=100)] | None = None
    """Distance of the stations; left out, 0.5 m, or 2 ft on a grid in feet, so that stations are round numbers."""
    surface: Literal["lowest", "last"] = "lowest"
    """The lower envelope of the sweep for digging; the last pass for placed material."""


class ReportSettings(Section):
    title: str = ""
    company: str = ""
    time_zone: str = ""
    """Name in the IANA database, for example `Europe/Helsinki`: the report then shows the site's clock beside UTC."""
    cross_section_step_m: Positive = 1.0


class Site(Section):
    """One job."""

    format: Literal["gradetrace/site/1"]
    site: SiteIdentity
    grid: Grid
    benchmarks: dict[Name, Benchmark] = {}
    """None are needed where a surveyed site camera (`body = "world"` in machine.toml) sees the machine."""
    alignment: Alignment | None = None
    design: Design
    ground: Ground | None = None
    tolerance: Tolerance
    checks: Checks | None = None
    utilities: Annotated[dict[Name, Utility], Field(max_length=MAX_UTILITIES)] = {}
    """Buried lines that the cutting edge must keep away from."""
    detection: DetectionSettings = DetectionSettings()
    estimation: EstimationSettings = EstimationSettings()
    survey: SurveySettings = SurveySettings()
    report: ReportSettings = ReportSettings()

    @model_validator(mode="after")
    def _whole(self) -> Site:
        if self.alignment is None and not self.design.brings_alignment:
            raise ValueError(
                "stations need an alignment: give [alignment] points, design.alignment of a LandXML file, or "
                "design.alignment_layer of a drawing"
            )
        if self.alignment is not None:
            for key in ("profile", "alignment_layer", "start_station"):
                if getattr(self.design, key) is not None:
                    raise ValueError(
                        f"design.{key} goes with an alignment of the design's own file, but [alignment] points are "
                        "given: remove one of them"
                    )
        owner: dict[tuple[str, int], str] = {}
        for name, mark in self.benchmarks.items():
            for tag in mark.tags:
                if (other := owner.setdefault((mark.family, tag.id), name)) != name:
                    raise ValueError(
                        f"tag {tag.id} of {mark.family} stands on two benchmarks, {other} and {name}"
                    )
        for name, mark in self.benchmarks.items():
            if not mark.is_surveyed:
                continue
            shots = [mark.pose.enh] if mark.pose else [shot.enh for shot in mark.corners]
            away_m = max(float(np.linalg.norm(self.grid.to_world(np.array(enh)))) for enh in shots)
            if away_m > MAX_FROM_ORIGIN_M:
                raise ValueError(
                    f"benchmarks.{name} lies {away_m / 1000:,.0f} km from grid.origin "
                    f"(limit {MAX_FROM_ORIGIN_M / 1000:.0f} km): check the order "
                    "easting, northing, elevation, the unit, and the origin"
                )
        return self

    @model_validator(mode="after")
    def _utilities_near(self) -> Site:
        for name, utility in self.utilities.items():
            if not utility.points:
                continue
            away_m = np.linalg.norm(self.grid.to_world(np.array(utility.points)), axis=1)
            furthest = int(np.argmax(away_m))
            if away_m[furthest] > MAX_FROM_ORIGIN_M:
                raise ValueError(
                    f"utilities.{name}.points: point {furthest + 1} lies {away_m[furthest] / 1000:,.0f} km from "
                    f"grid.origin (limit {MAX_FROM_ORIGIN_M / 1000:.0f} km): check the order "
                    "easting, northing, elevation, the unit, and the origin"
                )
        return self

    @property
    def station_step_m(self) -> float:
        """Distance of the stations, metres."""
        return self.survey.station_step_m or (0.5 if self.grid.unit == "m" else 2 * self.grid.metres_per_unit)

    def benchmark_pose(self, name: str) -> Pose | None:
        """Surveyed pose of a benchmark in the world (metres), or None where corners were surveyed, or nothing."""
        pose = self.benchmarks[name].pose
        if pose is None:
            return None
        x, y, z = self.grid.to_world(np.array(pose.enh)).tolist()
        return Pose(
            xyz_m=(x, y, z),
            rpy_deg=pose.rpy_deg,
            sigma_mm=pose.sigma_mm,
            sigma_deg=pose.sigma_deg,
            covariance=pose.covariance,
        )
