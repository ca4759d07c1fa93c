"""Errors of calibration and survey: what the files say, drawn so that the truth is as far off as they claim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import se3
from pipeline.synthetic.excavator import Mounts
from pipeline.synthetic.specification import Specification


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of the elements of `Mounts`, in metres, radians, pixels and the curve's units."""

    camera: np.ndarray
    """(6,) of ``xi``."""
    intrinsics: np.ndarray
    """(9,)."""
    benchmark: np.ndarray
    stick_marker: np.ndarray
    axis: np.ndarray
    tool: np.ndarray
    linkage: np.ndarray
    """(8,)."""
    curves: dict[str, np.ndarray]
    time_offsets: dict[str, float]


def uncertainty(spec: Specification) -> Uncertainty:
    """The standard deviations that the files of a site state."""
    s = spec.sigmas

    def pose(millimetres: float, degrees: float) -> np.ndarray:
        return np.repeat([millimetres / 1000, np.deg2rad(degrees)], 3)

    # A lens is calibrated to the same angles whatever the number of pixels.
    scale = spec.focal / 850.0
    focal, centre = s.focal_px * scale, s.centre_px * scale
    curves = {}
    for sensor in spec.sensors:
        if sensor.kind == "potentiometer":
            curves[sensor.name] = np.array([s.curve_zero, s.curve_scale, s.curve_scale / 8])
        elif sensor.kind == "encoder":
            curves[sensor.name] = np.array([200 * s.curve_zero, 0.01])
        else:
            curves[sensor.name] = np.array([200 * s.curve_zero, 1e-5])
    return Uncertainty(
        camera=pose(s.camera_mm, s.camera_deg),
        intrinsics=np.array([focal, focal, centre, centre, *s.distortion]),
        benchmark=pose(s.benchmark_mm, s.benchmark_deg),
        stick_marker=pose(s.marker_mm, s.marker_deg),
        axis=pose(s.axis_mm, s.axis_deg),
        tool=pose(s.tool_mm, s.tool_deg),
        linkage=np.append(np.full(7, s.linkage_mm / 1000), np.deg2rad(s.horn_deg)),
        curves=curves,
        time_offsets={sensor.name: sensor.sigma_time_offset_s for sensor in spec.sensors},
    )


def file_mounts(truth: Mounts, sigma: Uncertainty, rng: np.random.Generator) -> Mounts:
    """What calibration and survey found: the truth less one draw from each stated covariance.

    ``T_true = T_file @ exp(xi)`` with ``xi`` drawn, as the files' covariances are meant.
    """

    def pose(T: np.ndarray, sigma_xi: np.ndarray) -> np.ndarray:
        return T @ se3.exp(-rng.normal(size=6) * sigma_xi)

    def vector(v: np.ndarray, sigma_v: np.ndarray) -> np.ndarray:
        return v - rng.normal(size=len(v)) * sigma_v

    return Mounts(
        cameras={name: pose(T, sigma.camera) for name, T in truth.cameras.items()},
        intrinsics={name: vector(v, sigma.intrinsics) for name, v in truth.intrinsics.items()},
        benchmarks={name: pose(T, sigma.benchmark) for name, T in truth.benchmarks.items()},
        stick_marker=pose(truth.stick_marker, sigma.stick_marker),
        axis=pose(truth.axis, sigma.axis),
        tool=pose(truth.tool, sigma.tool),
        linkage=vector(truth.linkage, sigma.linkage),
        curves={name: vector(v, sigma.curves[name]) for name, v in truth.curves.items()},
        time_offsets={
            name: float(v - rng.normal() * sigma.time_offsets[name]) for name, v in truth.time_offsets.items()
        },
    )
