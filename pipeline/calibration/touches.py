"""What a bucket is calibrated with and what comes of it: the rig, stands, touches, and the adjusted unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import linkage, se3

AXIS, TOOL, BARS = slice(0, 6), slice(6, 12), slice(12, 21)
"""Places among the unknowns with a prior; the curve follows, then shared errors, then known points."""
CURVE_FROM = 21


@dataclass(frozen=True, eq=False)
class Rig:
    """What machine.toml says of stick, bucket and sensor."""

    axis: np.ndarray
    """(6, 6) prior covariance of the pin's frame on the stick, right perturbation, the turn about z exact."""
    T_bucket_tool: np.ndarray
    """(4, 4)."""
    tool: np.ndarray
    """(6, 6) its prior covariance."""
    width_m: float
    """Of the cutting edge."""
    output: str
    """`cylinder_m`, or `angle_deg` for a sensor without linkage."""
    coefficients: int
    """Of the curve."""
    bars: np.ndarray
    """(9,) in the order of `linkage.PARAMETERS`, the last one 0; not used for `angle_deg`."""
    bars_covariance: np.ndarray
    """(9, 9)."""
    side: int = 1
    """Which way round the linkage is built."""
    curve: tuple[np.ndarray, np.ndarray] | None = None
    """Coefficients over the raw reading and their covariance, where the curve is known and not asked for."""


@dataclass(frozen=True, eq=False)
class Stand:
    """The machine at rest at one bucket angle."""

    name: str
    T_world_axis: np.ndarray
    """(4, 4) the pin's frame on the stick, mean over the rest."""
    own: np.ndarray
    """(6, 6) what no other stand shares: error along and about the world's axes, m² and rad²."""
    factors: np.ndarray
    """(6, r) response to the r independent errors of unit variance that all stands share."""
    raw: float
    """Mean reading."""
    raw_sigma: float


@dataclass(frozen=True, eq=False)
class Touch:
    """One place of the edge whose coordinates are known."""

    name: str
    stand: int
    """Index of the stand; several touches may share one."""
    p_world: np.ndarray
    """(3,) metres."""
    sigma_m: float
    """Of each coordinate, this touch alone: shot, or how well the tooth sits on the point."""
    point: int = -1
    """Index of the known point, whose own error all its touches share; -1 for a shot of its own."""
    edge_point: str = "middle"
    """left, middle, right, or empty: anywhere along the edge, and nothing is told along it."""
    by_time: bool = True
    """False where only its place says that this was a touch: the edge may as well have hovered nearby."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The answer, with everything that is needed to judge it."""

    rig: Rig
    stands: tuple[Stand, ...]
    touches: tuple[Touch, ...]
    middle: float
    """Raw reading at ``u = 0``."""
    half: float
    """Raw unit per unit of ``u``."""
    value: np.ndarray
    """(p,) unknowns: axis 6, tool 6, bars 9, curve over u, shared errors, known points 3 each."""
    covariance: np.ndarray
    """(p, p)."""
    residual: np.ndarray
    """(n, 3) given minus adjusted point, world axes, metres."""
    J: np.ndarray
    """(3n, p) of the adjusted points."""
    noise: np.ndarray
    """(3n, 3n) covariance of what the unknowns do not explain."""
    factors: int
    """Number of shared errors."""
    mean: np.ndarray
    """(p,) of the priors: 0, but for a curve that is known."""
    pull: float = 0.0
    """Sum of squares of the unknowns against their priors, the curve's left out."""

    @property
    def curve(self) -> slice:
        """Places of the curve's coefficients over u."""
        return slice(CURVE_FROM, CURVE_FROM + self.rig.coefficients)

    def T_bucket_tool(self) -> np.ndarray:
        """(4, 4) adjusted."""
        return se3.retract(self.rig.T_bucket_tool, self.value[TOOL])

    def output(self, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cylinder length (m) or angle (deg) at readings (n,), and (n, coefficients) its Jacobian."""
        powers = self.powers(raw)
        return powers @ self.value[self.curve], powers

    def powers(self, raw: np.ndarray) -> np.ndarray:
        """(n, coefficients) powers of u."""
        u = (np.asarray(raw, float) - self.middle) / self.half
        return u[..., None] ** np.arange(self.rig.coefficients)

    def angle(self, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle of the bucket at readings (n,), radians, nan beyond the bars' reach; and (n, p) its Jacobian."""
        y, powers = self.output(raw)
        J = np.zeros((len(y), len(self.value)))
        angle, J_y, J_bars = angle_of(self.rig, y, self.value[BARS])
        J[:, BARS] = J_bars
        J[:, self.curve] = J_y[:, None] * powers
        return angle, J

    def chi_square(self) -> tuple[float, int]:
        """Weighted sum of squares of residuals and priors, and the redundancy that it should be near."""
        v = self.residual.ravel()
        told = sum(3 if touch.edge_point else 2 for touch in self.touches)
        free = self.rig.coefficients if self.rig.curve is None else 0
        return float(v @ np.linalg.solve(self.noise, v)) + self.pull, told - free


def angle_of(rig: Rig, y: np.ndarray, d_bars: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angle (n,) of the bucket from what the curve gives, radians, with J_angle_y (n,) and J_angle_bars (n, 9)."""
    if rig.output == "cylinder_m":
        return linkage.bucket_angle_with_jacobians(y, rig.bars + d_bars, rig.side)
    return np.deg2rad(y), np.full(len(y), np.deg2rad(1.0)), np.zeros((len(y), 9))


def powers_of_raw(count: int, middle: float, half: float) -> np.ndarray:
    """(count, count) takes coefficients of powers of ``(raw - middle) / half`` to those of powers of ``raw``."""
    out = np.zeros((count, count))
    row = np.array([1.0])
    for k in range(count):
        out[: len(row), k] = row
        row = np.polynomial.polynomial.polymul(row, [-middle / half, 1.0 / half])
    return out
