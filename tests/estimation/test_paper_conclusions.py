"""What the paper found about one camera and one marker (section 3.3.2, Figs. 7 to 9), held by our covariances.

Each configuration is adjusted from OpenCV's own picture of the marker, with everything else exact, so that eq. (3) is
all that is left: ``P = sigma_u² (J'J)^-1``. The oracles know nothing of our Jacobians: differences through
``cv2.projectPoints``, and the scatter of ``cv2.solvePnP``.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.config import Machine, Site
from pipeline.estimation import adjust
from pipeline.geometry import se3, so3
from pipeline.network import Observations, network_of
from tests.estimation.simulator import SITE, T0_NS, picture

SIGMA_U = 0.2  # px, Fig. 11
SIDE_M = 0.6  # Table 1's largest
FOCAL_PX = 1731.0  # Table 1's longer lens
EXACT = {"xyz_m": [0.0, 0.0, 0.0], "rpy_deg": [0.0, 0.0, 0.0], "sigma_mm": 0.0, "sigma_deg": 0.0}
CORNERS = 0.5 * SIDE_M * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])


def network(focal_px=FOCAL_PX):
    """A camera that stands at the origin of the grid, and a marker that moves."""
    machine = {
        "format": "gradetrace/machine/1",
        "machine": {"id": "one-camera-one-marker"},
        "bodies": {"stand": {"kind": "static", "pose": EXACT}, "plate": {"kind": "moving"}},
        "cameras": {
            "only": {
                "topic": "/only",
                "body": "stand",
                "mount": EXACT,
                "intrinsics": {
                    "width": 1280, "height": 960, "fx": focal_px, "fy": focal_px, "cx": 640.0, "cy": 480.0,
                    "distortion": [0.0] * 5, "sigma": [0.0] * 9,
                },
            }
        },
        "markers": {
            "plate": {"family": "tag36h11", "tags": [{"id": 99, "size_m": SIDE_M}], "body": "plate", "mount": EXACT}
        },
        "cutting_edge": {"body": "plate", "mount": EXACT, "width_m": 1.0},
    }  # fmt: skip
    return network_of(Machine.model_validate(machine), Site.model_validate(SITE))


def position_covariance(T_camera_marker, focal_px=FOCAL_PX):
    """Covariance of the marker's origin in the camera frame, as the adjustment publishes it; (3, 3), m²."""
    net = network(focal_px)
    tag = int(net.tag_index(["tag36h11"], [99])[0])
    intrinsics = net.statics[net.cameras[0].intrinsics].value
    uv = picture(T_camera_marker, net.tag_corners[tag], intrinsics)
    cov = np.broadcast_to(SIGMA_U**2 * np.eye(2), (1, 4, 2, 2))
    seen = Observations(np.array([0]), np.array([tag]), np.array([T0_NS]), uv[None], cov)
    plate = adjust(net, seen, {}).body("tool")
    assert np.abs(se3.local(plate.T_world_body[0], T_camera_marker)).max() < 1e-4
    assert np.abs(plate.common).max() == 0
    R = plate.T_world_body[0, :3, :3]
    return R @ plate.own[0, :3, :3] @ R.T


def facing(distance_m, tilt_deg=30.0, about_deg=0.0, ray=(0.0, 0.0, 1.0)):
    """A marker on the given ray, its face turned to the camera and then by ``tilt_deg`` about an axis in its plane."""
    ray = np.asarray(ray) / np.linalg.norm(ray)
    axis = np.array([np.cos(np.deg2rad(about_deg)), np.sin(np.deg2rad(about_deg)), 0.0])
    R = so3.exp(np.pi * np.array([1.0, 0, 0])) @ so3.exp(np.deg2rad(tilt_deg) * axis)
    return se3.from_rotation_translation(R, distance_m * ray)


def sigmas(cov):
    """Standard deviations along the principal axes, smallest first, and the axis of the largest."""
    values, vectors = np.linalg.eigh(cov)
    return np.sqrt(values), vectors[:, 2]


def by_differences(T_camera_marker, focal_px=FOCAL_PX):
    """Eq. (3) with the Jacobian of OpenCV's projection by central differences; (3, 3), m²."""
    K = np.array([[focal_px, 0, 640.0], [0, focal_px, 480.0], [0, 0, 1.0]])

    def image(delta):
        rvec, _ = cv2.Rodrigues(T_camera_marker[:3, :3] @ cv2.Rodrigues(delta[3:])[0])
        return cv2.projectPoints(CORNERS, rvec, T_camera_marker[:3, 3] + delta[:3], K, None)[0].ravel()

    h = 1e-6
    J = np.stack([(image(h * e) - image(-h * e)) / (2 * h) for e in np.eye(6)], axis=-1)
    return SIGMA_U**2 * np.linalg.inv(J.T @ J)[:3, :3]


