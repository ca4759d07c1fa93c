"""What a lens that bends straight edges does to corners that were found with straight lines.

The tag detector fits a straight line to each side of a tag and takes their crossings as its corners. Through a lens
with distortion a side is bowed; its line lies beside the ends by two thirds of the sagitta or so, always to the same
side at the same place of the picture. With k1 = -0.14 that is 0.015 px: small against the noise of one corner, but it
is the same in every frame and never averages out. The bow follows from the intrinsics, so it is taken off.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import camera

SAMPLES = 16
"""Places along a side where the detector looks for its edge: what AprilTag's own refinement takes at the least."""


def without_bow(uv, intrinsics):
    """Corners of tags as the lens shows them, from corners that are crossings of straight lines.

    Parameters
    ----------
    uv : (n, 4, 2) array
        Corners as found, pixels, in order around the tag.
    intrinsics : (9,) array
        Of the camera that saw them.

    Returns
    -------
    (n, 4, 2) array
        Pixels. A corner that no ray of the lens reaches stays as it was found.
    """
    uv = np.asarray(uv, dtype=np.float64)
    if len(uv) == 0:
        return uv
    off = crossings(uv, intrinsics) - uv
    return uv - np.where(np.isfinite(off).all(axis=(1, 2))[:, None, None], off, 0.0)


def crossings(uv, intrinsics):
    """Where straight lines fitted to the bowed sides between given corners cross, (n, 4, 2) pixels."""
    xy = camera.undistort(uv, intrinsics)
    share = (np.arange(SAMPLES) + 1.0)[:, None] / (SAMPLES + 1)
    following = np.roll(xy, -1, axis=1)[:, :, None]
    side = xy[:, :, None] + share * (following - xy[:, :, None])
    points = camera.project(np.concatenate([side, np.ones_like(side[..., :1])], axis=-1), intrinsics)
    middle = points.mean(axis=2)
    # The line of least squared distances runs along the first principal axis of the points.
    along = uv[:, [1, 2, 3, 0]] - uv
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    from_middle = points - middle[:, :, None]
    s = np.einsum("nkmi,nki->nkm", from_middle, along)
    d = np.einsum("nkmi,nki->nkm", from_middle, across)
    slope = np.sum(s * d, axis=-1) / np.sum(s * s, axis=-1)
    normal = across - slope[..., None] * along
    level = np.sum(normal * middle, axis=-1)
    before = np.roll(normal, 1, axis=1)
    lines = np.stack([before, normal], axis=-2)
    return np.linalg.solve(lines, np.stack([np.roll(level, 1, axis=1), level], axis=-1)[..., None])[..., 0]
