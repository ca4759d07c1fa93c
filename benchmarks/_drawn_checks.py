"""Drawn jobs with check shots and a truth: a small excavator that sees three benchmarks, not the house's own network.

Three boards fix the cab by a rigid fit, a second camera on the cab sees the stick, a sensor turns the bucket, and the
edge is at the end of the bucket. The files' values are true but for draws from their sigmas, and for the one cause that
is injected. Everything is computed with rotations, nothing is linearised; the responses that the adjustment would
publish are central differences of the same machine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.estimation.sensitivities import Sensitivities, Source
from pipeline.surface.alignment import Alignment, polyline
from pipeline.surface.checks import COMPARED, Comparison
from pipeline.surface.shot_errors import Differences, differences_of
from pipeline.surface.shots import Shots
from pipeline.tracks.poses import CuttingEdge

T0 = 1_750_000_000_000_000_000
TAU_S = 0.4
OWN_M, SHOT_M = 0.003, 0.002
BOARDS = ("B1", "B2", "B3")
LEVER_M = 1.4
FLOOR, EDGE, CONTROL = 40, 8, 4
"""Shots of each kind: a morning of a surveyor."""
# Unknowns in order: boards (9), turn and shift of the benchmark camera, of the stick's camera, sensor, clock, wear.
SIGMA = np.concatenate(
    [
        np.full(9, 0.002),
        np.full(3, 3e-4),
        np.full(3, 0.002),
        np.full(3, 3e-4),
        np.full(3, 0.002),
        [0.1, 0.004, 0.002],
    ]
)
SENSOR, CLOCK, WEAR = 21, 22, 23
SOURCES = (
    *(Source("benchmark", name, axis, "m") for name in BOARDS for axis in "enh"),
    Source("sensor", "pot", "", "deg"),
    Source("time offset", "pot", "", "s"),
    Source("wear", "", "", "m"),
)
PLACE = {source: k for k, source in zip((*range(9), SENSOR, CLOCK, WEAR), SOURCES)}


@dataclass(frozen=True)
class Poses:
    """The machine at each shot, in truth; (n,) entries."""

    boards: np.ndarray
    """(3, 3) grid."""
    R_cab: Rotation
    p_cab: np.ndarray
    R_stick: Rotation
    """In the cab."""
    p_stick: np.ndarray
    angle_deg: np.ndarray
    rate_deg_s: np.ndarray


def poses(rng: np.random.Generator) -> tuple[Poses, np.ndarray]:
    """A machine that retreats along a trench of 20 m, and the kinds of the shots that were taken of it."""
    kinds = np.array(["floor"] * FLOOR + ["edge"] * EDGE + ["control"] * CONTROL, object)
    n = len(kinds)
    along = np.linspace(0, 18, n)[rng.permutation(n)]
    turn = rng.normal(0, [3, 3, 25], (n, 3))
    boards = np.array([[4.0, 9.0, 1.5], [12.0, 10.0, 3.0], [8.0, 13.0, 2.0]]) + rng.normal(0, 0.5, (3, 3))
    reach = rng.uniform(4.0, 8.0, n)
    pitch = rng.uniform(-35, 35, n)
    rate = np.where(kinds == "floor", rng.choice([-1, 1], n) * rng.uniform(5, 40, n), 0.0)
    return (
        Poses(
            boards,
            Rotation.from_euler("xyz", turn, degrees=True),
            np.column_stack([along, rng.normal(0, 0.3, n), np.full(n, 1.2)]),
            Rotation.from_euler("y", pitch[:, None], degrees=True),
            np.column_stack([reach, rng.normal(0, 0.1, n), rng.uniform(-1.5, 0.0, n)]),
            rng.uniform(-45, 45, n),
            rate,
        ),
        kinds,
    )


def edge_of(at: Poses, error: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Where the files have the edge's middle, and how it is turned, if they are off the truth by `error` (24,)."""
    boards = at.boards + error[:9].reshape(3, 3)
    seen = at.R_cab.inv()
    p_seen = np.stack([seen.apply(b - at.p_cab) for b in at.boards], axis=1)
    p_seen = (
        Rotation.from_rotvec(error[9:12]).apply(p_seen.reshape(-1, 3)).reshape(p_seen.shape) + error[12:15]
    )
    # The rigid motion that lays what is seen onto the boards (Kabsch), for each shot.
    a, b = p_seen - p_seen.mean(axis=1, keepdims=True), boards - boards.mean(axis=0)
    U, _, Vt = np.linalg.svd(np.einsum("bj,nbi->nji", b, a))
    flip = np.ones((len(a), 3))
    flip[:, 2] = np.linalg.det(U @ Vt)
    R = Rotation.from_matrix(np.einsum("nij,nj,njk->nik", U, flip, Vt))
    p = boards.mean(axis=0) - R.apply(p_seen.mean(axis=1))
    arm = Rotation.from_rotvec(error[15:18])
    R_stick = R * arm * at.R_stick
    p_stick = R.apply(arm.apply(at.p_stick) + error[18:21]) + p
    angle = at.angle_deg + error[SENSOR] + at.rate_deg_s * error[CLOCK]
    R_tool = R_stick * Rotation.from_euler("y", angle[:, None], degrees=True)
    # The teeth point down at angle 0; a file with more wear has a shorter edge.
    return p_stick + R_tool.apply([0.0, 0.0, -(LEVER_M - error[WEAR])]), R_tool


