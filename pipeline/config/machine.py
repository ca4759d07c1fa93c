"""`machine.toml`: one excavator, its bodies, cameras, markers, sensors and cutting edge."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from pipeline.config.quantities import (
    Calibrated,
    Identifier,
    Name,
    NonNegative,
    Pose,
    Positive,
    Print,
    Section,
    check_covariance,
)
from pipeline.errors import ConfigError

FORMAT = "gradetrace/machine/1"


class MachineIdentity(Section):
    id: Identifier
    name: str = ""


class MovingBody(Section):
    """A body with one free pose per epoch."""

    kind: Literal["moving"]


class Belt(Section):
    """A timing belt or gear that turns a joint with another one, as the paper's flip marker (Fig. 5)."""

    joint: Name
    """The joint that drives this one; both turn about axes of their own."""
    ratio: Annotated[float, Field(ge=-1, le=1)] = 1.0
    """Turn of this joint per turn of that one: teeth over teeth, so exact; negative if they turn against each other.
    What the belt is off by when it is put on is an error of this joint's `axis` about z: state it in its `sigma_deg`.
    A faster marker (beyond 1) would leave the driving angle ambiguous by a part of a turn."""

    @model_validator(mode="after")
    def _turns(self) -> Belt:
        if self.ratio == 0:
            raise ValueError("ratio 0 would not turn at all; give teeth over teeth, at most 1")
        return self


class JointBody(Section):
    """A body that turns about an axis of its parent; one angle per epoch."""

    kind: Literal["joint"]
    parent: Name
    axis: Pose
    """``T_parent_axis``: the child turns about the z axis of this frame; at angle 0 the child frame equals it."""
    follows: Belt | None = None
    """Left out: the joint has an angle of its own. Given: its angle is that of another joint times the belt's ratio."""


class StaticBody(Section):
    """A body with one unknown pose in the world for the whole log (a site camera's tripod)."""

    kind: Literal["static"]
    pose: Pose | None = None
    """``T_world_body`` if it was surveyed; without it the log must tell."""


Body = Annotated[MovingBody | JointBody | StaticBody, Field(discriminator="kind")]


class Intrinsics(Section):
    """Pinhole with Brown distortion (OpenCV's model and order)."""

    width: Annotated[int, Field(ge=16, le=20_000)]
    height: Annotated[int, Field(ge=16, le=20_000)]
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2 k3."""
    sigma: tuple[NonNegative, ...] | None = None
    """Nine standard deviations: fx fy cx cy (px) k1 k2 p1 p2 k3."""
    covariance: tuple[tuple[float, ...], ...] | None = None
    """9x9, same order, instead of sigma."""
    calibrated: Calibrated | None = None

    @model_validator(mode="after")
    def _one_uncertainty(self) -> Intrinsics:
        if (self.sigma is None) == (self.covariance is None):
            raise ValueError("give either sigma (fx fy cx cy k1 k2 p1 p2 k3) or covariance (9x9)")
        if self.sigma is not None and len(self.sigma) != 9:
            raise ValueError(
                f"sigma needs nine numbers (fx fy cx cy k1 k2 p1 p2 k3), found {len(self.sigma)}"
            )
        if self.covariance is not None:
            check_covariance(self.covariance, 9)
        return self

    def vector(self) -> np.ndarray:
        """(9,) fx fy cx cy k1 k2 p1 p2 k3."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])

    def covariance_matrix(self) -> np.ndarray:
        """(9, 9)."""
        if self.covariance is not None:
            return np.array(self.covariance)
        assert self.sigma is not None
        return np.diag(np.square(self.sigma))


class Camera(Section):
    topic: str
    """Topic of its images in the log."""
    body: Name = "world"
    """The body that carries it; `world` for a site camera whose mount is its surveyed pose in the world."""
    mount: Pose | None = None
    """``T_body_camera``; camera axes x right, y down, z forward. Left out: unknown, the log must tell."""
    intrinsics: Intrinsics | None = None
    """Left out: taken from the log's camera calibration topic, with `intrinsics_sigma`."""
    calibration_topic: str | None = None
    """Topic of `foxglove.CameraCalibration` or ROS 2 `CameraInfo`, used when `intrinsics` is left out."""
    intrinsics_sigma: tuple[NonNegative, ...] | None = None
    """Nine standard deviations that go with a calibration taken from the log, which carries none."""


