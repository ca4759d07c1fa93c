"""Mounts of markers and cameras, and axes of joints, told from a log in which the machine moves before its cameras.

What is to be told is named as machine.toml names it: `markers.stick-board.mount`, `cameras.arm.mount`,
`bodies.bucket.axis`. A mount is left out then, an axis made wide; the rest of the network, and the survey, tell them.
Sensors do not take part: what they read is calibrated afterwards, with these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from pipeline.calibration.adjusted import Adjusted, adjusted
from pipeline.calibration.axes import TOLD, Axis, axis_of_motion
from pipeline.calibration.cluster import EXACT
from pipeline.calibration.contradiction import refuse_contradiction
from pipeline.calibration.held_points import PointFit
from pipeline.calibration.pins import PinShot, axis_static, with_pins
from pipeline.config import Machine, Site
from pipeline.config.machine import CuttingEdge, JointBody, MovingBody
from pipeline.config.quantities import Pose
from pipeline.errors import CalibrationError
from pipeline.geometry import se3
from pipeline.network import frames as fr
from pipeline.network import network_of
from pipeline.network.model import Network, Static

WIDE_M, WIDE_RAD = 0.3, 0.2
"""Prior of what is freed about its start, which is good to a hundredth of it."""
CONTRADICTS = 1e-6
"""Chance that file and log differ by so much and both are right: sigmas of a tape are rough."""
NEAR_S = 0.15
"""A marker and its parent seen by pictures this close are seen together."""


@dataclass(frozen=True, eq=False)
class ToldPose:
    """One quantity of the machine file, told."""

    key: str
    """As machine.toml names it."""
    T: np.ndarray
    covariance: np.ndarray
    """(6, 6) of ``xi``, m and rad; of what no motion tells, the file's."""
    T_file: np.ndarray | None
    """What the file said; None where it said nothing."""
    axis: Axis | None = None
    """Of a joint: what motion alone said, before everything was adjusted."""


@dataclass(frozen=True, eq=False)
class Mounts:
    """What a log tells of a machine."""

    whole: Adjusted
    told: tuple[ToldPose, ...]
    warnings: tuple[str, ...]
    pins: tuple[PointFit, ...] = ()
    """Shots of pins, where there were any."""


def static_of(key: str) -> str:
    """Name among the statics of a quantity of machine.toml. CalibrationError where there is none such."""
    parts = key.split(".")
    if len(parts) == 3 and (parts[0], parts[2]) in _KINDS:
        return f"{_KINDS[parts[0], parts[2]]} {parts[1]} {parts[2]}"
    raise CalibrationError(
        f"'{key}' cannot be freed; what can is written like markers.NAME.mount, cameras.NAME.mount or bodies.NAME.axis"
    )


_KINDS = {("markers", "mount"): "marker", ("cameras", "mount"): "camera", ("bodies", "axis"): "joint"}


def calibrate_mounts(
    machine: Machine,
    site: Site,
    free: Sequence[str],
    detections: Mapping[str, Mapping[str, np.ndarray]],
    pins: Sequence[PinShot] = (),
) -> Mounts:
    """Mounts and axes that a log tells, and surveyed pins.

    Parameters
    ----------
    machine, site : Machine, Site
        As loaded, every camera with its intrinsics.
    free : sequence of str
        Keys of machine.toml to be told; mounts that it leaves out are told anyway.
    detections : mapping
        By camera: columns of the table ``detections``.
    pins : sequence of PinShot
        Their joints' axes are told whether named or not; no marker need hang on what turns about them.

    Raises
    ------
    CalibrationError
        A key is unknown, motion does not suffice, or the log cannot tell something that it was to tell.
    """
    from pipeline.estimation.table import observations_of

    surveyed = tuple(dict.fromkeys(shot.joint for shot in pins))
    keys = _keys(machine, [*free, *(f"bodies.{joint}.axis" for joint in surveyed)])
    joints = [key.split(".")[1] for key in keys if key.startswith("bodies.")]
    seen = {name: rows for name, rows in detections.items() if name in machine.cameras}
    cut = _without_sensors(machine, seen)
    starts: dict[str, np.ndarray] = {}
    axes: dict[str, Axis] = {}
    for joint in joints:
        carried = {n: _sightings(machine, n, seen) for n, m in machine.markers.items() if m.body == joint}
        if joint in surveyed and not sum(carried.values()):
            keys = [key for key in keys if key not in {f"markers.{n}.mount" for n in carried}]
            starts[axis_static(joint)] = _axis_in_file(machine, joint)
            continue
        axes[joint], marker = _axis_alone(cut, site, joint, keys, seen)
        starts[axis_static(joint)] = axes[joint].T_parent_axis
        if f"markers.{marker}.mount" in keys:
            starts[f"marker {marker} mount"] = _turned_as_in_file(machine, marker, axes[joint].T_axis_marker)
    network = _freed(network_of(_unmounted(cut, keys), site), keys, starts, cut)
    whole = adjusted(network, observations_of(network, seen), settings=site.estimation)
    refuse_contradiction(whole)
    fits: tuple[PointFit, ...] = ()
    if pins:
        whole, shot = with_pins(whole, {joint: _parent(machine, joint) for joint in surveyed}, pins)
        fits = shot.each
    _refuse_untold(whole, keys, surveyed)
    told = []
    for key in keys:
        name = static_of(key)
        file = _in_file(machine, key)
        old = None if file is None else file.transform()
        joint = key.split(".")[1] if key.startswith("bodies.") else ""
        covariance = whole.covariance(name)
        if joint:
            covariance = covariance + _conventions(machine, keys, joint)
        told.append(ToldPose(key, whole.value(name), covariance, old, axes.get(joint)))
    contradicted = [said for pose in told if (said := _against_file(machine, pose, surveyed))]
    return Mounts(whole, tuple(told), (*contradicted, *whole.warnings), fits)


