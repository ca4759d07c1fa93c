"""Logs made to calibrate with: the sample's machine before a ring of surveyed boards, and waving its arm.

On `calibration-cluster` it stands and swings from stop to stop, so that either camera looks at boards all the time and
both look at the same ones in turn. On `calibration-mounts` it stands still and moves stick and bucket; the bucket
carries a board as well. Both are the very machine of the sample of the same seed; its machine.toml says of what is to
be calibrated only what a tape measure tells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry import se3, so3
from pipeline.synthetic import recording, specification
from pipeline.synthetic.cycle import Poses, Sweep
from pipeline.synthetic.draws import Uncertainty, uncertainty
from pipeline.synthetic.excavator import Mounts, Place, board, facing
from pipeline.synthetic.renderer import Renderer
from pipeline.synthetic.scenery import board_texture
from pipeline.synthetic.specification import BenchmarkPlan, BoardPlan, Specification
from pipeline.synthetic.view import View

CLUSTER, MOUNTS = "calibration-cluster", "calibration-mounts"
NAMES = (CLUSTER, MOUNTS)
FIRST_ID = 40
RING = (
    (-148.0, 7.6, 2.2), (-121.0, 6.0, 1.4), (-97.0, 7.2, 3.0), (-76.0, 5.6, 1.2), (-52.0, 7.4, 2.9),
    (-27.0, 6.2, 1.5), (0.0, 7.8, 2.8), (26.0, 6.4, 1.6), (52.0, 7.2, 2.6),
)  # fmt: skip
"""Boards about the machine: azimuth against the tracks (left positive, deg), distance, height above the ground (m)."""
TAG_M, GAP_M = 0.45, 0.08
STOPS_DEG = (-45.0, -32.0, -19.0, -6.0, 8.0, 21.0, 34.0, 45.0, 27.0, 14.0, 1.0, -13.0, -26.0, -38.0)
"""Where the swing stops."""
REST_S, TURN_S = 2.0, 1.5
STAND_S, WAVE_S = 6.0, 48.0
"""It stands first, while its pin is shot, and waves then."""
BUCKET_BOARD = BoardPlan("bucket-board", 80, 2, 2, 0.20, 0.05, 0.04)
BUCKET_MARKER = (0.45, 0.30, -0.72)
"""Centre of the bucket's board in the bucket frame."""
TAPE_MM, TAPE_DEG = 15.0, 1.0
"""What a tape measure and a level tell of a mount, one sigma."""


@dataclass(frozen=True)
class CalibrationSite:
    """A log to calibrate with, before it is rendered."""

    spec: Specification
    seed: int
    truth: Mounts
    files: Mounts
    sigma: Uncertainty
    motion: Standing
    bucket_marker: np.ndarray | None
    """True ``T_bucket_marker`` of the board on the bucket; None where there is none."""


class Standing:
    """A machine on one spot: it swings from stop to stop, or waves its arm."""

    def __init__(self, spec: Specification, waving: bool, rng: np.random.Generator):
        self.spec, self.waving = spec, waving
        self.place = Place(spec)
        self.sweeps = [Sweep(1e9, spec.first_station)]  # it never digs
        self.station = spec.first_station + spec.axis_reach
        self.lean = rng.normal(0.0, 0.004, 2)
        self.stops = np.deg2rad(np.array(STOPS_DEG) + rng.uniform(-3, 3, len(STOPS_DEG)))
        self.phase = rng.uniform(0.0, 2 * np.pi, 3)
        self.duration_s = STAND_S + WAVE_S if waving else len(STOPS_DEG) * (REST_S + TURN_S)

    @property
    def heading_rad(self) -> float:
        return float(self.place.bearing_rad + np.pi)

    def floor(self, station: np.ndarray) -> np.ndarray:
        return np.full(np.shape(station), self.spec.ground)

    def poses(self, t: np.ndarray) -> Poses:
        """Poses of all bodies at times (n,), seconds."""
        t = np.asarray(t, float)
        swing = np.zeros_like(t) if self.waving else self._swing(t)
        R = so3.from_rpy_deg(np.array([0.0, 0.0, np.rad2deg(self.heading_rad)]))
        R = R @ so3.exp(np.array([*self.lean, 0.0]))
        turn = so3.exp(np.stack([0 * t, 0 * t, swing], axis=-1))
        position = self.place.point(self.station, 0.0, self.spec.ground - 0.02)
        T = se3.from_rotation_translation(R @ turn, np.broadcast_to(position, (len(t), 3)))
        a, b, c = self.phase
        u = t - STAND_S
        # From rest to its pace within a second, without a jump of acceleration.
        w = np.where(u < 0, 0.0, np.where(u < 1, u**3 - u**4 / 2, u - 0.5))
        if not self.waving:
            stick = np.full_like(t, -75.0)
            return Poses(t, T, np.full_like(t, np.deg2rad(28.0)), np.deg2rad(stick), np.deg2rad(stick - 60.0))
        boom = 18.5 + 4.0 * np.sin(2 * np.pi * w / 23.0 + a)
        stick = -62.0 + 16.0 * np.sin(2 * np.pi * w / 17.0 + b)
        joint = -72.0 + 52.0 * np.sin(2 * np.pi * w / 13.0 + c)
        return Poses(t, T, np.deg2rad(boom), np.deg2rad(stick), np.deg2rad(stick + joint))

    def _swing(self, t: np.ndarray) -> np.ndarray:
        step = np.clip(t / (REST_S + TURN_S), 0.0, len(self.stops) - 1e-9)
        k = step.astype(int)
        x = np.clip(((step - k) * (REST_S + TURN_S) - REST_S) / TURN_S, 0.0, 1.0)
        blend = x**3 * (10 - 15 * x + 6 * x * x)
        after = self.stops[np.minimum(k + 1, len(self.stops) - 1)]
        return self.stops[k] + blend * (after - self.stops[k])