def answer_of(at: Poses, time_ns: np.ndarray) -> Sensitivities:
    """What the adjustment would publish of it: responses to the files' values, and the common error by unknown."""
    columns = []
    for k in range(len(SIGMA)):
        step = np.zeros(len(SIGMA))
        step[k] = 0.01 * SIGMA[k]
        (p, R), (q, Q) = edge_of(at, step), edge_of(at, -step)
        columns.append(np.concatenate([p - q, (R * Q.inv()).as_rotvec()], axis=1) / (2 * step[k]))
    response = np.stack(columns, axis=1)
    common = tuple(Source("common", str(k), "", "sigma") for k in range(len(SIGMA)))
    causes = [PLACE[source] for source in SOURCES]
    whole = np.concatenate([response[:, causes], response * SIGMA[:, None]], axis=1)
    return Sensitivities(time_ns, (*SOURCES, *common), whole.astype(np.float32))


@dataclass(frozen=True)
class Morning:
    """Where and when a surveyor measured, before any error is drawn."""

    at: Poses
    kinds: np.ndarray
    time_ns: np.ndarray
    answer: Sensitivities


def morning(rng: np.random.Generator) -> Morning:
    """A machine at work, and the shots that will be taken of it."""
    at, kinds = poses(rng)
    time_ns = T0 + np.round(np.sort(rng.uniform(0, 3600, len(kinds))) * 1e9).astype(np.int64)
    return Morning(at, kinds, time_ns, answer_of(at, time_ns))


def differences(
    rng: np.random.Generator, of: Morning, injected: np.ndarray, datum: np.ndarray
) -> Differences:
    """What the house makes of a morning with every error drawn, and these put in besides."""
    at, kinds, time_ns, answer = of.at, of.kinds, of.time_ns, of.answer
    n = len(kinds)
    truth, _ = edge_of(at, np.zeros(len(SIGMA)))
    error = rng.normal(size=len(SIGMA)) * SIGMA + injected
    middle, _ = edge_of(at, error)
    lag_s = np.abs(time_ns[:, None] - time_ns) * 1e-9
    root = np.linalg.cholesky(np.exp(-lag_s / TAU_S) + 1e-12 * np.eye(n))
    ours = middle + datum + OWN_M * root @ rng.normal(size=(n, 3))
    shot = truth + SHOT_M * rng.normal(size=(n, 3))
    difference = ours - shot
    floor = kinds == "floor"
    factors = answer.response[:, len(SOURCES) :, :3].astype(float)
    common = np.einsum("nri,nrj->nij", factors, factors)
    own = np.broadcast_to(OWN_M**2 * np.eye(3), (n, 3, 3)).copy()
    only_h = np.zeros((3, 3))
    only_h[2, 2] = 1.0
    own[floor], common[floor] = own[floor] * only_h, common[floor] * only_h
    alignment: Alignment = polyline(np.array([[-10.0, 0.0], [40.0, 0.0]]))
    station, offset = alignment.station_offset(shot[:, :2])
    nothing = np.full(n, np.nan)
    comparison = Comparison(
        station=station,
        offset=offset,
        as_built_h=ours[:, 2],
        difference=difference[:, 2],
        difference_e=np.where(floor, nothing, difference[:, 0]),
        difference_n=np.where(floor, nothing, difference[:, 1]),
        own=own,
        common=common,
        sigma_ts=np.full(n, SHOT_M),
        time_ns=time_ns,
        edge_point=np.where(floor, "", "middle").astype(object),
        along_en=np.full((n, 2), np.nan),
        gradient=np.zeros((n, 2)),
        result=np.full(n, COMPARED, object),
    )
    ids = np.array([f"P{i}" for i in range(n)], object)
    shots = Shots(point=ids, code=np.full(n, "", object), p_grid=shot, kind=kinds)
    track = CuttingEdge(
        time_ns,
        np.repeat(middle[:, None], 3, axis=1),
        np.ones(n, bool),
        np.zeros((n, 3, 6)),
        np.zeros((n, 3, 6)),
    )
    return differences_of(shots, comparison, alignment, track, answer, TAU_S)