def _against_file(machine: Machine, told: ToldPose, surveyed: Sequence[str]) -> str:
    """A sentence where a pose lies further from the file's than both sigmas allow.

    Two ends of a pin have no third that would show a typing error in one, or a shift of both: only the file has.
    """
    kind, name, _ = told.key.split(".")
    of = list(TOLD) if kind == "bodies" else list(range(6))
    file = _in_file(machine, told.key)
    if file is None:
        return ""
    moved = se3.local(file.transform(), told.T)
    both = (told.covariance + file.covariance_xi())[np.ix_(of, of)]
    square = float(moved[of] @ np.linalg.solve(both, moved[of]))
    if square <= chi2.isf(CONTRADICTS, len(of)):
        return ""
    seen = np.where(np.isin(np.arange(6), of), moved, 0.0)
    mm, deg = 1000 * np.linalg.norm(seen[:3]), np.rad2deg(np.linalg.norm(seen[3:]))
    sigmas = np.sqrt(square)
    sentence = (
        f"{told.key} is {mm:.0f} mm and {deg:.1f} deg from where machine.toml has it, {sigmas:.0f} sigmas"
    )
    if kind == "bodies" and name in surveyed:
        raise CalibrationError(
            f"by the shots of its pin {sentence}; check their coordinates, their times and the pin they are of, or "
            "widen its sigmas in machine.toml if that was measured wrong; nothing was written"
        )
    return f"{sentence}: see whether it was knocked, or measured with a larger sigma than the file says"


def _keys(machine: Machine, free: Sequence[str]) -> list[str]:
    keys = [f"markers.{n}.mount" for n, m in machine.markers.items() if m.mount is None]
    keys += [f"cameras.{n}.mount" for n, c in machine.cameras.items() if c.mount is None]
    for key in free:
        static_of(key)
        kind, name, _ = key.split(".")
        table: Mapping[str, object] = getattr(machine, kind)
        if name not in table:
            raise CalibrationError(
                f"'{key}': there is no such one in machine.toml; known are {', '.join(table)}"
            )
        if kind == "bodies" and not isinstance(table[name], JointBody):
            raise CalibrationError(f"'{key}': body '{name}' is no joint and has no axis")
        if key not in keys:
            keys.append(key)
    if not keys:
        raise CalibrationError(
            "nothing is to be told: name with --free what is, such as --free markers.stick-board.mount "
            "--free bodies.bucket.axis"
        )
    return keys


def _in_file(machine: Machine, key: str) -> Pose | None:
    kind, name, what = key.split(".")
    pose: Pose | None = getattr(getattr(machine, kind)[name], what)
    return pose


def _without_sensors(machine: Machine, seen: Mapping[str, object]) -> Machine:
    """Without sensors and the edge: the edge hangs on the body that carries the most cameras."""
    carriers = [c.body for n, c in machine.cameras.items() if n in seen and c.body != "world"]
    body = max(carriers, key=carriers.count, default=next(iter(machine.bodies)))
    edge = CuttingEdge(body=body, mount=EXACT, width_m=1.0)
    return machine.model_copy(update={"sensors": {}, "cutting_edge": edge})


