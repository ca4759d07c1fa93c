"""Lens models for calibration: Brown's with five and with eight coefficients, and the fisheye, with Jacobians.

Models, order and signs are OpenCV's; the fisheye is that of Kannala and Brandt (2006). With ``x = X / Z``,
``y = Y / Z``, ``r² = x² + y²``:

    brown5    radial = 1 + k1 r² + k2 r⁴ + k3 r⁶
    brown8    radial = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    fisheye   radial = theta (1 + k1 theta² + k2 theta⁴ + k3 theta⁶ + k4 theta⁸) / r, theta = atan r

and Brown's two tangential terms beside the first two radials. The adjustment of logs knows `brown5` alone, which
`pipeline.geometry.camera` computes; what a lens needs more coefficients for shows in how far `brown5` is off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.geometry import camera

_NEWTON_STEPS = 30
_HALVINGS = 8
_SMALL_R2 = 1e-8
"""Below it the fisheye's radial term is its series: its quotients lose every digit."""

Radial = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""(r² (...), coefficients (m,)) -> radial (...), its derivative by r² (...), and by the coefficients (..., m)."""


@dataclass(frozen=True)
class Lens:
    """A lens model; intrinsics are one array ``(n,)`` in the order of `parameters`."""

    name: str
    parameters: tuple[str, ...]
    """fx fy cx cy (px), then distortion (no unit)."""
    radial: Radial
    radial_at: tuple[int, ...]
    """Which parameters `radial` takes."""
    tangential_at: tuple[int, ...]
    """p1 and p2; empty where the model has none."""

    def __len__(self) -> int:
        return len(self.parameters)

    def project(self, p_camera: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3) in the camera frame, metres; nan behind the camera."""
        return self.project_with_jacobians(p_camera, intrinsics)[0]

    def project_with_jacobians(
        self, p_camera: np.ndarray, intrinsics: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels of points, and how they move with the point and with the intrinsics.

        Parameters
        ----------
        p_camera : (..., 3) array
            Metres.
        intrinsics : (n,) array
            In the order of `parameters`.

        Returns
        -------
        uv : (..., 2) array
            Pixels; nan behind the camera.
        J_uv_p : (..., 2, 3) array
            Pixels per metre.
        J_uv_intrinsics : (..., 2, n) array
            Pixels per unit of each parameter.
        """
        p_camera = np.asarray(p_camera, dtype=np.float64)
        k = np.asarray(intrinsics, dtype=np.float64)
        z = np.where(camera.in_front(p_camera), p_camera[..., 2], np.nan)
        xy = p_camera[..., :2] / z[..., None]
        xy_distorted, J_distorted_xy, J_distorted_k = self._distorted(xy, k)
        J_uv_xy = k[:2, None] * J_distorted_xy
        J_uv_p = np.empty(J_uv_xy.shape[:-1] + (3,))
        J_uv_p[..., :2] = J_uv_xy / z[..., None, None]
        J_uv_p[..., 2] = -np.einsum("...ij,...j->...i", J_uv_p[..., :2], xy)
        return (
            camera.to_pixels(xy_distorted, k),
            J_uv_p,
            self._pixels_by_intrinsics(xy_distorted, J_distorted_k, k),
        )

    def directions(self, uv: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors of the rays that pixels look along, and how they move with the intrinsics.

        Parameters
        ----------
        uv : (..., 2) array
            Pixels.
        intrinsics : (n,) array
            In the order of `parameters`.

        Returns
        -------
        d : (..., 3) array
            Without unit, camera frame; nan where no ray leads to the pixel.
        J_d_intrinsics : (..., 3, n) array
            At a fixed pixel: by the implicit function theorem, from the Jacobians of the projection.
        """
        k = np.asarray(intrinsics, dtype=np.float64)
        xy = self.undistorted(uv, k)
        xy_distorted, J_distorted_xy, J_distorted_k = self._distorted(xy, k)
        J_uv_k = self._pixels_by_intrinsics(xy_distorted, J_distorted_k, k)
        bad = ~np.all(np.isfinite(xy), axis=-1)
        J_uv_xy = np.where(bad[..., None, None], np.eye(2), k[:2, None] * J_distorted_xy)
        J_xy_k = -np.linalg.solve(J_uv_xy, J_uv_k)
        ray = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        length = np.linalg.norm(ray, axis=-1, keepdims=True)
        d = ray / length
        J_d_xy = (np.eye(3) - d[..., :, None] * d[..., None, :])[..., :2] / length[..., None]
        return d, J_d_xy @ J_xy_k

    def undistorted(self, uv: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Normalised coordinates ``x/z, y/z`` (..., 2) of pixels; nan where no ray leads to the pixel."""
        k = np.asarray(intrinsics, dtype=np.float64)
        if self is BROWN5:
            return np.asarray(camera.undistort(uv, k))
        target = (np.asarray(uv, dtype=np.float64) - k[2:4]) / k[:2]
        if self is FISHEYE:
            return self._unbent(target, k)
        xy = target / (1 + np.sum(target**2, axis=-1, keepdims=True))  # well inside any fold
        residual, J = self._missed(xy, target, k)
        for _ in range(_NEWTON_STEPS):
            step = np.linalg.solve(np.where(np.isfinite(J), J, np.eye(2)), residual[..., None])[..., 0]
            size = np.linalg.norm(residual, axis=-1)
            waiting = size > 1e-14
            for halving in range(_HALVINGS):
                trial = np.where(waiting[..., None], xy - step * 0.5**halving, xy)
                missed, _ = self._missed(trial, target, k)
                better = waiting & (np.linalg.norm(missed, axis=-1) < size)
                xy = np.where(better[..., None], trial, xy)
                waiting = waiting & ~better
                if not np.any(waiting):
                    break
            residual, J = self._missed(xy, target, k)
        reached = np.linalg.norm(residual, axis=-1) < 1e-11 * (1 + np.linalg.norm(target, axis=-1))
        return np.where(reached[..., None], xy, np.nan)

    def _unbent(self, target: np.ndarray, k: np.ndarray) -> np.ndarray:
        """The fisheye's angle off the axis, by Newton steps on its polynomial."""
        wanted = np.linalg.norm(target, axis=-1)
        theta = np.minimum(wanted, 1.5)
        for _ in range(_NEWTON_STEPS):
            t2 = theta**2
            bent = theta * (1 + t2 * (k[4] + t2 * (k[5] + t2 * (k[6] + t2 * k[7]))))
            slope = 1 + t2 * (3 * k[4] + t2 * (5 * k[5] + t2 * (7 * k[6] + t2 * 9 * k[7])))
            theta = np.clip(theta - (bent - wanted) / np.where(slope > 1e-3, slope, np.nan), 0, 1.6)
        good = (np.abs(bent - wanted) < 1e-12) & (theta < 1.55)
        scale = np.where(wanted > 1e-12, np.tan(theta) / np.where(wanted > 1e-12, wanted, 1.0), 1.0)
        return np.where(good[..., None], target * scale[..., None], np.nan)

    def _missed(self, xy: np.ndarray, target: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        xy_distorted, J, _ = self._distorted(xy, k)
        return xy_distorted - target, J

    def _distorted(self, xy: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distorted coordinates (..., 2), their Jacobian by xy (..., 2, 2) and by all parameters (..., 2, n)."""
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial, by_r2, by_k = self.radial(r2, k[list(self.radial_at)])
        xy_distorted = xy * radial[..., None]
        J = 2 * by_r2[..., None, None] * xy[..., :, None] * xy[..., None, :]
        J[..., 0, 0] += radial
        J[..., 1, 1] += radial
        J_k = np.zeros(xy.shape + (len(self),))
        J_k[..., list(self.radial_at)] = xy[..., :, None] * by_k[..., None, :]
        if self.tangential_at:
            p1, p2 = (k[i] for i in self.tangential_at)
            a, bx, by = 2 * x * y, r2 + 2 * x * x, r2 + 2 * y * y
            xy_distorted = xy_distorted + np.stack([p1 * a + p2 * bx, p1 * by + p2 * a], axis=-1)
            mixed = 2 * (p1 * x + p2 * y)
            J[..., 0, 0] += 2 * p1 * y + 6 * p2 * x
            J[..., 0, 1] += mixed
            J[..., 1, 0] += mixed
            J[..., 1, 1] += 6 * p1 * y + 2 * p2 * x
            J_k[..., self.tangential_at[0]] = np.stack([a, by], axis=-1)
            J_k[..., self.tangential_at[1]] = np.stack([bx, a], axis=-1)
        return xy_distorted, J, J_k

    def _pixels_by_intrinsics(
        self, xy_distorted: np.ndarray, J_distorted_k: np.ndarray, k: np.ndarray
    ) -> np.ndarray:
        J = k[:2, None] * J_distorted_k
        J[..., 0, 0] = xy_distorted[..., 0]
        J[..., 1, 1] = xy_distorted[..., 1]
        J[..., 0, 2] = J[..., 1, 3] = 1.0
        return J


def _polynomial(r2: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
    by_r2 = k[0] + r2 * (2 * k[1] + r2 * 3 * k[2])
    return radial, by_r2, np.stack([r2, r2**2, r2**3], axis=-1)


def _rational(r2: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    above, above_r2, powers = _polynomial(r2, k[:3])
    below, below_r2, _ = _polynomial(r2, k[3:])
    radial = above / below
    by_r2 = (above_r2 - radial * below_r2) / below
    by_k = np.concatenate([powers, -radial[..., None] * powers], axis=-1) / below[..., None]
    return radial, by_r2, by_k


def _equidistant(r2: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    near = r2 < _SMALL_R2
    safe = np.where(near, 1.0, r2)
    r = np.sqrt(safe)
    theta = np.arctan(r)
    t2 = theta**2
    powers = np.stack([t2, t2**2, t2**3, t2**4], axis=-1)
    bent = theta * (1 + powers @ k)
    slope = 1 + powers @ (k * [3, 5, 7, 9])
    radial = bent / r
    by_r2 = (slope / (1 + safe) - radial) / (2 * safe)
    by_k = (theta / r)[..., None] * powers
    radial = np.where(near, 1 + r2 * (k[0] - 1 / 3), radial)
    by_r2 = np.where(near, k[0] - 1 / 3, by_r2)
    series = np.stack([r2, r2**2, r2**3, r2**4], axis=-1)
    return radial, by_r2, np.where(near[..., None], series, by_k)


BROWN5 = Lens("brown5", camera.INTRINSICS, _polynomial, (4, 5, 8), (6, 7))
BROWN8 = Lens("brown8", (*camera.INTRINSICS, "k4", "k5", "k6"), _rational, (4, 5, 8, 9, 10, 11), (6, 7))
FISHEYE = Lens("fisheye", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), _equidistant, (4, 5, 6, 7), ())
LENSES = {lens.name: lens for lens in (BROWN5, BROWN8, FISHEYE)}
