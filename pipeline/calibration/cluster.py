"""A cluster of rigidly connected cameras, told from surveyed markers: Fig. 6 of the paper.

One camera, the reference, keeps its mount: where a body begins is a convention. The others have none, so the pictures
tell them through every loop there is: camera, marker, the site, another marker, another camera, the body. Lenses and
the survey keep their priors; what they are uncertain by is in the covariance of the mounts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.calibration.adjusted import Adjusted, adjusted, halves_disagree
from pipeline.calibration.closures import Closures, closures
from pipeline.calibration.contradiction import refuse_contradiction
from pipeline.config import Machine, Site
from pipeline.config.machine import CuttingEdge, JointBody, MovingBody
from pipeline.config.quantities import Pose
from pipeline.errors import CalibrationError
from pipeline.estimation.repeated import Repeated
from pipeline.geometry import se3
from pipeline.network import network_of
from pipeline.network.model import Network, Observations

SHARED_S = 0.2
"""Pictures of two cameras this close share an instant: the motion between them is a matter of a tenth of a second."""
LEAST_SHARED = 5
"""Instants that a camera must share with the others."""
EXACT = Pose(xyz_m=(0.0, 0.0, 0.0), rpy_deg=(0.0, 0.0, 0.0), sigma_mm=0.0, sigma_deg=0.0)


@dataclass(frozen=True, eq=False)
class CameraPair:
    """Two cameras of a cluster."""

    first: str
    second: str
    instants: int
    """At which both saw the site."""
    T_first_second: np.ndarray
    """(4, 4)."""
    covariance: np.ndarray
    """(6, 6) of its ``xi``, m and rad."""
    closures: Closures | None
    """Loops through both, instant by instant; None where there are none."""

    @property
    def sigma_m(self) -> float:
        """Of the translation: root of the mean of its three variances."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3]) / 3))

    @property
    def sigma_rad(self) -> float:
        """Of the rotation: root of the mean of its three variances."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3))


@dataclass(frozen=True, eq=False)
class Cluster:
    """What a log tells of a cluster."""

    body: str
    reference: str
    whole: Adjusted
    mounts: dict[str, tuple[np.ndarray, np.ndarray]]
    """By camera: ``T_body_camera`` and the (6, 6) covariance of its ``xi``; the reference's is exact."""
    intrinsics: dict[str, tuple[np.ndarray, np.ndarray]]
    """By camera: (9,) and (9, 9)."""
    pairs: tuple[CameraPair, ...]
    cross: dict[str, tuple[np.ndarray, np.ndarray]]
    """By camera: mount of odd against even instants, ``xi`` (6,), and its expected covariance (6, 6)."""
    benchmarks: dict[str, dict]
    """Each benchmark as everything else predicts it (`estimation.validation.left_out`)."""
    defines_body: bool
    """Nothing but cameras hangs on the body, so the reference's mount may be exact in the machine file too."""


def cluster_machine(machine: Machine, reference: str) -> Machine:
    """The machine cut down to the reference's body and its cameras, whose mounts but the reference's are unknown.

    Raises
    ------
    CalibrationError
        There is no such camera, it stands on the site, it has no mount, or it is alone on its body.
    """
    if reference not in machine.cameras:
        raise CalibrationError(
            f"there is no camera '{reference}' in machine.toml; known are {', '.join(machine.cameras)}"
        )
    body = machine.cameras[reference].body
    if body == "world":
        raise CalibrationError(
            f"camera '{reference}' stands on the site; name one that rides on a body with others"
        )
    mount = machine.cameras[reference].mount
    if mount is None:
        raise CalibrationError(
            f"the reference camera '{reference}' has no mount; write cameras.{reference}.mount (where the body begins "
            "is for you to choose) or name another with --reference"
        )
    cameras = {}
    for name, camera in machine.cameras.items():
        if camera.body != body:
            continue
        kept = None
        if name == reference:
            kept = mount.model_copy(update={"sigma_mm": 0.0, "sigma_deg": 0.0, "covariance": None})
        cameras[name] = camera.model_copy(update={"mount": kept})
    if len(cameras) < 2:
        raise CalibrationError(
            f"camera '{reference}' is alone on '{body}'; a cluster has two cameras or more"
        )
    motion = {name: m for name, m in machine.motion.items() if name == body}
    return machine.model_copy(
        update={
            "bodies": {body: MovingBody(kind="moving")},
            "cameras": cameras,
            "markers": {},
            "sensors": {},
            "cutting_edge": CuttingEdge(body=body, mount=EXACT, width_m=1.0),
            "motion": motion,
        }
    )