class Marker(Print):
    body: Name
    mount: Pose | None = None
    """``T_body_marker``; marker axes x right, y up, z out of the print. Left out: unknown, the log must tell."""


class Curve(Section):
    """Polynomial from raw reading to what is measured: ``y = c0 + c1 raw + c2 raw² ...``."""

    output: Literal["cylinder_m", "angle_deg"]
    coefficients: Annotated[tuple[float, ...], Field(min_length=2, max_length=5)]
    sigma: tuple[NonNegative, ...] | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    raw_range: tuple[float, float] | None = None
    """Calibrated range of the raw reading; readings outside are dropped and counted."""
    calibrated: Calibrated | None = None

    @model_validator(mode="after")
    def _one_uncertainty(self) -> Curve:
        if (self.sigma is None) == (self.covariance is None):
            raise ValueError("give either sigma (one per coefficient) or covariance")
        if self.sigma is not None and len(self.sigma) != len(self.coefficients):
            raise ValueError("sigma needs one number per coefficient")
        if self.covariance is not None:
            check_covariance(self.covariance, len(self.coefficients))
        return self

    def covariance_matrix(self) -> np.ndarray:
        if self.covariance is not None:
            return np.array(self.covariance)
        assert self.sigma is not None
        return np.diag(np.square(self.sigma))


class Linkage(Section):
    """Four-bar linkage from cylinder length to bucket angle, in the plane of the stick.

    x and y are those of the joint's axis frame: the bucket's pin is the origin and z its axis.
    """

    cylinder_anchor_m: tuple[float, float]
    rocker_pivot_m: tuple[float, float]
    rocker_m: Positive
    coupler_m: Positive
    horn_m: Positive
    horn_angle_deg: float
    """Direction of the horn (pin to coupler) in the bucket's own frame."""
    branch: Literal[-1, 1] = 1
    """Which of the two ways the linkage is assembled; see `pipeline.geometry.linkage`."""
    sigma_mm: NonNegative
    """Standard deviation of each length and coordinate."""
    sigma_horn_angle_deg: NonNegative
    calibrated: Calibrated | None = None


class Sensor(Section):
    """A reading that follows one joint."""

    topic: str
    field: str = "value"
    """Field of the sample, or the joint's name in a JointStates message (position is read)."""
    joint: Name
    curve: Curve
    linkage: Linkage | None = None
    noise: Positive
    """Standard deviation of one raw reading, quantisation included, in the raw unit."""
    time_offset_s: float = 0.0
    """True time of a sample minus its stamp, seconds, where the log begins."""
    sigma_time_offset_s: NonNegative = 0.0
    clock_drift_ppm: float = 0.0
    """How much the time offset grows over the log: microseconds a second; 1 is 3.6 ms an hour."""
    sigma_clock_drift_ppm: NonNegative = 0.0

    @model_validator(mode="after")
    def _linkage_goes_with_length(self) -> Sensor:
        if (self.curve.output == "cylinder_m") != (self.linkage is not None):
            raise ValueError(
                "a curve in cylinder_m needs a linkage, and a curve in angle_deg must not have one"
            )
        return self


class Wear(Section):
    date: datetime.date
    wear_mm: NonNegative
    """Shortening of the teeth since the mount was measured, along the tool's z."""
    sigma_mm: NonNegative


class CuttingEdge(Section):
    body: Name
    mount: Pose
    """``T_body_tool``: origin in the middle of the edge, x along it from left to right as the operator sees it,
    z along the teeth, outward."""
    width_m: Positive
    wear: tuple[Wear, ...] = ()


class Motion(Section):
    """Spectral densities of white-noise acceleration, one body."""

    translation: Positive = 0.3
    """m²/s³ per axis."""
    rotation: Positive = 0.03
    """rad²/s³ per axis; a joint uses this one, and 1.0 unless it is given."""


