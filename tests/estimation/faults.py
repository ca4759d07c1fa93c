"""A machine at work for minutes, and the faults that logs have, one by one or together: what diagnostics must find.

The network of the simulator, with a marker on the bucket beside the potentiometer (a second clock) and a fourth
benchmark in view of the second camera, so that every mount is checked by something. Corners are OpenCV's.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config import Machine, Site
from pipeline.geometry import linkage, se3, so3
from pipeline.network import Observations, Readings, network_of
from pipeline.network.model import Static
from tests.estimation.simulator import (
    BUCKET_MARKER,
    MACHINE,
    SIGMA_PX,
    SITE,
    T0_NS,
    Drawn,
    _board,
    _level,
    _of,
    _rotz,
    picture,
)

FRAME_S = 0.2
MOVED_M, TURNED_RAD, LATE_S = 0.010, np.deg2rad(0.05), 0.050
BLIND_S = 60.0
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
    document["benchmarks"]["B4"] = _board(9, [512_003.0, 4_123_009.5, 100.8], -5.0)
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
    truth = [_drawn(rng, s) for s in network.statics]
    by_name = {s.name: value for s, value in zip(network.statics, truth, strict=True)}
    frame_ns = T0_NS + np.round(np.arange(int(seconds / FRAME_S)) * FRAME_S * 1e9).astype(np.int64)
    jitter = rng.uniform(0.2, 0.5, len(frame_ns)) * FRAME_S
    reading_ns = frame_ns + np.round(jitter * 1e9).astype(np.int64)
    time_ns = np.union1d(frame_ns, reading_ns)
    t = (time_ns - T0_NS) * 1e-9
    T_cab = _level([0.0, 0.0, 1.5]) @ se3.exp(
        _waves(rng, t, [0.04, 0.04, 0.02, 0.01, 0.01, 0.08], (7.0, 16.0))
    )
    T_stick = _level([1.0, 6.0, 0.3]) @ se3.exp(
        _waves(rng, t, [0.4, 0.4, 0.25, 0.15, 0.06, 0.06], (5.0, 12.0))
    )
    angle = np.deg2rad(-15.0) + _waves(rng, t, [0.15], (4.0, 9.0))[:, 0]
    T_bucket = T_stick @ by_name["joint bucket axis"] @ _rotz(angle)
    T_world = {
        "cab": T_cab,
        "stick": T_stick,
        "bucket": T_bucket,
        "tool": T_bucket @ by_name["cutting edge mount"],
    }
    rows = np.searchsorted(time_ns, reading_ns)
    params, (c0, c1) = by_name["sensor pot linkage"], by_name["sensor pot curve"]
    raw = (linkage.cylinder_length(angle[rows], params, 1) - c0) / c1
    assert np.all(np.isfinite(raw))
    raw = raw + network.sensors[0].noise * rng.standard_normal(len(raw))
    offset_ns = round(by_name["sensor pot time offset"][0] * 1e9)
    drawn = Drawn(
        machine, site, network, None, {"pot": Readings(reading_ns - offset_ns, raw)},
        time_ns, T_world, truth, angle, frame_ns,
    )  # fmt: skip
    return replace(drawn, observations=_look(rng, drawn, repeated_px))


def _drawn(rng, static: Static):
    values, vectors = np.linalg.eigh(static.covariance)
    error = vectors @ (np.sqrt(np.maximum(values, 0)) * rng.standard_normal(len(values)))
    return static.value @ se3.exp(error) if static.is_pose else static.value + error


def _waves(rng, t, size, periods):
    """Three sines per component, (n, m): bounded, and never the same twice."""
    out = np.zeros((len(t), len(size)))
    for i, amplitude in enumerate(size):
        for period in rng.uniform(*periods, 3):
            out[:, i] += amplitude * np.sin(2 * np.pi * t / period + rng.uniform(0, 2 * np.pi)) / np.sqrt(1.5)
    return out


def _poses(drawn: Drawn, c: int, k: int, rows):
    """True ``T_camera_marker`` of a tag's marker at rows of the truth."""
    by_name = {s.name: value for s, value in zip(drawn.network.statics, drawn.statics, strict=True)}
    camera, marker = drawn.network.cameras[c], drawn.network.markers[drawn.network.tag_marker[k]]
    name = f"benchmark {marker.name} pose" if marker.benchmark else f"marker {marker.name} mount"
    T_world_camera = _of(drawn.T_world, camera.body, rows) @ by_name[f"camera {camera.name} mount"]
    return se3.inverse(T_world_camera) @ _of(drawn.T_world, marker.body, rows) @ by_name[name]


