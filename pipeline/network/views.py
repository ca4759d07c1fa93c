"""Markers in pictures: rays to their corners and both planar poses, by camera and marker."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline import threads
from pipeline.geometry import camera as camera_model
from pipeline.network import frames as fr
from pipeline.network import planar
from pipeline.network.datum import Tie
from pipeline.network.epochs import Epochs
from pipeline.network.model import Network

CHUNK = 4096
"""Frames that are looked at together: of a whole shift the temporary arrays would be a gigabyte."""
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
            order = np.argsort(frame, kind="stable")
            rows, frame = rows[order], frame[order]
            p = network.tag_corners[tags].reshape(-1, 3)
            focal_px = float(np.mean(intrinsics[:2]))

            def seen_in(a: int, p=p, rows=rows, frame=frame, frames=frames, tags=tags, intrinsics=intrinsics):
                """Rays, which of them are seen, epochs, poses and their misfit: of a chunk of frames."""
                inside = slice(*np.searchsorted(frame, [a, a + CHUNK]))
                own, epoch = rows[inside], frames[a : a + CHUNK]
                rays = np.full((len(epoch), len(tags), 4, 2), np.nan)
                rays[frame[inside] - a, np.searchsorted(tags, seen.tag[own])] = camera_model.undistort(
                    seen.uv[own], intrinsics
                )
                xy = rays.reshape(len(epoch), -1, 2)
                visible = np.isfinite(xy).all(axis=-1)
                enough = visible.sum(-1) >= 4
                xy, visible, epoch = (
                    np.where(visible[..., None], xy, 0.0)[enough],
                    visible[enough],
                    epoch[enough],
                )
                flat = np.broadcast_to(p[:, :2], (len(epoch), len(p), 2))
                poses = planar.both_poses(flat, xy, visible.astype(float))
                poses[~(poses[..., 2, 3] > 0)] = np.nan  # behind the camera
                off = np.where(visible[:, None], off_px(poses, p, xy, float(np.mean(intrinsics[:2]))), 0.0)
                return xy, visible, epoch, poses, np.sum(off**2, axis=-1)

            chunks = threads.each(seen_in, range(0, len(frames), CHUNK))
            xy, visible, frames, poses, misfit = (np.concatenate(c) for c in zip(*chunks, strict=True))
            if len(frames) == 0:
                continue
            path = tie.frames.path(fr.camera_frame(camera.name), fr.marker_frame(marker.name))
            yield View(path, frames, p, xy, visible, focal_px, poses, misfit)


def off_px(T_camera_marker, p_marker, xy, focal_px):
    """Capped distances of corners, px, for candidate poses (F, K, 4, 4) of points (m, 3): (F, K, m)."""
    T = T_camera_marker
    p = T[..., :3, :3] @ p_marker.T + T[..., :3, 3:]
    x, y, z = p[..., 0, :], p[..., 1, :], p[..., 2, :]
    with np.errstate(invalid="ignore", divide="ignore"):
        off = focal_px * np.hypot(x / z - xy[:, None, :, 0], y / z - xy[:, None, :, 1])
    off = np.where(z > 0, np.minimum(off, CORNER_CAP_PX), CORNER_CAP_PX)
    return np.where(np.isnan(T[..., :1, 0]), np.nan, off)
