"""A static that changed during the log, as two: the one of the files up to an instant, and a free one after it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.linalg

from pipeline.errors import EstimationError
from pipeline.estimation import changes, sweeps
from pipeline.estimation.linearised import parts, pieces
from pipeline.estimation.optimise import Optimum, optimise
from pipeline.estimation.problem import Problem
from pipeline.estimation.residuals import Corners, SensorReadings
from pipeline.estimation.steps import mounts_and_sensors
from pipeline.estimation.values import Statics, Values
from pipeline.geometry import se3
from pipeline.network import frames as fr

FREE_POSE = np.array([0.1] * 3 + [0.05] * 3)
"""Prior of a pose after its change, about what it was before: m and rad. A knock; more than that is another place."""
FREE_TIMES = 30.0
"""The same for curves and offsets, as a multiple of their own prior."""
MOST = 4
"""Changes that are looked for one after the other."""
TRIES = 3 * MOST
"""How often one of them is taken back at most; as a rule once each."""


@dataclass(frozen=True, eq=False)
class Step:
    """What a static did at a split, as the split adjustment measures it."""

    static: int
    """The static that changed; where it had changed before, that of the files."""
    after: int
    """The one after."""
    change: changes.Change
    shift: np.ndarray
    """(n,) value after minus before; of a pose ``xi`` in its own frame, m and rad."""
    cov: np.ndarray
    """(n, n), inflated as the test found."""
    others: tuple[int, ...]
    """Statics of which the log tells a change as well or nearly: it cannot say which of them it was."""


def split(problem: Problem, values: Values, static: int, epoch: int, step=None) -> tuple[Problem, Values]:
    """The problem with one static replaced by a free one from an epoch on, and the values to go on from.

    The motion of every body goes through the change unbroken. A body whose pose is kept in the frame of a camera that
    was knocked stays in the frame that the camera had before.

    Parameters
    ----------
    problem, values : Problem, Values
        Before; values need not be the optimum.
    static : int
        Mount of a marker or camera, pose of a benchmark, curve or time offset of a sensor.
    epoch : int
        First epoch of the new static.
    step : (r,) array, optional
        Where to start it: whitened unknowns of the static, after minus before.

    Raises
    ------
    EstimationError
        Nothing that was measured after the epoch hangs on this static.
    """
    old, network = problem.statics, problem.network
    noun, new = network.statics[static], len(network.statics)
    is_offset = any(s.offset == static for s in network.sensors)
    if noun.is_pose:
        scale = np.diag(FREE_POSE)
    else:
        scale = FREE_TIMES * (old.scale[static] if old.scale[static].size else np.eye(len(noun.value)))
    base, z = old.value(static, values.z), np.zeros(scale.shape[1])
    moved = np.zeros(len(scale)) if step is None else old.sensitivity(static, values.z) @ step
    if noun.is_pose:
        base = se3.retract(base, moved)
    else:
        # Readings lie on the epochs by the file's offset: that stays what the correction counts from.
        z = np.linalg.lstsq(scale, base + moved - old.base[static], rcond=None)[0]
        base = old.base[static]
    when = np.datetime64(int(problem.epochs.time_ns[epoch]), "ns").astype("datetime64[s]").item()
    after = replace(
        noun,
        name=f"{noun.name} after {when:%H:%M:%S}",
        value=base,
        covariance=scale @ scale.T,
        surveyed=False,
    )
    statics = Statics(
        (*old.base, base),
        (*old.is_pose, noun.is_pose),
        (*old.scale, scale),
        (*old.columns, old.size + np.arange(scale.shape[1])),
        old.clocks,
        old.size + scale.shape[1],
    )
    frames = problem.tie.frames
    edges = dict(frames.edges)
    names: dict[str, str] = {}
    for frame, edge in frames.edges.items():
        if edge.kind == "static" and edge.index == static:
            names[frame] = f"{frame} after {epoch}"
            edges[names[frame]] = replace(edge, index=new)
    tree = replace(frames, edges=edges)
    corners: list[Corners] = []
    for group in problem.corners:
        ends = _ends(problem, group)
        if not names.keys() & set(ends):
            corners.append(group)
            continue
        path = tree.path(*(names.get(end, end) for end in ends))
        for part, late in _cut(group.epoch, epoch):
            corners.append(_rows(group, part) if not late else replace(_rows(group, part), path=path))
    sensors: list[SensorReadings] = []
    for readings in problem.sensors:
        sensor = readings.sensor
        if static not in (sensor.curve, sensor.offset):
            sensors.append(readings)
            continue
        for part, late in _cut(readings.epoch, epoch):
            own = replace(sensor, offset=new) if is_offset else replace(sensor, curve=new)
            sensors.append(replace(_rows(readings, part), sensor=own if late else sensor))
    if len(corners) + len(sensors) == len(problem.corners) + len(problem.sensors):
        raise EstimationError(
            f"{noun.name} cannot be split at {when:%H:%M:%S}: nothing that hangs on it was measured on both sides; "
            "look at estimation.split in site.toml"
        )
    start = replace(values, z=np.concatenate([values.z, z]))
    whole = replace(
        problem,
        network=replace(network, statics=(*network.statics, after)),
        tie=replace(problem.tie, frames=tree),
        statics=statics,
        corners=tuple(corners),
        sensors=tuple(sensors),
        first=start,
    )
    return whole, start


def _cut(rising, epoch: int) -> Iterator[tuple[slice, bool]]:
    at = int(np.searchsorted(rising, epoch))
    if at > 0:
        yield slice(0, at), False
    if at < len(rising):
        yield slice(at, len(rising)), True


def _rows(group, part: slice):
    """Some rows of a group of measurements: every array in it has one row per epoch."""
    arrays = {f.name: getattr(group, f.name) for f in fields(group)}
    return replace(group, **{name: a[part] for name, a in arrays.items() if isinstance(a, np.ndarray)})


def told(problem: Problem, splits) -> Problem:
    """The problem split as site.toml says.

    Parameters
    ----------
    problem : Problem
        At its start.
    splits : sequence with ``static`` (its name in the tables) and ``at_ns``
        ``estimation.split``.

    Raises
    ------
    EstimationError
        There is no such static, or nothing to split.
    """
    for one in splits:
        known = {s.name: k for k, s in enumerate(problem.network.statics)}
        allowed = mounts_and_sensors(problem)
        if known.get(one.static) not in allowed:
            names = ", ".join(f"'{problem.network.statics[s].name}'" for s in sorted(allowed))
            raise EstimationError(
                f"estimation.split names '{one.static}', which this log cannot split; it can split {names}"
            )
        epoch = int(np.searchsorted(problem.epochs.time_ns, one.at_ns))
        problem, _ = split(problem, problem.first, known[one.static], epoch)
    return problem


def _ends(problem: Problem, group: Corners) -> tuple[str, str]:
    """Frames of the camera and of the marker of a group, those after a split if its path is of then."""
    network, frames = problem.network, problem.tie.frames
    camera = fr.camera_frame(network.cameras[group.camera].name)
    marker = fr.marker_frame(network.markers[group.marker].name)
    way = [step.frame for step in group.path]
    for a in (camera, *(f for f in frames.edges if f.startswith(f"{camera} after "))):
        for b in (marker, *(f for f in frames.edges if f.startswith(f"{marker} after "))):
            if [step.frame for step in frames.path(a, b)] == way:
                return a, b
    raise AssertionError(way)


def trace(
    problem: Problem, optimum: Optimum, huber: float, max_iterations: int
) -> tuple[tuple[Step, ...], Problem, Optimum]:
    """All changes of a log, in the order in which they were found.

    One that moved pulls at all that see it, so only the strongest is believed; it is split, and the others are tested
    again without it. The first was chosen while the log was still bent by the rest: a benchmark that moved and a camera
    that turned while nothing was seen, 15 s before, were first told as another benchmark. So where there are several,
    each is taken back in turn, and what the log then tells in its place stands: the same, another one, or nothing.
    The sizes are those of the last adjustment, in which all of them are free.

    Returns
    -------
    steps : tuple of Step
    problem, optimum : Problem, Optimum
        With every change split; the same as handed in where there is none.
    """
    last: tuple[list[_Found], tuple] = [], (problem, optimum, {})

    def adjusted(found: list[_Found]) -> tuple[Problem, Optimum, dict[int, tuple[int, int]]]:
        nonlocal last
        if found != last[0]:
            whole, places = _split_all(problem, optimum.values, found)
            last = list(found), (whole, optimise(whole, huber, max_iterations), places)
        return last[1]

    def next_to(found: list[_Found]) -> _Found | None:
        whole, at, places = adjusted(found)
        change, others = changes.find(whole, at.values, huber)
        if change is None:
            return None
        root = {after: found[i].static for i, (_, after) in places.items()}
        return _Found(root.get(change.static, change.static), change, tuple(root.get(s, s) for s in others))

    def all_next_to(found: list[_Found]) -> list[_Found]:
        while len(found) < MOST and (new := next_to(found)):
            found = [*found, new]
        return found

    found = all_next_to([])
    sure = tries = 0
    while sure < len(found) and tries < TRIES and (tries or len(found) > 1):
        one, *rest = found
        new, tries = next_to(rest), tries + 1
        same = new is not None and new.static == one.static
        sure = sure + 1 if same else 0
        found = rest if new is None else [*rest, new] if same else all_next_to([*rest, new])
    whole, at, places = adjusted(found)
    if not found:
        return (), whole, at
    cut = parts(whole, at.values, at.weights)
    S = sweeps.reduce(pieces(cut), len(cut)).S
    P_zz = scipy.linalg.cho_solve(scipy.linalg.cho_factor(S), np.eye(len(S)))
    steps = (_measure(whole, at.values, P_zz, one, *places[i]) for i, one in enumerate(found))
    return tuple(steps), whole, at


@dataclass(frozen=True, eq=False)
class _Found:
    static: int
    """Of the problem as it was handed in, also where a part of it changes that had changed before."""
    change: changes.Change
    others: tuple[int, ...]


def _split_all(problem: Problem, values: Values, found: list[_Found]):
    """The problem with all changes split, in order of time; and of each the statics before and after it."""
    places: dict[int, tuple[int, int]] = {}
    latest: dict[int, int] = {}
    for i in sorted(range(len(found)), key=lambda i: found[i].change.epoch):
        one = found[i]
        before, after = latest.get(one.static, one.static), len(problem.network.statics)
        problem, values = split(problem, values, before, one.change.epoch, one.change.step)
        places[i], latest[one.static] = (before, after), after
    return problem, places


def _measure(problem: Problem, values: Values, P_zz, found: _Found, s: int, after: int) -> Step:
    statics, change = problem.statics, found.change
    before_value, after_value = statics.value(s, values.z), statics.value(after, values.z)
    pose = statics.is_pose[s]
    shift = se3.local(before_value, after_value) if pose else after_value - before_value
    # To first order in a step of millimetres and milliradians.
    J = np.zeros((len(shift), statics.size))
    J[:, statics.columns[after]] += statics.sensitivity(after, values.z)
    J[:, statics.columns[s]] -= statics.sensitivity(s, values.z)
    cov = change.inflation * J @ P_zz @ J.T
    return Step(found.static, after, change, shift, cov, found.others)
