"""Buckets with a drawn truth: touches of one point, with every error drawn from the covariance that is stated."""

from dataclasses import dataclass

import numpy as np

from pipeline.calibration.touches import Rig, Stand, Touch
from pipeline.geometry import linkage, se3, so3

BARS = np.array([-1.55, 0.30, -0.28, 0.0, 0.46, 0.40, 0.32, np.deg2rad(130.0), 0.0])
CURVES = {"cylinder_m": np.array([0.7874, 0.1846, 0.0004]), "angle_deg": np.array([-171.3, 360 / 8192])}
NOISE = {"cylinder_m": 0.0006, "angle_deg": 0.3}
POINT_M, CONTACT_M = 0.002, 0.001


@dataclass
class Drawn:
    rig: Rig
    stands: list
    touches: list
    points: dict
    curve: np.ndarray
    bars: np.ndarray
    T_tool: np.ndarray

    def direction(self, raw):
        """True direction of the edge at readings, radians."""
        y = np.polynomial.polynomial.polyval(np.asarray(raw, float), self.curve)
        angle = linkage.bucket_angle(y, self.bars, 1) if self.rig.output == "cylinder_m" else np.deg2rad(y)
        return angle + np.arctan2(self.T_tool[1, 3], self.T_tool[0, 3])

    @property
    def radius(self):
        return float(np.hypot(*self.T_tool[:2, 3]))

    def nodes(self, count=9):
        raw = [s.raw for s in self.stands]
        return np.linspace(min(raw), max(raw), count)


def tool_frame():
    """The edge along the pin, to the operator's right; the teeth along z, 1.25 m from the pin."""
    teeth = np.deg2rad(-42.0)
    z, x = np.array([np.cos(teeth), np.sin(teeth), 0.0]), np.array([0.0, 0.0, 1.0])
    return se3.from_rotation_translation(np.stack([x, np.cross(z, x), z], axis=-1), np.array([1.25, 0, 0]))


def drawn(seed, output="cylinder_m", count=8, span_deg=(-150.0, -8.0), scale=1.0, edge_point="middle"):
    """A rig and its touches; ``scale`` 0 draws no error at all, the covariances stay."""
    rng = np.random.default_rng(seed)
    bars_cov = np.diag(np.append(np.full(7, 0.25e-3), [np.deg2rad(0.03), 0.0])) ** 2
    axis_cov = np.diag([0.6e-3] * 3 + [np.deg2rad(0.03)] * 2 + [0.0]) ** 2
    tool_cov = np.diag([1e-3] * 3 + [np.deg2rad(0.1)] * 3) ** 2
    own = np.diag([1.5e-3] * 3 + [np.deg2rad(0.03)] * 3) ** 2
    curve = CURVES[output]
    rig = Rig(axis_cov, tool_frame(), tool_cov, 1.0, output, len(curve), BARS, bars_cov)

    def draw(covariance):
        return scale * rng.standard_normal(len(covariance)) * np.sqrt(np.diag(covariance))

    bars = BARS + (draw(bars_cov) if output == "cylinder_m" else 0.0)
    T_tool = se3.retract(tool_frame(), draw(tool_cov))
    axis = draw(axis_cov)
    angle = np.linspace(*np.deg2rad(span_deg), count)
    y = linkage.cylinder_length(angle, bars, 1) if output == "cylinder_m" else np.rad2deg(angle)
    raw = np.array([min(np.roots([*curve[:0:-1], curve[0] - v]), key=abs).real for v in y])
    point = np.array([50.0, 40.0, 3.0])
    true_point = point + scale * POINT_M * rng.standard_normal(3)
    response = np.vstack([2e-3 * rng.standard_normal((3, 6)), np.deg2rad(0.03) * rng.standard_normal((3, 6))])
    shared = scale * rng.standard_normal(6)
    stands, touches = [], []
    half = {"left": -0.5, "right": 0.5}.get(edge_point, 0.0)
    for k in range(count):
        factors = response * (1 + 0.3 * np.sin(k))
        R = so3.exp(np.array([np.pi / 2, 0, 0])) @ so3.exp(np.array([0, 0, rng.uniform(-1.2, -0.3)]))
        turn = se3.from_rotation_translation(so3.exp(np.array([0, 0, angle[k]])), np.zeros(3))
        T = se3.from_rotation_translation(R, np.zeros(3))
        edge = se3.transform(T @ se3.exp(axis) @ turn @ T_tool, np.array([half, 0.0, 0.0]))
        T[:3, 3] = true_point + scale * CONTACT_M * rng.standard_normal(3) - edge
        off = draw(own) + factors @ shared  # along and about the world's axes
        told = se3.from_rotation_translation(so3.exp(-off[3:]) @ R, T[:3, 3] - off[:3])
        noise = NOISE[output]
        reading = raw[k] + scale * noise * rng.standard_normal()
        stands.append(Stand(f"t{k}", told, own, factors, float(reading), noise))
        touches.append(Touch(f"touch {k}", k, point.copy(), CONTACT_M, 0, edge_point))
    return Drawn(rig, stands, touches, {"TP1": POINT_M}, curve, bars, T_tool)
