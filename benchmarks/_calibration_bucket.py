"""Drawn buckets calibrated from eight touches: are curve, edge and pin as far off as their covariances say?

Every rig is drawn whole: machine, files with errors, motion, stake, readings as `gradetrace sample-logs --site
calibration-bucket` draws them. Only the pictures are left out: corners are projected from the true poses with noise of
the stated size, and go through the same adjustment, rests and touches as those of a log. So the stick's poses, with
what they share, are an adjustment's own. What rendering adds (blur, light, detection) was tried on a whole log; it
takes minutes apiece, too long for fifty.
"""

from __future__ import annotations

import datetime

import numpy as np

from benchmarks._calibration_bars import AtMost, Row, normalised
from benchmarks._calibration_rigs import drawn
from pipeline.calibration import curve_fit
from pipeline.calibration.agreement import agreed, kept_of
from pipeline.calibration.curve_fit import azimuth_of
from pipeline.calibration.standings import RULE, Touched, machine_to_the_pin, standings, touched
from pipeline.calibration.touches import Adjusted
from pipeline.config import Machine, Site, load_machine, load_site
from pipeline.estimation import adjust
from pipeline.estimation.repeated import Repeated
from pipeline.estimation.table import columns_of_states
from pipeline.geometry import camera as camera_model
from pipeline.geometry import linkage, se3
from pipeline.network import Network, Observations, network_of
from pipeline.stages.bucket_files import rig_of
from pipeline.surface.rests import rests_of
from pipeline.surface.shots import Shots
from pipeline.synthetic import files, recording
from pipeline.synthetic.recording import World
from pipeline.synthetic.touched_stake import calibration_bucket
from pipeline.synthetic.touching import Touching
from pipeline.tracks.poses import cutting_edge
from pipeline.tracks.table import states_from_columns

FIRST, LEAST = 1, 100
"""A rig gives one distance and one place along the pin: of fifty the share that is covered is known to 3 % only."""
SIGMA_PX = 0.03
"""As corners of the rendered log scatter."""
NODES = 9
DAY = datetime.date(2025, 6, 15)
WITHIN_DEG = 0.2


def calibrated(seed: int) -> tuple[World, Adjusted, Machine]:
    """One rig, calibrated."""
    w = recording.world(calibration_bucket(), seed)
    machine = load_machine(files.machine_toml(w.spec, w.files, w.sigma), "machine.toml")
    site = load_site(files.site_toml(w.spec, w.files), "site.toml")
    found = touches_of(w, machine, site, np.random.default_rng([seed, 77]))
    rig = rig_of(machine, site, "bucket-pot", DAY, wear=False)
    return w, agreed(rig, found.stands, found.touches, dict(zip(found.point_names, found.points))), machine


def touches_of(w: World, machine: Machine, site: Site, rng: np.random.Generator) -> Touched:
    """Stands and touches of a rig, from corners without pictures."""
    network = network_of(machine_to_the_pin(machine)[0], site)
    solution = adjust(network, corners(w, network, rng), {}, site.estimation, Repeated(), True)
    columns = [columns_of_states(part) for part in solution.states]
    states = states_from_columns({k: np.concatenate([c[k] for c in columns]) for k in columns[0]})
    edge = cutting_edge(states, network.edge_m, np.zeros(3))
    stamps, raw = recording.readings(w, w.spec.sensors[0])
    sensor = machine.sensors["bucket-pot"]
    lasting = solution.diagnostics.get("correlation_time_s") or {}
    stands = standings(
        states,
        rests_of(edge, RULE),
        edge.time_ns,
        solution.sensitivities,
        lasting.get("parked", lasting.get("median")),
        stamps + w.spec.start_utc_ns + round(sensor.time_offset_s * 1e9),
        raw,
        sensor.noise,
    )
    motion, plan = w.motion, w.spec.touches
    assert isinstance(motion, Touching) and plan is not None
    n = len(motion.touch_s)
    shots = Shots(
        np.full(n, plan.name, object),
        np.full(n, "", object),
        np.tile(motion.surveyed, (n, 1)),
        kind=np.full(n, "control", object),
        time_ns=np.round(motion.touch_s).astype(np.int64) * 10**9 + w.spec.start_utc_ns,
        edge_point=np.full(n, "middle", object),
        sigma_m=np.full(n, plan.point_mm / 1000),
    )
    r, width = float(np.hypot(*machine.cutting_edge.mount.xyz_m[:2])), w.spec.arm.width_m
    contact = plan.contact_mm / 1000
    return touched(stands, shots, {}, np.zeros(3), r, width, 0.15, 5.0, 0.002, contact, "middle")