def _unmounted(machine: Machine, keys: Sequence[str]) -> Machine:
    """Freed mounts left out."""
    update: dict[str, dict] = {}
    for kind in ("markers", "cameras"):
        table = getattr(machine, kind)
        update[kind] = {
            n: item.model_copy(update={"mount": None}) if f"{kind}.{n}.mount" in keys else item
            for n, item in table.items()
        }
    return machine.model_copy(update=update)


def _axis_alone(machine: Machine, site: Site, joint: str, keys: Sequence[str], seen) -> tuple[Axis, str]:
    """The axis from the motion of a marker on the child, with the child taken as a body that moves freely."""
    from pipeline.estimation.table import observations_of

    body = machine.bodies[joint]
    assert isinstance(body, JointBody)
    carried = [n for n, m in machine.markers.items() if m.body == joint]
    if not carried:
        raise CalibrationError(
            f"bodies.{joint}.axis: no marker of machine.toml hangs on '{joint}'; put one on it (magnets will do) and "
            f'describe it as [markers.NAME] with body = "{joint}" and without a mount'
        )
    on_parent = {
        f"markers.{n}.mount": m.mount is None or f"markers.{n}.mount" in keys
        for n, m in machine.markers.items()
        if m.body == body.parent
    } | {
        f"cameras.{n}.mount": c.mount is None or f"cameras.{n}.mount" in keys
        for n, c in machine.cameras.items()
        if c.body == body.parent
    }
    if on_parent and all(on_parent.values()):
        raise CalibrationError(
            f"bodies.{joint}.axis and {' and '.join(on_parent)} cannot both be told: pictures show only what they make "
            "together; keep one of them as measured (leave it out of --free)"
        )
    marker = max(carried, key=lambda n: _sightings(machine, n, seen))
    loose = _unmounted(
        machine, [k for k in keys if k != f"markers.{marker}.mount" and not k.startswith("bodies.")]
    )
    exact = loose.markers[marker].model_copy(update={"mount": EXACT})
    others = {n: m for n, m in loose.markers.items() if m.body != joint} | {marker: exact}
    bodies = dict(loose.bodies) | {joint: MovingBody(kind="moving")}
    motion = dict(machine.motion)
    motion.pop(joint, None)
    network = network_of(
        loose.model_copy(update={"markers": others, "bodies": bodies, "motion": motion}), site
    )
    observations = observations_of(network, seen)
    if not np.any(network.tag_marker[observations.tag] == _index(network, marker)):
        raise CalibrationError(
            f"marker '{marker}' on '{joint}' was never seen; turn it to a camera, and check its ids"
        )
    found = adjusted(network, observations, settings=site.estimation)
    for needed in (joint, body.parent):
        if fr.body_frame(needed) not in found.problem.tie.frames:
            raise CalibrationError(
                f"bodies.{joint}.axis: '{needed}' is not tied to anything that was seen; its axis needs a marker on "
                f"'{body.parent}' (or a camera on it) and one on '{joint}' in view"
            )
    rows = _together(found, marker, body.parent)
    T = se3.inverse(found.pose_of_body(body.parent)[rows]) @ found.pose_of_body(joint)[rows]
    covariance = np.tile(np.diag(np.repeat([2e-3, 3e-3], 3) ** 2), (len(rows), 1, 1))
    return axis_of_motion(T, covariance, body.axis.transform(), joint), marker


def _parent(machine: Machine, joint: str) -> str:
    body = machine.bodies[joint]
    assert isinstance(body, JointBody)
    return body.parent


def _axis_in_file(machine: Machine, joint: str) -> np.ndarray:
    body = machine.bodies[joint]
    assert isinstance(body, JointBody)
    return np.asarray(body.axis.transform())


def _index(network: Network, marker: str) -> int:
    return [m.name for m in network.markers].index(marker)


def _sightings(machine: Machine, marker: str, seen) -> int:
    mark = machine.markers[marker]
    ids = [tag.id for tag in mark.tags]
    return sum(
        int(np.sum(np.isin(rows["tag_id"], ids) & (rows["family"] == mark.family))) for rows in seen.values()
    )


