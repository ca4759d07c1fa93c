"""Markers in pictures: rays to their corners and both planar poses, by camera and marker."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry import camera as camera_model
from pipeline.network import frames as fr
from pipeline.network import planar
from pipeline.network.datum import Tie
from pipeline.network.epochs import Epochs
from pipeline.network.model import Network

CORNER_CAP_PX = 20.0
"""A corner further off than this tells nothing about the branch, only that one of the two is wrong."""


@dataclass(frozen=True, eq=False)
class View:
    """One marker in the frames of one camera."""

    path: tuple[fr.Step, ...]
    epoch: np.ndarray  # (F,)
    p_marker: np.ndarray  # (m, 3)
    xy: np.ndarray  # (F, m, 2) rays, 0 where not seen
    seen: np.ndarray  # (F, m)
    focal_px: float
    poses: np.ndarray  # (F, 2, 4, 4) T_camera_marker
    misfit: np.ndarray  # (F, 2) sum of its squared residuals, px²

    def take(self, rows) -> View:
        """The same view, some of its frames: a mask or an index array."""
        return replace(
            self,
            epoch=self.epoch[rows],
            xy=self.xy[rows],
            seen=self.seen[rows],
            poses=self.poses[rows],
            misfit=self.misfit[rows],
        )


def views_of(network: Network, tie: Tie, epochs: Epochs) -> Iterator[View]:
    seen = epochs.observations
    marker_of = network.tag_marker[seen.tag]
    for c, camera in enumerate(network.cameras):
        intrinsics = network.statics[camera.intrinsics].value
        for m, marker in enumerate(network.markers):
            rows = np.flatnonzero((seen.camera == c) & (marker_of == m))
            if len(rows) == 0:
                continue
            tags = np.flatnonzero(network.tag_marker == m)
            frames, frame = np.unique(epochs.epoch[rows], return_inverse=True)
            rays = np.full((len(frames), len(tags), 4, 2), np.nan)
            rays[frame, np.searchsorted(tags, seen.tag[rows])] = camera_model.undistort(
                seen.uv[rows], intrinsics
            )
            xy = rays.reshape(len(frames), -1, 2)
            visible = np.isfinite(xy).all(axis=-1)
            enough = visible.sum(-1) >= 4
            xy, visible, frames = (
                np.where(visible[..., None], xy, 0.0)[enough],
                visible[enough],
                frames[enough],
            )
            if len(frames) == 0:
                continue
            p = network.tag_corners[tags].reshape(-1, 3)
            flat = np.broadcast_to(p[:, :2], (len(frames), len(p), 2))
            poses = planar.both_poses(flat, xy, visible.astype(float))
            poses[~(poses[..., 2, 3] > 0)] = np.nan  # behind the camera
            path = tie.frames.path(fr.camera_frame(camera.name), fr.marker_frame(marker.name))
            focal_px = float(np.mean(intrinsics[:2]))
            off = np.where(visible[:, None], off_px(poses, p, xy, focal_px), 0.0)
            yield View(path, frames, p, xy, visible, focal_px, poses, np.sum(off**2, axis=-1))


def off_px(T_camera_marker, p_marker, xy, focal_px):
    """Capped distances of corners, px, for candidate poses (F, K, 4, 4) of points (m, 3): (F, K, m)."""
    T = T_camera_marker
    p = np.einsum("fkij,mj->fkmi", T[..., :3, :3], p_marker) + T[..., None, :3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        off = focal_px * np.hypot(*np.moveaxis(p[..., :2] / p[..., 2:] - xy[:, None], -1, 0))
    off = np.where(p[..., 2] > 0, np.minimum(off, CORNER_CAP_PX), CORNER_CAP_PX)
    return np.where(np.isnan(T[..., :1, 0]), np.nan, off)