class Machine(Section):
    """One excavator."""

    format: Literal["gradetrace/machine/1"]
    machine: MachineIdentity
    bodies: Annotated[dict[Name, Body], Field(min_length=1)]
    cameras: Annotated[dict[Name, Camera], Field(min_length=1)]
    markers: dict[Name, Marker] = {}
    sensors: dict[Name, Sensor] = {}
    cutting_edge: CuttingEdge
    motion: dict[Name, Motion] = {}
    """By body; the defaults serve an excavator that digs."""

    @model_validator(mode="after")
    def _names_exist(self) -> Machine:
        if "world" in self.bodies or "tool" in self.bodies:
            raise ValueError("'world' and 'tool' are reserved: choose another name for the body")
        known = set(self.bodies) | {"world"}
        uses = [(f"cameras.{n}.body", c.body) for n, c in self.cameras.items()]
        uses += [(f"markers.{n}.body", m.body) for n, m in self.markers.items()]
        uses += [(f"bodies.{n}.parent", b.parent) for n, b in self.bodies.items() if isinstance(b, JointBody)]
        uses += [("cutting_edge.body", self.cutting_edge.body)]
        uses += [(f"motion.{n}", n) for n in self.motion]
        for key, body in uses:
            if body not in known:
                raise ValueError(
                    f"{key} names body '{body}', which is not in [bodies]: known are {sorted(known)}"
                )
        for name, sensor in self.sensors.items():
            if not isinstance(self.bodies.get(sensor.joint), JointBody):
                raise ValueError(
                    f"sensors.{name}.joint names '{sensor.joint}', which is no body of kind 'joint'"
                )
            self._refuse_driven(f"sensors.{name}.joint", sensor.joint)
        for name, driven in self.bodies.items():
            if isinstance(driven, JointBody) and driven.follows is not None:
                key, driver = f"bodies.{name}.follows.joint", driven.follows.joint
                if not isinstance(self.bodies.get(driver), JointBody):
                    raise ValueError(f"{key} names '{driver}', which is no body of kind 'joint'")
                self._refuse_driven(key, driver)
        for name in self.bodies:
            seen, at = {name}, name
            while isinstance(body_ := self.bodies.get(at), JointBody):
                at = body_.parent
                if at in seen:
                    raise ValueError(f"bodies.{name}: its parents run in a circle")
                seen.add(at)
        return self

    def _refuse_driven(self, key: str, joint: str) -> None:
        body = self.bodies[joint]
        if isinstance(body, JointBody) and body.follows is not None:
            raise ValueError(
                f"{key} names '{joint}', which has no angle of its own: name '{body.follows.joint}', which it follows"
            )

    def with_calibrations(self, calibrations: Mapping[str, Mapping[str, Any]], source: str) -> Machine:
        """This machine with the intrinsics that it leaves out taken from the log.

        Parameters
        ----------
        calibrations : mapping
            Camera -> topic, width, height, fx, fy, cx, cy and distortion (k1 k2 p1 p2 k3), as the log has them.
        source : str
            How messages call the machine file.

        Raises
        ------
        ConfigError
            A camera has intrinsics neither here nor in the log, or no standard deviations to go with those of the log.
        """
        cameras = {}
        for name, camera in self.cameras.items():
            if camera.intrinsics is None:
                if name not in calibrations:
                    raise ConfigError(
                        f"{source}: camera '{name}' has no intrinsics: there is no [cameras.{name}.intrinsics], and no "
                        f"calibration in the log on {camera.calibration_topic or 'any topic'}; calibrate it"
                    )
                if camera.intrinsics_sigma is None:
                    raise ConfigError(
                        f"{source}: camera '{name}' takes its intrinsics from the log, which has no standard "
                        f"deviations; add cameras.{name}.intrinsics_sigma (nine numbers: fx fy cx cy k1 k2 p1 p2 k3)"
                    )
                values = {key: calibrations[name][key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
                topic = calibrations[name].get("topic", "unknown topic")
                try:
                    intrinsics = Intrinsics(
                        **values,
                        distortion=tuple(calibrations[name]["distortion"]),
                        sigma=camera.intrinsics_sigma,
                    )
                except ValidationError as error:
                    raise ConfigError(
                        f"camera '{name}': the calibration in the log ({topic}) cannot "
                        f"be used: {error.errors()[0]['msg']}; add [cameras.{name}.intrinsics] to {source}"
                    ) from None
                camera = camera.model_copy(update={"intrinsics": intrinsics})
            cameras[name] = camera
        return self.model_copy(update={"cameras": cameras})
