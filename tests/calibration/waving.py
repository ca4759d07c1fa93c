"""A machine that stands, then waves its arm before its cameras: corners as seen, drawn with white noise."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.config import load_machine, load_site
from pipeline.network import network_of
from pipeline.synthetic import calibration_log, calibration_sites
from pipeline.synthetic.calibration_sites import BUCKET_BOARD
from pipeline.synthetic.cycle import bucket_pose

SIGMA_PX = 0.05


def yard(seed, bucket_board=False):
    """What was drawn, machine.toml and site.toml of it; with the board that magnets hold to the bucket, or without."""
    drawn = calibration_sites.calibration_site(calibration_sites.MOUNTS, seed)
    text = calibration_log.machine_text(drawn.spec, drawn.files, drawn.sigma, bucket_board=bucket_board)
    return drawn, load_machine(text, "machine.toml"), load_site(calibration_log.site_toml(drawn), "site.toml")


def seen(drawn, machine, site, rng, until_s=8.0):
    """Detections of all markers by OpenCV's projection: standing for `STAND_S`, and waving then."""
    network = network_of(machine, site)
    out = {}
    for camera, delay in (("bench", 0.0), ("arm", 0.13)):
        rows = {k: [] for k in ("time_ns", "family", "tag_id", "uv")}
        lens = drawn.truth.intrinsics[camera]
        K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
        for t in np.arange(0.1, until_s, 0.4) + delay:
            poses = drawn.motion.poses(np.array([t]))
            T_camera_world = np.linalg.inv(poses.T_world_cab[0] @ drawn.truth.cameras[camera])
            where = dict(drawn.truth.benchmarks)
            where[drawn.spec.stick_board.name] = poses.stick(drawn.spec)[0] @ drawn.truth.stick_marker
            bucket = bucket_pose(poses.stick(drawn.spec), drawn.truth.axis, poses.joint_rad())
            where[BUCKET_BOARD.name] = bucket[0] @ drawn.bucket_marker
            for tag, (m, corners) in enumerate(zip(network.tag_marker, network.tag_corners, strict=True)):
                T = T_camera_world @ where[network.markers[m].name]
                p = corners @ T[:3, :3].T + T[:3, 3]
                if p[:, 2].min() < 0.5 or T[:3, 2] @ T[:3, 3] > 0:
                    continue
                uv = cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, lens[4:])[0].reshape(4, 2)
                if uv.min() < 3 or uv[:, 0].max() > 636 or uv[:, 1].max() > 476:
                    continue
                rows["time_ns"].append(drawn.spec.start_utc_ns + round(t * 1e9))
                rows["family"].append(network.tag_family[tag])
                rows["tag_id"].append(network.tag_id[tag])
                rows["uv"].append(uv + rng.normal(size=(4, 2)) * SIGMA_PX)
        n = len(rows["uv"])
        out[camera] = columns(rows, n)
    return out


def columns(rows, n):
    uv = np.array(rows["uv"]).reshape(n, 8)
    table = {
        "time_ns": np.array(rows["time_ns"], np.int64),
        "family": np.array(rows["family"], object),
        "tag_id": np.array(rows["tag_id"]),
        "status": np.full(n, "accepted", object),
    }
    for k in range(4):
        table[f"u{k}"], table[f"v{k}"] = uv[:, 2 * k], uv[:, 2 * k + 1]
        table[f"cov{k}_uu"] = table[f"cov{k}_vv"] = np.full(n, SIGMA_PX**2)
        table[f"cov{k}_uv"] = np.zeros(n)
    return table