def defines_body(machine: Machine, body: str) -> bool:
    """Whether nothing but cameras hangs on a body, so that one of them may say where it begins."""
    if any(marker.body == body for marker in machine.markers.values()) or machine.cutting_edge.body == body:
        return False
    joints = [b for b in machine.bodies.values() if isinstance(b, JointBody)]
    return isinstance(machine.bodies[body], MovingBody) and all(joint.parent != body for joint in joints)


def default_reference(machine: Machine) -> str:
    """The first camera with a mount of the body with most cameras. CalibrationError where no body has two."""
    count: dict[str, list[str]] = {}
    for name, camera in machine.cameras.items():
        if camera.body != "world":
            count.setdefault(camera.body, []).append(name)
    most = max(count.values(), key=len, default=[])
    if len(most) < 2:
        raise CalibrationError(
            "no body of machine.toml carries two cameras; there is no cluster to calibrate"
        )
    mounted = [name for name in most if machine.cameras[name].mount is not None]
    return (mounted or most)[0]


def shared_instants(network: Network, observations: Observations) -> np.ndarray:
    """(m, m) int: instants at which both of two cameras saw a marker of the site; on the diagonal, each one's own."""
    on_site = np.array([marker.body == "world" for marker in network.markers], dtype=bool)
    rows = on_site[network.tag_marker[observations.tag]]
    times = [
        np.unique(observations.time_ns[rows & (observations.camera == c)])
        for c in range(len(network.cameras))
    ]
    count = np.diag([len(t) for t in times])
    for a, t in enumerate(times):
        for b, other in enumerate(times):
            if a < b and len(t) and len(other):
                at = np.clip(np.searchsorted(other, t), 1, max(len(other) - 1, 1))
                near = np.minimum(
                    np.abs(t - other[at - 1]), np.abs(t - other[np.minimum(at, len(other) - 1)])
                )
                count[a, b] = count[b, a] = int(np.sum(near <= SHARED_S * 1e9))
    return count


def _refuse_unshared(network: Network, shared: np.ndarray, reference: int) -> None:
    names = [camera.name for camera in network.cameras]
    for k, name in enumerate(names):
        if shared[k, k] == 0:
            raise CalibrationError(
                f"camera '{name}' saw no marker of the site in this log; check its topic and that markers of site.toml "
                "were before it"
            )
    for k, name in enumerate(names):
        others = shared[k].copy()
        others[k] = 0
        if others.max() == 0:
            raise CalibrationError(
                f"camera '{name}' shares no instant with any other: whenever it saw a marker of the site, no other "
                f"camera did within {SHARED_S:g} s; put up markers so that both see some at once"
            )
    reached = {reference}
    while grown := {
        k
        for k in range(len(names))
        if k not in reached and any(shared[k, j] >= LEAST_SHARED for j in reached)
    }:
        reached |= grown
    for k, name in enumerate(names):
        if k not in reached:
            raise CalibrationError(
                f"camera '{name}' shares only {max(shared[k, j] for j in reached)} instants with the cameras that are "
                f"tied to '{names[reference]}' (at least {LEAST_SHARED}): too few views; record longer, with markers "
                "of the site before both"
            )