def _together(found: Adjusted, marker: str, parent: str) -> np.ndarray:
    """Epochs at which the marker was in a picture, and within a moment a marker or camera of the parent too."""
    network, problem = found.network, found.problem
    seen, epoch = problem.epochs.observations, problem.epochs.epoch
    marker_of = network.tag_marker[seen.tag]
    own = np.unique(epoch[marker_of == _index(network, marker)])
    on_parent = np.array([m.body == parent for m in network.markers], dtype=bool)[marker_of]
    on_parent |= np.array([c.body == parent for c in network.cameras], dtype=bool)[seen.camera]
    times = np.unique(problem.epochs.time_ns[epoch[on_parent]])
    if not len(times):
        return own[:0]
    t = problem.epochs.time_ns[own]
    gap = np.min(np.abs(t[:, None] - times[None]), axis=1)
    return own[gap <= NEAR_S * 1e9]


def _freed(
    network: Network, keys: Sequence[str], starts: Mapping[str, np.ndarray], machine: Machine
) -> Network:
    """The network with freed axes, and mounts of known start, made wide about it."""
    statics = list(network.statics)
    names = {s.name: k for k, s in enumerate(statics)}
    wide = np.repeat([WIDE_M, WIDE_RAD], 3) ** 2
    for name, T in starts.items():
        k = names[name]
        static = statics[k]
        # Turned about the axis it would only change where the angle is zero, which the pictures cannot tell.
        about = se3.Ad(se3.inverse(T))[:, 5]
        covariance = np.diag(wide) - np.outer(about, about) / (about @ (about / wide))
        if name.startswith("joint "):
            # Where along the line the frame lies, and where its angle is zero, are conventions: exact while the rest
            # is told, or they would be in the marker's mount as well.
            covariance = np.zeros((6, 6))
            told = list(TOLD)
            if _marker_is_known(machine, keys, name.split(" ")[1]):
                told.append(2)
            covariance[told, told] = wide[told]
        statics[k] = _about(static, T, covariance)
    return replace(network, statics=tuple(statics))


def _turned_as_in_file(machine: Machine, marker: str, T_axis_marker: np.ndarray) -> np.ndarray:
    """The marker turned about the axis until it lies as the file has it; as it is where the file says nothing."""
    mount = machine.markers[marker].mount
    if mount is None:
        return T_axis_marker
    R = mount.transform()[:3, :3] @ T_axis_marker[:3, :3].T
    return np.asarray(fr.turn(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])) @ T_axis_marker)


def _about(static: Static, T: np.ndarray, covariance: np.ndarray) -> Static:
    return replace(static, value=T, covariance=covariance, surveyed=True)


def _conventions(machine: Machine, keys: Sequence[str], joint: str) -> np.ndarray:
    """(6, 6) the file's own variance of an axis in what no motion tells."""
    body = machine.bodies[joint]
    assert isinstance(body, JointBody)
    kept = [i for i in range(6) if i not in TOLD and not (i == 2 and _marker_is_known(machine, keys, joint))]
    covariance = np.zeros((6, 6))
    covariance[kept, kept] = np.diagonal(body.axis.covariance_xi())[kept]
    return covariance


def _marker_is_known(machine: Machine, keys: Sequence[str], joint: str) -> bool:
    return any(
        m.body == joint and m.mount is not None and f"markers.{n}.mount" not in keys
        for n, m in machine.markers.items()
    )


def _refuse_untold(whole: Adjusted, keys: Sequence[str], surveyed: Sequence[str]) -> None:
    by_shots = {axis_static(joint) for joint in surveyed}  # the pictures alone need not tell them
    names = {static_of(key): key for key in keys if static_of(key) not in by_shots}
    for finding in whole.untold:
        if finding.kind == "in series" and set(finding.quantities) <= set(names):
            a, b = (names[q] for q in finding.quantities)
            raise CalibrationError(
                f"{a} and {b} cannot both be told: pictures show only what they make together; keep one of them as "
                "measured (leave it out of --free), or give the log something that sees between them"
            )
        if finding.kind == "untold" and set(finding.quantities) & set(names):
            lost = ", ".join(names[q] for q in finding.quantities if q in names)
            raise CalibrationError(
                f"nothing in the log tells {lost}: no camera saw what it carries together with anything that is known; "
                "nothing was written"
            )
    for key in keys:
        if static_of(key) not in {s.name for s in whole.network.statics}:
            continue
        sigma = np.sqrt(np.diagonal(whole.covariance(static_of(key))))
        if sigma[:3].max() > 0.5 or sigma[3:].max() > 0.5:
            raise CalibrationError(
                f"the log leaves {key} open to {sigma[:3].max():.2g} m and {np.rad2deg(sigma[3:].max()):.2g} degrees: "
                "let it be seen together with something that is known; nothing was written"
            )
