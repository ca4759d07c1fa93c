"""Two joints that pictures show only together: both angles from one pose of a marker beyond them.

A marker on the bucket and none on the stick leaves two angles open on one path. Neither can be had alone, and taken as
zero the first may be off by a hundred degrees; yet a pose has six numbers, and two of them are these angles.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import se3
from pipeline.network import frames as fr

LEVER_M = 1.0
"""A turn of the second axis counts as a shift at this distance."""


def two_angles(X, M):
    """Angles ``a`` and ``b`` of ``X = turn(a) @ M @ turn(b)``, in the least-squares sense.

    ``turn(a)`` carries the origin and the axis of the second joint, as ``M`` has them, to where ``X`` has them: in the
    plane it carries two arrows onto two others, which has a closed form; ``b`` is the turn that is left.

    Parameters
    ----------
    X : (..., 4, 4) array
        Pose beyond the second joint, in the frame of the first one's axis.
    M : (..., 4, 4) array
        Pose of the second axis in the child of the first joint.

    Returns
    -------
    a, b : (...,) arrays
        Radians.
    told : (...,) array
        Metres: the arm by which ``a`` shows. 0 where both joints turn about one line, so that only their sum shows.
    """
    arrows = [(M[..., :2, 3], X[..., :2, 3], 1.0), (M[..., :2, 2], X[..., :2, 2], LEVER_M**2)]
    sine = sum(w * (u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]) for u, v, w in arrows)
    cosine = sum(w * (u[..., 0] * v[..., 0] + u[..., 1] * v[..., 1]) for u, v, w in arrows)
    a = np.arctan2(sine, cosine)
    left = se3.inverse(M) @ fr.turn(-a) @ X
    b = np.arctan2(left[..., 1, 0] - left[..., 0, 1], left[..., 0, 0] + left[..., 1, 1])
    return a, b, np.sqrt(np.hypot(sine, cosine))
