"""A machine at work for minutes, and the faults that logs have, one by one or together: what diagnostics must find.

The network of the simulator, with a marker on the bucket beside the potentiometer (a second clock) and a fourth
benchmark in view of the second camera, so that every mount is checked by something. Corners are OpenCV's.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config import Machine, Site
from pipeline.config.site import EstimationSettings, Split
from pipeline.estimation import adjust
from pipeline.geometry import se3, so3
from pipeline.network import Observations, Readings, network_of
from tests.estimation.simulator import (
    BUCKET_MARKER,
    MACHINE,
    SIGMA_PX,
    SITE,
    T0_NS,
    Drawn,
    board,
    gross,
    level,
    marker_poses,
    observed,
    picture,
    pictures,
    potentiometer,
    rotz,
    true_static,
)

FRAME_S = 0.2
MOVED_M, TURNED_RAD, LATE_S = 0.010, np.deg2rad(0.05), 0.050
BLIND_S, MARGIN_S = 60.0, 1.0
FAULTS = ("flips", "outliers", "benchmark", "mount", "offset", "blind", "dead", "duplicates")


def machine_at_work() -> dict:
    """machine.toml of the scene: motion as a machine at work needs it."""
    document = copy.deepcopy(MACHINE)
    document["markers"]["bucket"] = copy.deepcopy(BUCKET_MARKER)
    document["motion"] = {
        "cab": {"translation": 5e-3, "rotation": 1e-2},
        "stick": {"translation": 0.3, "rotation": 0.1},
        "bucket": {"translation": 1.0, "rotation": 0.5},
    }
    return document


def site_with_four() -> dict:
    """site.toml of the scene."""
    document = copy.deepcopy(SITE)
    document["benchmarks"]["B4"] = board(9, [512_003.0, 4_123_009.5, 100.8], -5.0)
    return document


def scene(seed: int, seconds: float, repeated_px: float = 0.0) -> Drawn:
    """A drawn machine at work.

    Parameters
    ----------
    seed : int
        Of all draws.
    seconds : float
        Length of the log.
    repeated_px : float
        Error of each corner of each tag in each camera that comes back in every frame; half of it is fixed to the
        print, half drifts with a correlation time of ten seconds. The corners' covariances include it, as those of
        ``table.observations_of`` do.
    """
    rng = np.random.default_rng(seed)
    machine, site = Machine.model_validate(machine_at_work()), Site.model_validate(site_with_four())
    network = network_of(machine, site)
    truth = [true_static(rng, s) for s in network.statics]
    by_name = {s.name: value for s, value in zip(network.statics, truth, strict=True)}
    frame_ns = T0_NS + np.round(np.arange(int(seconds / FRAME_S)) * FRAME_S * 1e9).astype(np.int64)
    jitter = rng.uniform(0.2, 0.5, len(frame_ns)) * FRAME_S
    reading_ns = frame_ns + np.round(jitter * 1e9).astype(np.int64)
    time_ns = np.union1d(frame_ns, reading_ns)
    t = (time_ns - T0_NS) * 1e-9
    T_cab = level([0.0, 0.0, 1.5]) @ se3.exp(
        _waves(rng, t, [0.04, 0.04, 0.02, 0.01, 0.01, 0.08], (7.0, 16.0))
    )
    T_stick = level([1.0, 6.0, 0.3]) @ se3.exp(
        _waves(rng, t, [0.4, 0.4, 0.25, 0.15, 0.06, 0.06], (5.0, 12.0))
    )
    angle = np.deg2rad(-15.0) + _waves(rng, t, [0.15], (4.0, 9.0))[:, 0]
    T_bucket = T_stick @ by_name["joint bucket axis"] @ rotz(angle)
    T_world = {
        "cab": T_cab,
        "stick": T_stick,
        "bucket": T_bucket,
        "tool": T_bucket @ by_name["cutting edge mount"],
    }
    pot = potentiometer(rng, network, by_name, reading_ns, angle[np.searchsorted(time_ns, reading_ns)])
    drawn = Drawn(
        machine, site, network, None, {"pot": pot}, time_ns, T_world, truth, angle, frame_ns
    )  # fmt: skip
    return replace(drawn, observations=_look(rng, drawn, repeated_px))


def _waves(rng, t, size, periods):
    """Three sines per component, (n, m): bounded, and never the same twice."""
    out = np.zeros((len(t), len(size)))
    for i, amplitude in enumerate(size):
        for period in rng.uniform(*periods, 3):
            out[:, i] += amplitude * np.sin(2 * np.pi * t / period + rng.uniform(0, 2 * np.pi)) / np.sqrt(1.5)
    return out


def _look(rng, drawn: Drawn, repeated_px: float) -> Observations:
    rows = np.searchsorted(drawn.time_ns, drawn.frame_ns)
    half, keep = repeated_px / np.sqrt(2), np.exp(-FRAME_S / 10.0)
    repeats: dict[tuple[int, int], np.ndarray] = {}
    out = []
    for c, k, i, uv in pictures(drawn.network, drawn.by_name, drawn.T_world, rows):
        if (c, k) not in repeats:
            drift = rng.standard_normal((len(rows), 4, 2))
            for j in range(1, len(rows)):
                drift[j] = keep * drift[j - 1] + np.sqrt(1 - keep**2) * drift[j]
            repeats[c, k] = half * (rng.standard_normal((4, 2)) + drift)
        uv = uv + repeats[c, k][i] + SIGMA_PX * rng.standard_normal((4, 2))
        out.append((c, k, drawn.frame_ns[i], uv))
    return observed(out, SIGMA_PX**2 + repeated_px**2)


def _pose(drawn: Drawn, seen: Observations, i: int):
    """True ``T_camera_marker`` of a sighting."""
    row = np.searchsorted(drawn.time_ns, seen.time_ns[i : i + 1])
    return marker_poses(drawn.network, drawn.by_name, drawn.T_world, seen.camera[i], seen.tag[i], row)[0]


@dataclass(frozen=True)
class Injected:
    """What was done to a log that the change test should find: static -> (instant in seconds, size)."""

    drawn: Drawn
    steps: dict[str, tuple[float, float]]
    gaps: tuple[tuple[float, float], ...]

    def outside(self) -> np.ndarray:
        """(F,) bool: frames that are not in a gap, nor within a second of one."""
        t = (self.drawn.frame_ns - T0_NS) * 1e-9
        keep = np.ones(len(t), dtype=bool)
        for low, high in self.gaps:
            keep &= (t < low - MARGIN_S) | (t > high + MARGIN_S)
        return keep


def edge_error(drawn: Drawn, settings: EstimationSettings):
    """Error of the cutting edge's middle by frame, (F, 3) with nan where there is none; and the solution."""
    solution = adjust(drawn.network, drawn.observations, drawn.readings, settings)
    tool = solution.body("tool")
    error, rows = drawn.error(tool)
    out = np.full((len(drawn.frame_ns), 3), np.nan)
    out[np.searchsorted(drawn.frame_ns, tool.time_ns[rows])] = error[:, :3]
    return out, solution