def corners(w: World, network: Network, rng: np.random.Generator) -> Observations:
    """Every tag in every frame, projected by the true lenses, with noise."""
    parts = []
    planned = recording.shots(w)
    for c, camera in enumerate(network.cameras):
        time_ns = np.array([shot.time_ns for shot in planned if shot.camera == camera.name])
        poses = w.motion.poses(time_ns / 1e9)
        T_camera_world = se3.inverse(poses.T_world_cab @ w.truth.cameras[camera.name])
        on_stick = poses.stick(w.spec) @ w.truth.stick_marker
        for k, m in enumerate(network.tag_marker):
            marker = network.markers[m]
            T = T_camera_world @ (w.truth.benchmarks[marker.name] if marker.benchmark else on_stick)
            p = se3.transform(T[:, None], network.tag_corners[k])
            uv = camera_model.project(p, w.truth.intrinsics[camera.name])
            size = np.array([camera.width, camera.height])
            inside = np.all((uv > 4) & (uv < size - 4), axis=(1, 2)) & (p[..., 2].min(axis=1) > 0.5)
            towards = np.einsum("ni,ni->n", T[:, :3, 2], T[:, :3, 3]) / np.linalg.norm(T[:, :3, 3], axis=1)
            rows = np.flatnonzero(inside & (towards < -0.3))
            parts.append((np.full(len(rows), c), np.full(len(rows), k), time_ns[rows], uv[rows]))
    camera_index, tag, time_ns, uv = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort([tag, camera_index, time_ns])
    uv = uv[order] + SIGMA_PX * rng.standard_normal(uv.shape)
    cov = np.broadcast_to(SIGMA_PX**2 * np.eye(2), (len(order), 4, 2, 2)).copy()
    return Observations(camera_index[order], tag[order], time_ns[order] + w.spec.start_utc_ns, uv, cov)


def truth_of(w: World, machine: Machine, raw: np.ndarray) -> tuple[np.ndarray, float]:
    """Direction of the true edge at readings (n,), radians from the file's axis frame, and its true distance."""
    c = w.truth.curves["bucket-pot"]
    y = c[0] + c[1] * raw + c[2] * raw * raw
    angle = linkage.bucket_angle(y, np.append(w.truth.linkage, 0.0), w.spec.arm.linkage_side)
    turned = se3.local(machine.bodies["bucket"].axis.transform(), w.truth.axis)[5]
    return angle + azimuth_of(w.truth.tool)[0] + turned, float(np.hypot(*w.truth.tool[:2, 3]))


def errors_of(w: World, found: Adjusted, machine: Machine) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
    """Quantity -> errors, sigmas, unit."""
    kept = kept_of(found, "bucket-pot")
    raw = np.linspace(*kept.stroke, NODES)
    angle, distance = truth_of(w, machine, raw)
    filed, sigma = curve_fit.of_file(found.rig, kept, raw)
    told = curve_fit.direction(found, raw)
    r, sigma_r, _ = curve_fit.radius_with_jacobian(found)
    across = kept.T_bucket_tool[2, 3] - w.truth.tool[2, 3]
    R = kept.T_bucket_tool[:3, :3]
    sigma_across = float(np.sqrt((R @ kept.tool[:3, :3] @ R.T)[2, 2]))
    return {
        "angle over the stroke, adjusted": (
            np.rad2deg(told.angle_rad - angle),
            np.rad2deg(told.sigma_rad),
            "deg",
        ),
        "angle over the stroke, in the file": (np.rad2deg(filed - angle), np.rad2deg(sigma), "deg"),
        "pin to edge": (np.array([1000 * (r - distance)]), np.array([1000 * sigma_r]), "mm"),
        "edge along the pin": (np.array([1000 * across]), np.array([1000 * sigma_across]), "mm"),
    }


def errors_of_rig(seed: int) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
    """One rig drawn, calibrated and compared."""
    w, found, machine = calibrated(seed)
    return errors_of(w, found, machine)


def buckets(draws: int) -> list[Row]:
    """Angle over the stroke, distance from pin to edge and place along the pin."""
    rigs = drawn(errors_of_rig, max(draws, LEAST), FIRST)
    rows: list[Row] = []
    for name, (_, _, unit) in rigs[0].items():
        error = np.array([rig[name][0] for rig in rigs])
        sigma = np.array([rig[name][1] for rig in rigs])
        rms, stated = (float(np.sqrt(np.mean(x**2))) for x in (error, sigma))
        rows.append(normalised(name, error / sigma, note=f"{rms:.3f} {unit} RMS, stated {stated:.3f}"))
        if unit == "deg":
            rows.append(AtMost(f"{name}, RMS", len(rigs), rms, WITHIN_DEG, unit))
    return rows
