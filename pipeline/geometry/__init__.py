"""Rotations, poses, the camera, homographies, covariances, the bucket linkage; and the conventions of the house.

Pure numpy, float64, batched over leading axes; nothing here reads a file or knows what a marker is for.
Modules: ``so3`` ``se3`` ``camera`` ``homography`` ``gaussian`` ``linkage``. Import the module, not the function
(``from pipeline.geometry import se3``), so that ``se3.exp`` and ``so3.exp`` keep their surnames.

Each choice below has one test in ``tests/geometry/test_conventions.py``, or beside the room that owns
it, that fails when the convention flips.

Transform
    ``T_world_camera`` maps camera to world: ``p_world = T_world_camera @ p_camera``. Target first, so names
    cancel: ``T_world_camera = T_world_body @ T_body_camera``. Arrays ``(..., 4, 4)``, float64.
    *Rejected:* ``T_camera_to_world`` (long, does not cancel when read across); OpenCV's ``rvec, tvec`` of the
    world in the camera (the inverse pose); a pose class (estimation wants plain arrays and slices of them).
Frames
    ``grid`` is the survey's easting, northing, elevation in metres, large numbers. ``world`` is ``grid``
    minus a fixed integer origin, with the same axes: all estimation happens there. ``<body>`` is any body's
    own frame. ``camera`` is x right, y down, z forward. ``marker`` is x right, y up, z out of the print,
    origin at its centre. ``tool`` is the bucket's cutting edge.
    *Rejected:* estimating in grid coordinates (2,000,000 m leaves 2e-10 m per bit, and products of such
    numbers leave much less); a camera with y up and z backward (OpenGL); AprilTag's marker with y down and
    z into it.
Network nouns
    A ``body`` is ``world``, ``static`` (one unknown pose), ``moving`` (one pose per epoch) or ``joint``
    (one angle per epoch about an axis of its parent). A ``camera`` and a ``marker`` are mounted on bodies,
    a ``sensor`` reads a joint, an ``observation`` is one marker in one frame, an ``epoch`` one instant of
    the trajectory.
    *Rejected:* "rig", "link", "node", "tag": each means two of the above to somebody.
Pose error
    ``xi = [rho, phi]`` in metres and radians, translation first, applied on the right: ``T @ exp(xi)``; so
    the error lives in the frame of the body. An error of the pose of a body is felt at its points through
    ``[I, -hat(p_body)]``, which does not contain the world's origin.
    *Rejected:* rotation first (SciPy, GTSAM, mrcal): one swap, ``se3.swap_rotation_first``, and nowhere
    else; the left perturbation ``exp(xi) @ T``, whose translation part grows with the distance from the
    origin; separate additive position and rotation, whose exponential is not the motion of a body.
Published covariance
    A small error in easting, northing, elevation (m) and a rotation vector about the grid axes (rad), in the
    order ``e n h re rn rh``; stored as 21 named columns, the upper triangle row by row.
    ``se3.to_grid_covariance`` is the only way there.
    *Rejected:* publishing ``xi`` (a surveyor has no use for the axes of a stick); covariances of Euler angles
    (singular); degrees.
Pixel
    ``uv``, u to the right and v down; the centre of the top-left pixel is (0, 0), as in OpenCV. So an image
    covers ``[-0.5, width - 0.5]``. AprilTag's C library and OpenCV's ``CORNER_REFINE_APRILTAG`` put that
    centre at (0.5, 0.5): corrected where their numbers come in, in detection.
    *Rejected:* the corner of the top-left pixel at (0, 0), though it scales more kindly.
Corner order
    0..3 are (-,+) (+,+) (+,-) (-,-) in the marker frame: top-left, top-right, bottom-right, bottom-left as
    seen on the print. *Rejected:* AprilTag's order, which runs counter-clockwise.
Time
    ``time_ns``, int64, UTC, the capture stamp inside the message (never ``log_time``); intervals are
    half-open ``[start, end)``. Float seconds only as an offset from the start of the log.
    *Rejected:* float epochs (they lose the microseconds); the time of arrival (it contains the network).
Height sign
    Deviation = as-built minus design; ``+`` is high (under-dug), ``-`` is low (over-dug).
    *Rejected:* "cut" and "fill" as signs; they are always spelled out in words.
Words
    *residual* = observed minus predicted; *redundancy*, *normalised residual*, *datum* in the survey sense.
    *Rejected:* "error" for a residual; "reprojection error" as an accuracy.

Rotations enter and leave files as roll, pitch, yaw in degrees with ``R = Rz(yaw) @ Ry(pitch) @ Rx(roll)``,
or as quaternions ``x y z w`` with ``w >= 0``; inside they are matrices.
"""
