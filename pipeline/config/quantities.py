"""Quantities with their uncertainty, as they stand in the two TOML files."""

from __future__ import annotations

import datetime
from collections.abc import Collection, Iterator, Mapping
from typing import Annotated, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, WithJsonSchema, model_validator

from pipeline.geometry import se3, so3

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,39}$")]
Identifier = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.-]{0,59}$")]
"""Of a machine or a site. It begins with a letter, or readers of partitioned Parquet make it a number."""
PATTERNS = {
    r"^[A-Za-z][A-Za-z0-9_-]{0,39}$": "should begin with a letter and hold at most 40 letters, digits, _ and -",
    r"^[A-Za-z][A-Za-z0-9_.-]{0,59}$": "should begin with a letter and hold at most 60 letters, digits, _, . and -",
}
"""What a person is told instead of the pattern."""
Triple = tuple[float, float, float]
NonNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
SigmaTriple = tuple[NonNegative, NonNegative, NonNegative]


class Section(BaseModel):
    """A table of a TOML file: unknown keys are refused, values never change after loading."""

    # Field docstrings become descriptions in the exported JSON Schemas, which editors show.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class Calibrated(Section):
    """Where a quantity comes from; written by the commands that calibrate."""

    date: datetime.date
    """Day of the recording, not of the computing."""
    by: str = ""
    """Command that told it."""
    source: str = ""
    """Name of the log or file it was told from."""
    sha256: Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")] = ""
    """Of that file."""
    raw_range: tuple[float, float] | None = None
    """Stroke over which a sensor's curve was told, raw unit: beyond it the curve is extrapolated."""


def calibrated_in(section: Section, key: str = "") -> Iterator[tuple[str, Calibrated]]:
    """Every quantity below a section that says when it was told: its dotted key, and where it comes from."""
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, Calibrated):
            yield key, value
        elif isinstance(value, Section):
            yield from calibrated_in(value, f"{key}.{name}" if key else name)
        elif isinstance(value, Mapping):
            for inner, item in value.items():
                if isinstance(item, Section):
                    yield from calibrated_in(item, f"{key}.{name}.{inner}" if key else f"{name}.{inner}")


class UncertainPose(Section):
    """How well a pose is known: a covariance of its right perturbation, or two standard deviations."""

    sigma_mm: SigmaTriple | NonNegative | None = None
    """Standard deviation of the origin along the child's axes, millimetres; 0 means exact."""
    sigma_deg: SigmaTriple | NonNegative | None = None
    """Standard deviation of the rotation about the child's axes, degrees; 0 means exact."""
    covariance: tuple[tuple[float, ...], ...] | None = None
    """6x6 covariance of ``xi = [rho, phi]`` in m and rad instead of the two sigmas."""
    calibrated: Calibrated | None = None

    @model_validator(mode="after")
    def _one_uncertainty(self) -> Self:
        sigmas = self.sigma_mm is not None and self.sigma_deg is not None
        if sigmas == (self.covariance is not None):
            raise ValueError(
                "give either sigma_mm and sigma_deg, or covariance (6x6); a pose is not exact by default"
            )
        if self.covariance is not None:
            check_covariance(self.covariance, 6)
        return self

    def covariance_xi(self) -> np.ndarray:
        """(6, 6) covariance of ``xi = [rho, phi]``, m² and rad²."""
        if self.covariance is not None:
            return np.array(self.covariance)
        assert self.sigma_mm is not None and self.sigma_deg is not None
        sigma = np.concatenate(
            [np.broadcast_to(self.sigma_mm, 3) / 1000.0, np.deg2rad(np.broadcast_to(self.sigma_deg, 3))]
        )
        return np.diag(sigma**2)


class Pose(UncertainPose):
    """A calibrated rigid pose ``T_parent_child`` with the covariance of its right perturbation."""

    xyz_m: Triple
    """Origin of the child in the parent, metres."""
    rpy_deg: Triple
    """Roll, pitch, yaw in degrees: ``R = Rz(yaw) @ Ry(pitch) @ Rx(roll)``."""

    def transform(self) -> np.ndarray:
        """``T_parent_child``, (4, 4)."""
        return se3.from_rotation_translation(so3.from_rpy_deg(np.array(self.rpy_deg)), np.array(self.xyz_m))