def rmse(error, rows) -> float:
    """Root mean square length of the errors (F, 3) at some frames (F,) bool."""
    return float(np.sqrt(np.nanmean(np.sum(error[rows] ** 2, axis=1))))


def told(change: dict) -> Split:
    """What the sentence of a change asks to write into site.toml."""
    at = np.datetime64(change["at_ns"], "ns").astype("datetime64[ms]").item()
    return Split.model_validate({"static": change["static"], "at": f"{at.isoformat()}Z"})


def inject(
    drawn: Drawn, faults, seed: int = 0, at_s: float | None = None, blind_s: float = BLIND_S
) -> Injected:
    """The log with faults.

    Parameters
    ----------
    drawn : Drawn
        A clean scene.
    faults : collection of str
        Of ``FAULTS``.
    seed : int
        Of the draws.
    at_s : float, optional
        When the benchmark moves; the mount turns 20 s and the clock is set 10 s before. The default is 60 s before the
        end.
    blind_s : float
        How long no camera sees anything.
    """
    rng = np.random.default_rng(seed)
    network, readings = drawn.network, dict(drawn.readings)
    seen, end = drawn.observations, len(drawn.frame_ns) * FRAME_S
    at = end - 60.0 if at_s is None else at_s
    t = (seen.time_ns - T0_NS) * 1e-9
    steps: dict[str, tuple[float, float]] = {}
    gaps: list[tuple[float, float]] = []
    uv = seen.uv.copy()
    if "benchmark" in faults:
        away = se3.exp(np.array([0.6, 0.8, 0.0, 0.0, 0.0, 0.0]) * MOVED_M)
        B2 = [m.name for m in network.markers].index("B2")
        uv += _shift(
            drawn, seen, np.flatnonzero((network.tag_marker[seen.tag] == B2) & (t >= at)), after=away
        )
        steps["benchmark B2 pose"] = (at, MOVED_M)
    if "mount" in faults:
        turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.6, 0.8, 0.0]) * TURNED_RAD)
        when = at - 20.0
        rows = np.flatnonzero((seen.camera == 1) & (t >= when))
        uv += _shift(drawn, seen, rows, before=se3.inverse(turned))
        steps[f"camera {network.cameras[1].name} mount"] = (when, TURNED_RAD)
    if "offset" in faults:
        pot = readings["pot"]
        when = at - 10.0
        late = pot.time_ns >= T0_NS + int(when * 1e9)
        # The stamps are early by 50 ms more: true time minus stamp grows.
        readings["pot"] = Readings(pot.time_ns - late * int(LATE_S * 1e9), pot.raw)
        steps["sensor pot time offset"] = (when, LATE_S)
    if "flips" in faults:
        for i in np.flatnonzero(rng.random(len(uv)) < 0.05):
            uv[i] = _flipped(drawn, seen, i, uv[i])
    if "outliers" in faults:
        uv += gross(rng, uv.shape[:2], 0.05)
    keep = np.ones(len(uv), dtype=bool)
    if "blind" in faults:
        start = 0.25 * end
        keep &= (t < start) | (t >= start + blind_s)
        gaps.append((start, start + blind_s))
    if "dead" in faults:
        keep &= (seen.camera != 0) | (t < 0.5 * end)
    rows = np.flatnonzero(keep)
    if "duplicates" in faults:
        rows = np.sort(np.r_[rows, rng.choice(rows, len(rows) // 5)])
        pot = readings["pot"]
        again = np.sort(np.r_[np.arange(len(pot.raw)), np.arange(0, len(pot.raw), 5)])
        readings["pot"] = Readings(pot.time_ns[again], pot.raw[again])
    observations = replace(seen, uv=uv).take(rows)
    return Injected(replace(drawn, observations=observations, readings=readings), steps, tuple(gaps))


def _shift(drawn: Drawn, seen: Observations, rows, before=None, after=None):
    """How far corners move where ``T_camera_marker`` becomes ``before @ T @ after``, (n, 4, 2)."""
    before, after = (np.eye(4) if T is None else T for T in (before, after))
    out = np.zeros_like(seen.uv)
    for i in rows:
        c, k, T = seen.camera[i], seen.tag[i], _pose(drawn, seen, i)
        p, K = drawn.network.tag_corners[k], drawn.statics[drawn.network.cameras[c].intrinsics]
        out[i] = picture(before @ T @ after, p, K) - picture(T, p, K)
    return out


def _flipped(drawn: Drawn, seen: Observations, i: int, uv):
    """Corners of the tag's other planar pose: what a detector that chose the wrong branch would follow."""
    k, K = seen.tag[i], drawn.statics[drawn.network.cameras[seen.camera[i]].intrinsics]
    T = _pose(drawn, seen, i)
    p = drawn.network.tag_corners[k]
    centre, n = T[:3, :3] @ p.mean(axis=0) + T[:3, 3], T[:3, 2]
    ray = centre / np.linalg.norm(centre)
    # The other branch mirrors the normal about the line of sight, and leaves the centre where it is.
    mirrored = 2 * (n @ ray) * ray - n
    axis = np.cross(n, mirrored)
    size = np.linalg.norm(axis)
    angle = np.arctan2(size, n @ mirrored)
    R = so3.exp(axis / size * angle) @ T[:3, :3] if size > 1e-9 else T[:3, :3]
    other = se3.from_rotation_translation(R, centre - R @ p.mean(axis=0))
    return picture(other, p, K) + (uv - picture(T, p, K))