def _look(rng, drawn: Drawn, repeated_px: float) -> Observations:
    network = drawn.network
    rows = np.searchsorted(drawn.time_ns, drawn.frame_ns)
    out = []
    for c, camera in enumerate(network.cameras):
        intrinsics = drawn.statics[camera.intrinsics]
        for k in range(len(network.tag_marker)):
            half = repeated_px / np.sqrt(2)
            fixed, drift = half * rng.standard_normal((4, 2)), half * rng.standard_normal((4, 2))
            keep = np.exp(-FRAME_S / 10.0)
            for i, T in enumerate(_poses(drawn, c, k, rows)):
                drift = keep * drift + np.sqrt(1 - keep**2) * half * rng.standard_normal((4, 2))
                p = se3.transform(T, network.tag_corners[k])
                if p[:, 2].min() < 0.5 or T[:3, 2] @ T[:3, 3] > -0.1 * np.linalg.norm(T[:3, 3]):
                    continue
                uv = picture(T, network.tag_corners[k], intrinsics)
                if (uv < 5).any() or (uv > np.array([camera.width, camera.height]) - 5).any():
                    continue
                noise = SIGMA_PX * rng.standard_normal((4, 2))
                out.append((c, k, drawn.frame_ns[i], uv + noise + fixed + drift))
    n = len(out)
    return Observations(
        np.array([row[0] for row in out], dtype=np.int64),
        np.array([row[1] for row in out], dtype=np.int64),
        np.array([row[2] for row in out], dtype=np.int64),
        np.array([row[3] for row in out]).reshape(n, 4, 2),
        np.broadcast_to((SIGMA_PX**2 + repeated_px**2) * np.eye(2), (n, 4, 2, 2)).copy(),
    )


@dataclass(frozen=True)
class Injected:
    """What was done to a log that the change test should find: static -> (instant in seconds, size)."""

    drawn: Drawn
    steps: dict[str, tuple[float, float]]
    gaps: tuple[tuple[float, float], ...]


def inject(drawn: Drawn, faults, seed: int = 0, at_s: float | None = None) -> Injected:
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
        When the benchmark, the mount and the clock change; the default is 60 s before the end.
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
        bad = rng.random(uv.shape[:2]) < 0.05
        angle, size = rng.uniform(0, 2 * np.pi, bad.shape), rng.uniform(3, 20, bad.shape)
        uv += (bad * size)[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    keep = np.ones(len(uv), dtype=bool)
    if "blind" in faults:
        start = 0.25 * end
        keep &= (t < start) | (t >= start + BLIND_S)
        gaps.append((start, start + BLIND_S))
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
        c, k = seen.camera[i], seen.tag[i]
        row = np.searchsorted(drawn.time_ns, seen.time_ns[i])
        T = _poses(drawn, c, k, np.array([row]))[0]
        p, K = drawn.network.tag_corners[k], drawn.statics[drawn.network.cameras[c].intrinsics]
        out[i] = picture(before @ T @ after, p, K) - picture(T, p, K)
    return out


def _flipped(drawn: Drawn, seen: Observations, i: int, uv):
    """Corners of the tag's other planar pose: what a detector that chose the wrong branch would follow."""
    k, K = seen.tag[i], drawn.statics[drawn.network.cameras[seen.camera[i]].intrinsics]
    row = np.searchsorted(drawn.time_ns, seen.time_ns[i])
    T = _poses(drawn, seen.camera[i], k, np.array([row]))[0]
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