def random_poses(count, seed=7):
    rng = np.random.default_rng(seed)
    return [
        facing(
            rng.uniform(3.0, 25.0),
            rng.uniform(10.0, 60.0),
            rng.uniform(0.0, 360.0),
            (rng.uniform(-0.3, 0.3), rng.uniform(-0.22, 0.22), 1.0),
        )
        for _ in range(count)
    ]


def test_the_covariance_is_eq_3_with_opencvs_projection():
    worst = 0.0
    for T in random_poses(12):
        ours, other = position_covariance(T), by_differences(T)
        scale = np.sqrt(np.outer(np.diagonal(other), np.diagonal(other)))
        worst = max(worst, float(np.abs((ours - other) / scale).max()))
    print(f"largest difference from eq. (3) by differences: {worst:.1e} of sqrt(P_ii P_jj)")
    # The adjustment may stop 0.05 sigma from the optimum, so the two linearise at slightly different poses.
    assert worst < 1e-3


def test_the_covariance_is_the_scatter_of_opencvs_pnp():
    T = facing(8.0, 45.0, 20.0, (0.1, -0.05, 1.0))
    K = np.array([[FOCAL_PX, 0, 640.0], [0, FOCAL_PX, 480.0], [0, 0, 1.0]])
    rvec, _ = cv2.Rodrigues(T[:3, :3])
    uv = cv2.projectPoints(CORNERS, rvec, T[:3, 3], K, None)[0][:, 0]
    rng, found = np.random.default_rng(1), []
    for _ in range(2000):
        noisy = uv + SIGMA_U * rng.standard_normal(uv.shape)
        _, _, t = cv2.solvePnP(
            CORNERS, noisy, K, None, rvec.copy(), T[:3, 3].reshape(3, 1).copy(), True, cv2.SOLVEPNP_ITERATIVE
        )
        found.append(t[:, 0])
    scatter = np.cov(np.array(found).T)
    ours, largest = sigmas(position_covariance(T))
    theirs, direction = sigmas(scatter)
    print(f"sigmas ours {1e3 * ours} mm, scatter of 2000 PnP solutions {1e3 * theirs} mm")
    assert ours == pytest.approx(theirs, rel=0.06)  # three standard errors of a sigma of 2000 draws are 5 %
    assert abs(largest @ direction) > np.cos(np.deg2rad(0.5))


def test_figure_7_the_largest_error_lies_along_the_line_of_sight():
    off = []
    for T in random_poses(40):
        _, direction = sigmas(position_covariance(T))
        ray = T[:3, 3] / np.linalg.norm(T[:3, 3])
        off.append(np.degrees(np.arccos(min(1.0, abs(direction @ ray)))))
    print(f"largest error within {max(off):.2f} deg of the line of sight, median {np.median(off):.2f} deg")
    assert max(off) < 5.0


def test_figure_8_the_largest_error_grows_with_the_square_of_the_distance():
    distance = np.array([4.0, 6.0, 9.0, 13.5, 20.0, 30.0])
    found = np.array([sigmas(position_covariance(facing(d)))[0] for d in distance])
    power = np.polyfit(np.log(distance), np.log(found), 1)[0]
    print(f"powers of the distance: largest {power[2]:.3f}, others {power[:2]}; at 30 m {1e3 * found[-1]} mm")
    assert power[2] == pytest.approx(2.0, abs=0.05)
    # "Compared to which the two smallest uncertainty's increases are almost negligible": they grow like the distance.
    assert np.all(power[:2] < 1.2)
    assert np.all(found[-1, :2] - found[0, :2] < 0.05 * (found[-1, 2] - found[0, 2]))


def test_figure_9_the_largest_error_grows_with_the_focal_length_at_constant_image_size():
    """The paper's third conclusion holds where a longer lens is used to stand further off.

    With ``sigma_depth ~ z² sigma_u / (f side)`` a marker that keeps its size in the picture, ``z ~ f``, is the less
    sure the longer the lens: linear in ``f``. At a fixed distance the opposite is true, which the next test holds.
    """
    focal = np.array([600.0, 850.0, 1200.0, 1731.0, 2500.0])
    found = np.array([sigmas(position_covariance(facing(0.008 * f), f))[0] for f in focal])
    power = np.polyfit(np.log(focal), np.log(found), 1)[0]
    print(f"constant image size: powers of the focal length: largest {power[2]:.3f}, others {power[:2]}")
    assert power[2] == pytest.approx(1.0, abs=0.05)
    assert np.all(found[-1, :2] - found[0, :2] < 0.05 * (found[-1, 2] - found[0, 2]))


def test_at_a_fixed_distance_a_longer_lens_makes_every_error_smaller():
    focal = np.array([600.0, 850.0, 1200.0, 1731.0, 2500.0])
    found = np.array([sigmas(position_covariance(facing(10.0), f))[0] for f in focal])
    power = np.polyfit(np.log(focal), np.log(found), 1)[0]
    print(f"fixed distance: powers of the focal length {power}")
    assert power == pytest.approx([-1.0, -1.0, -1.0], abs=0.08)