def calibrate_cluster(
    machine: Machine, site: Site, reference: str, detections: Mapping[str, Mapping[str, np.ndarray]]
) -> Cluster:
    """Mounts and lenses of the cameras on the reference's body.

    Parameters
    ----------
    machine : Machine
        As loaded, every camera with its intrinsics.
    site : Site
        With the surveyed markers; others without a pose are told along with the cameras.
    reference : str
        The camera that keeps its mount.
    detections : mapping
        By camera: columns of the table ``detections``.

    Returns
    -------
    Cluster

    Raises
    ------
    CalibrationError
        Too few views, a camera apart from the others, or pictures that contradict the files.
    """
    from pipeline.estimation.table import observations_of

    cut = cluster_machine(machine, reference)
    network = network_of(cut, site)
    observations = observations_of(network, {n: rows for n, rows in detections.items() if n in cut.cameras})
    return cluster_of(network, observations, site, reference, defines_body(machine, cut.cutting_edge.body))


def cluster_of(
    network: Network,
    observations: Observations,
    site: Site,
    reference: str,
    alone: bool = True,
    repeated: Repeated | None = None,
) -> Cluster:
    """As `calibrate_cluster`, from the network of `cluster_machine` and what was seen; `repeated` as for `adjusted`."""
    shared = shared_instants(network, observations)
    _refuse_unshared(network, shared, network.camera_index(reference))
    whole = adjusted(network, observations, settings=site.estimation, repeated=repeated, scaled=True)
    benchmarks = refuse_contradiction(whole)
    odd, even = (
        adjusted(
            whole.network,
            _every_second(observations, half),
            settings=site.estimation,
            repeated=repeated,
            scaled=True,
        )
        for half in (0, 1)
    )
    names = [camera.name for camera in network.cameras]
    told = [name for name in names if name != reference]
    difference, expected = halves_disagree(whole, odd, even, [mount_of(name) for name in told])
    body = network.cameras[network.camera_index(reference)].body
    mounts = {name: (whole.value(mount_of(name)), whole.covariance(mount_of(name))) for name in told}
    mounts[reference] = (whole.value(mount_of(reference)), np.zeros((6, 6)))
    lenses = {
        name: (whole.value(f"camera {name} intrinsics"), whole.covariance(f"camera {name} intrinsics"))
        for name in names
    }
    pairs = tuple(
        _pair(whole, body, a, b, int(shared[i, j]))
        for i, a in enumerate(names)
        for j, b in enumerate(names)
        if i < j
    )
    cross = {name: (difference[k], expected[k]) for k, name in enumerate(told)}
    return Cluster(body, reference, whole, mounts, lenses, pairs, cross, benchmarks, alone)


def mount_of(camera: str) -> str:
    """Name of a camera's mount among the statics."""
    return f"camera {camera} mount"


def _pair(whole: Adjusted, body: str, first: str, second: str, instants: int) -> CameraPair:
    T_body_first, T_body_second = whole.value(mount_of(first)), whole.value(mount_of(second))
    T = se3.inverse(T_body_first) @ T_body_second
    # T exp(xi) = exp(-xi_1) T exp(xi_2), felt in the second camera.
    A = -se3.Ad(se3.inverse(T))
    P_1, P_2 = whole.covariance(mount_of(first)), whole.covariance(mount_of(second))
    P_12 = whole.covariance(mount_of(first), mount_of(second))
    covariance = A @ P_1 @ A.T + P_2 + A @ P_12 + (A @ P_12).T
    return CameraPair(first, second, instants, T, covariance, closures(whole, body, first, second, SHARED_S))


def _every_second(observations: Observations, half: int) -> Observations:
    """Every second instant at which anything was seen; what two cameras see within an instant stays together."""
    stamps = np.unique(observations.time_ns)
    instant = np.cumsum(np.concatenate([[0], np.diff(stamps) > SHARED_S * 1e9]))
    keep = instant[np.searchsorted(stamps, observations.time_ns)] % 2 == half
    return observations.take(keep)


def point_sigma_m(covariance: np.ndarray, distance_m: float) -> float:
    """Standard deviation, in its worst direction, of a point ahead of a camera for an error of the camera's pose.

    Parameters
    ----------
    covariance : (6, 6) array
        Of ``xi`` of the camera's pose.
    distance_m : float
        Along the optical axis.
    """
    from pipeline.geometry import so3

    J = np.hstack([np.eye(3), -so3.hat(np.array([0.0, 0.0, distance_m]))])
    return float(np.sqrt(np.linalg.eigvalsh(J @ covariance @ J.T)[-1]))