def calibration_site(name: str, seed: int) -> CalibrationSite:
    """The machine of the sample of this seed, as it is recorded for a calibration.

    Parameters
    ----------
    name : str
        `calibration-cluster` or `calibration-mounts`.
    seed : int
        Of the machine, as for the sample, and of what the files say.
    """
    assert name in NAMES, name
    waving = name == MOUNTS
    sample = specification.trench()
    built = recording.world(sample, seed)
    rough = replace(sample.sigmas, camera_mm=TAPE_MM, camera_deg=TAPE_DEG)
    if waving:
        rough = replace(sample.sigmas, axis_mm=10.0, axis_deg=1.0)
    rng = np.random.default_rng([seed, 31, NAMES.index(name)])
    spec = replace(
        sample,
        name=name,
        title="Calibration yard",
        benchmarks=_ring(),
        sigmas=rough,
        rate_hz=2.5,
        utilities=(),
        sensors=() if not waving else sample.sensors,
        motion={"cab": (0.02, 0.02), "stick": (0.12, 0.03), "bucket": (0.12, 1.0)},
    )
    motion = Standing(spec, waving, rng)
    truth = replace(built.truth, benchmarks=_boards(spec, motion, rng))
    sigma = uncertainty(spec)

    def off(T: np.ndarray, sigma_xi: np.ndarray) -> np.ndarray:
        return T @ se3.exp(-rng.normal(size=6) * sigma_xi)

    said = replace(
        built.files,
        benchmarks={n: off(T, sigma.benchmark) for n, T in truth.benchmarks.items()},
    )
    marker = None
    if waving:
        said = replace(said, axis=off(truth.axis, sigma.axis))
        marker = off(_bucket_marker(), np.repeat([0.01, np.deg2rad(2.0)], 3))
    else:
        said = replace(said, cameras={n: off(T, sigma.camera) for n, T in truth.cameras.items()})
    return CalibrationSite(spec, seed, truth, said, sigma, motion, marker)


def _ring() -> tuple[BenchmarkPlan, ...]:
    return tuple(
        BenchmarkPlan(BoardPlan(f"wall-{k + 1}", FIRST_ID + 4 * k, 2, 2, TAG_M, GAP_M), 0.0, 6.0, height)
        for k, (_, _, height) in enumerate(RING)
    )


def _boards(spec: Specification, motion: Standing, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """``T_world_marker`` of the ring, facing the machine more or less."""
    centre = motion.place.point(motion.station, 0.0, spec.ground)
    boards = {}
    for plan, (azimuth, distance, height) in zip(spec.benchmarks, RING, strict=True):
        angle = motion.heading_rad + np.deg2rad(azimuth + rng.uniform(-3, 3))
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        turn = np.deg2rad(rng.choice([-1.0, 1.0]) * rng.uniform(14, 30))
        normal = -so3.exp(np.array([0.0, 0.0, turn])) @ out + [0.0, 0.0, rng.uniform(-0.12, 0.12)]
        askew = so3.exp(np.array([0.0, 0.0, np.deg2rad(rng.uniform(-9, 9))]))
        position = centre + (distance + rng.uniform(-0.3, 0.3)) * out + [0.0, 0.0, height]
        boards[plan.board.name] = se3.from_rotation_translation(
            facing(normal, np.array([0.0, 0.0, 1.0])) @ askew, position
        )
    return boards


def _bucket_marker() -> np.ndarray:
    """``T_bucket_marker``: on a bracket at the left of the bucket, looking back at the cab in mid-stroke."""
    # In mid-stroke the bucket points 134 degrees below the arm's forward direction; the cameras are 165 above it.
    back, turn = np.deg2rad(165.0 + 134.0), np.deg2rad(38.0)
    normal = np.array([np.cos(turn) * np.cos(back), np.cos(turn) * np.sin(back), -np.sin(turn)])
    up = np.array([-np.sin(back), np.cos(back), 0.0])
    return se3.from_rotation_translation(facing(normal, up), np.array(BUCKET_MARKER))


class CalibrationRenderer(Renderer):
    """Frames of a calibration: boards about the machine, and its arm where that moves."""

    def __init__(self, site: CalibrationSite):
        super().__init__(site.spec, site.truth, site.motion, site.seed)  # type: ignore[arg-type]
        self.site = site
        if site.bucket_marker is not None:
            rng = np.random.default_rng([site.seed, 78])
            self.boards[BUCKET_BOARD.name] = board(BUCKET_BOARD, site.spec.family)
            self.textures[BUCKET_BOARD.name] = board_texture(self.boards[BUCKET_BOARD.name], rng)

    def _earthworks(self, view: View, canvas: np.ndarray, t: float) -> None:
        """Nothing is dug in the yard."""

    def _machine(
        self, camera: str, view: View, scene: np.ndarray, poses: dict[str, np.ndarray], k: int, t: float
    ) -> None:
        """The arm is out of sight but where its axes are told; then the bucket carries a board."""
        if self.site.bucket_marker is None:
            return
        super()._machine(camera, view, scene, poses, k, t)
        T_camera_bucket = view.T_camera_world @ poses["bucket"][k]
        self._paste(camera, scene, BUCKET_BOARD.name, T_camera_bucket @ self.site.bucket_marker, t)


__all__ = ["BUCKET_BOARD", "CLUSTER", "MOUNTS", "NAMES", "CalibrationRenderer", "calibration_site"]