def check_covariance(rows: tuple[tuple[float, ...], ...], size: int) -> None:
    """Raise ValueError unless `rows` is a symmetric positive semi-definite size x size matrix."""
    if len(rows) != size or any(len(row) != size for row in rows):
        raise ValueError(f"covariance must be {size}x{size}")
    matrix = np.array(rows)
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
        raise ValueError("covariance must be symmetric")
    if np.linalg.eigvalsh(matrix)[0] < -1e-9 * max(np.trace(matrix), 1e-30):
        raise ValueError("covariance must have no negative eigenvalue")


class Tag(Section):
    """One printed tag on a marker, lying in the marker's plane with its axes along the marker's."""

    id: Annotated[int, Field(ge=0, le=100_000)]
    size_m: Positive
    """Outer side of the black border, metres (tagStandard families: the side between the detected corners)."""
    x_m: float = 0.0
    """Centre of the tag in the marker frame, x to the right on the print, metres."""
    y_m: float = 0.0
    """Centre of the tag in the marker frame, y up on the print, metres."""

    def corners(self) -> np.ndarray:
        """(4, 3) corners in the marker frame, order (-,+) (+,+) (+,-) (-,-): TL TR BR BL of the print."""
        signs = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
        return np.array([self.x_m, self.y_m, 0.0]) + 0.5 * self.size_m * signs


FAMILIES = {
    "tag36h11": 587,
    "tag25h9": 35,
    "tag16h5": 30,
    "tagStandard41h12": 2115,
    **{f"DICT_{n}X{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_ARUCO_MIP_36h12": 250,
}
"""Family -> how many tags it has; their ids run from 0. AprilTag's by their own names, ArUco's by OpenCV's."""
ALSO_CALLED = {
    "DICT_APRILTAG_36h11": "tag36h11",
    "DICT_APRILTAG_25h9": "tag25h9",
    "DICT_APRILTAG_16h5": "tag16h5",
}
"""What OpenCV calls families that have a name here already; two names would make two families of one."""


def dictionary_of(family: str) -> str:
    """The table a family's tags are taken from: DICT_4X4_50 is the beginning of DICT_4X4, as is DICT_4X4_1000."""
    stem, _, count = family.rpartition("_")
    return stem if count.isdigit() else family


def smallest_family(family: str, tag_ids: Collection[int]) -> str:
    """The smallest of the families of the same table that has all of some ids."""
    parts = [other for other in FAMILIES if dictionary_of(other) == dictionary_of(family)]
    return min((other for other in parts if FAMILIES[other] > max(tag_ids)), key=FAMILIES.__getitem__)


def _known_family(name: str) -> str:
    if name not in FAMILIES:
        same = {other.lower(): meant for other, meant in [*ALSO_CALLED.items(), *zip(FAMILIES, FAMILIES)]}
        if meant := same.get(name.lower()):
            raise ValueError(f"should be written {meant!r}")
        apriltag = [family for family in FAMILIES if not family.startswith("DICT_")]
        aruco = [family for family in FAMILIES if family.startswith("DICT_")]
        raise ValueError(f"should be one of {', '.join(apriltag)}, or OpenCV's {', '.join(aruco)}")
    return name


Family = Annotated[
    str, AfterValidator(_known_family), WithJsonSchema({"type": "string", "enum": list(FAMILIES)})
]
"""Which tags are printed on a marker."""


class Print(Section):
    """What is printed on a marker: the family and the layout of its tags."""

    family: Family
    tags: Annotated[tuple[Tag, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _ids_differ(self) -> Print:
        ids = [tag.id for tag in self.tags]
        if len(set(ids)) != len(ids):
            raise ValueError(
                f"the same tag id stands twice on one marker: {sorted(i for i in set(ids) if ids.count(i) > 1)}"
            )
        if max(ids) >= FAMILIES[self.family]:
            raise ValueError(
                f"{self.family} has the ids 0 to {FAMILIES[self.family] - 1}, there is no tag {max(ids)} in it"
            )
        return self
