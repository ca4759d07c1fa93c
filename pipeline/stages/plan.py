"""plan: machine.toml and site.toml -> a sheet with the accuracy to be expected, before anybody drives out.

Not a stage of the run: it has no log. With a run folder it takes the arm, the corners' noise and how the machine moved
from it, and holds the prediction against that log's own report.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.config import Machine, Site, load_machine, load_site
from pipeline.config.document import decode, read_file
from pipeline.errors import PlanningError
from pipeline.estimation.repeated import Repeated, information_share, rests
from pipeline.geometry import se3
from pipeline.network import network_of
from pipeline.network.model import Network, Observations
from pipeline.planning.looks import Looking
from pipeline.planning.outcome import Plan, at_posture
from pipeline.planning.outcome import plan as make_plan
from pipeline.planning.postures import Arm, Chain, arm_of, chain_of, fitted_arm, world_poses
from pipeline.planning.prediction import Prediction, Setup, predict
from pipeline.planning.sight import SightRules, sight
from pipeline.planning.work import Habits, Trench
from pipeline.report.plan_sheet import LogComparison, plan_sheet, verdict
from pipeline.report.sheet import Sheet
from pipeline.report.words import Words
from pipeline.stages.job import resolve_named_file
from pipeline.stages.logged_postures import LoggedRun, read_run, with_lenses_of
from pipeline.surface.design import read_design

STATIONS = 60
"""At most, along the trench."""
DEPTH_M = 1.5
"""Of the floor below the tracks, where nothing states the ground."""


@dataclass(frozen=True)
class Wishes:
    """What the command line says of the work; None where it says nothing."""

    area: tuple[float, float] | None = None
    """First and last station, grid unit."""
    directions_deg: tuple[float, float, float] | None = None
    """Of boom, stick and pin-to-edge, of one posture."""
    reach_depth_m: tuple[float, float] | None = None
    """Of the edge, in one posture."""
    boom_foot: tuple[float, float, float] | None = None
    boom_m: float | None = None
    ground: float | None = None
    """Elevation of the tracks, grid unit."""
    habits: Habits = field(default_factory=Habits)
    looks: float | None = None
    frame_s: float | None = None
    sigma_px: float | None = None
    """Of a corner of a tag of 40 px."""
    points: int = 100
    search: bool = True


def plan_of_files(
    machine_file: Path, site_file: Path, wishes: Wishes, run: Path | None = None
) -> tuple[Sheet, str, Plan]:
    """The plan of a job from its two files; the sheet, the sentence of its verdict, and the plan.

    Raises
    ------
    PipelineError
        A file cannot be read, the files do not go together, or the machine or the trench cannot be planned with.
    """
    texts = {kind: read_file(file) for kind, file in (("machine", machine_file), ("site", site_file))}
    machine = load_machine(decode(texts["machine"], str(machine_file)), str(machine_file))
    site = load_site(decode(texts["site"], str(site_file)), str(site_file))
    if run is not None:
        machine = with_lenses_of(run, machine, str(machine_file))
    network = network_of(machine, site)
    chain = chain_of(network)
    words = Words()
    logged = None if run is None else read_run(run, network, site)
    arm, remarks = _arm(wishes, chain, logged, words)
    trench, assumed = _trench(site, site_file, wishes, logged, chain, words)
    setup = _setup(network, arm, chain, wishes, logged)
    tolerance = site.tolerance
    half = 0.5 * (tolerance.high_mm + tolerance.low_mm) / 1000
    plan = make_plan(
        setup, arm, trench, wishes.habits, half, tolerance.coverage_factor, wishes.points, wishes.search
    )
    at = None
    if wishes.directions_deg or wishes.reach_depth_m:
        edge = at_posture(plan, trench, wishes.directions_deg, wishes.reach_depth_m or (0.0, 0.0))
        at = (_named(wishes), edge)
    compared = None
    if logged is not None:
        edge = with_log(setup, logged).edge
        compared = LogComparison(
            logged.name,
            float(np.nanmedian(edge.sigma_h())),
            logged.reported,
            float(np.nanmedian(edge.sigma_h("own"))),
            logged.reported_own,
        )
    hashes = {
        words(
            f"planning.origin_{kind}"
        ): f"{file.name}, sha256 {hashlib.sha256(texts[kind]).hexdigest()[:12]}"
        for kind, file in (("machine", machine_file), ("site", site_file))
    }
    origin = hashes | _origin(plan, trench, words)
    subject = f"{_machine_name(machine)}, {site.site.name or site.site.id}"
    sheet = plan_sheet(plan, subject, [*remarks, *assumed], origin, compared, at)
    return sheet, verdict(plan, words)[1], plan


def with_log(setup: Setup, logged: LoggedRun) -> Prediction:
    """The prediction for the very postures of a log, with the rests that the machine took in it."""
    T_world = world_poses(setup.network, logged.postures)
    seen = sight(setup.network, T_world, setup.rules, setup.arm, setup.arm_bodies)
    rows, camera, tag = np.nonzero(seen.seen)
    cov = np.broadcast_to(np.eye(2), (len(rows), 4, 2, 2))
    stays = rests(Observations(camera, tag, logged.time_ns[rows], seen.uv[rows, camera, tag], cov))
    share = np.ones(seen.reason.shape)
    share[rows, camera, tag] = information_share(stays, setup.looking.repeated)
    return predict(setup, logged.postures, share)


def _machine_name(machine: Machine) -> str:
    return machine.machine.name or machine.machine.id


def _named(wishes: Wishes) -> str:
    if wishes.directions_deg:
        return "boom {:g}, stick {:g}, bucket {:g} deg".format(*wishes.directions_deg)
    assert wishes.reach_depth_m
    return "reach {:g} m, depth {:g} m".format(*wishes.reach_depth_m)


def _arm(wishes: Wishes, chain: Chain, logged: LoggedRun | None, words: Words) -> tuple[Arm, list[str]]:
    if logged is not None and wishes.boom_m is None and wishes.boom_foot is None:
        T = logged.postures.T_world
        return fitted_arm(se3.inverse(T[chain.cab]) @ T[chain.stick], chain.pin_m), []
    arm = arm_of(wishes.boom_foot, wishes.boom_m, chain.pin_m)
    return arm, [] if wishes.boom_m and wishes.boom_foot else [words("planning.assumed_arm")]


def _trench(
    site: Site, site_file: Path, wishes: Wishes, logged: LoggedRun | None, chain: Chain, words: Words
):
    design, alignment = read_design(
        resolve_named_file(site_file.parent, site.design.file, f"{site_file.name}: design.file"), site
    )
    scale = site.grid.metres_per_unit
    first, last = design.station_range()
    first, last = max(first, alignment.start_station), min(last, alignment.end_station)
    if wishes.area is not None:
        low, high = (s * scale for s in wishes.area)
        if low >= high or high <= first or low >= last:
            raise PlanningError(
                f"--area {wishes.area[0]:g}:{wishes.area[1]:g} is not on the trench, which runs from station "
                f"{first / scale:.2f} to {last / scale:.2f}; give two stations of it, the lower one first"
            )
        first, last = max(first, low), min(last, high)
    station = np.linspace(first, last, int(np.clip(np.ceil(last - first) + 1, 2, STATIONS)))
    origin = site.grid.to_grid_metres(np.zeros(3))
    floor = np.column_stack([alignment.points(station, 0.0), design.floor_level(station)]) - origin
    inner = np.clip(station, alignment.start_station + 0.01, alignment.end_station - 0.01)
    forward = alignment.points(inner + 0.01, 0.0) - alignment.points(inner - 0.01, 0.0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    good = np.all(np.isfinite(floor), axis=1)
    if not good.any():
        raise PlanningError(
            f"{site.design.file} has no floor along the alignment in this area; give another --area"
        )
    ground, remarks = _ground(site, wishes, logged, chain, floor[good, 2], words)
    return Trench(station[good], floor[good], forward[good], ground), remarks


def _ground(site: Site, wishes: Wishes, logged: LoggedRun | None, chain: Chain, floor, words: Words):
    """Elevation of the tracks in the world, m, and what had to be assumed."""
    to_world = site.grid.to_world
    if wishes.ground is not None:
        return float(to_world(np.array([0.0, 0.0, wishes.ground]))[2]), []
    if logged is not None:
        return float(np.median(logged.postures.T_world[chain.cab][:, 2, 3])), []
    if site.ground is not None and site.ground.elevation is not None:
        return float(to_world(np.array([0.0, 0.0, site.ground.elevation]))[2]), []
    return float(floor.max()) + DEPTH_M, [words("planning.assumed_ground", above=DEPTH_M)]


def _setup(network: Network, arm: Arm, chain: Chain, wishes: Wishes, logged: LoggedRun | None) -> Setup:
    looking = Looking(repeated=Repeated()) if logged is None else logged.looking
    noise = looking.noise
    if wishes.sigma_px is not None:
        noise = type(noise)(wishes.sigma_px, noise.power, noise.least_px)
    frame_s = wishes.frame_s or looking.frame_s
    per_look = max(looking.readings_per_look * frame_s / looking.frame_s, 1.0)
    return Setup(
        network,
        arm,
        (chain.cab, chain.stick),
        Looking(frame_s, per_look, looking.repeated, noise),
        SightRules(),
        wishes.looks or (300.0 if logged is None else logged.looks),
        {} if logged is None else logged.densities,
    )


def _origin(plan: Plan, trench: Trench, words: Words) -> dict[str, str]:
    a, h, look = plan.arm, plan.habits, plan.setup.looking
    return {
        words("planning.origin_arm"): words(
            "planning.arm_text", x=a.foot_x, y=a.foot_y, z=a.foot_z, boom=a.boom, stick=a.stick
        ),
        words("planning.origin_work"): words(
            "planning.work_text",
            reach=h.reach_m,
            sweep=h.sweep_m,
            bucket=h.bucket_deg,
            rate=h.bucket_deg_s,
            ground=trench.ground_m,
        ),
        words("planning.origin_looking"): words(
            "planning.looking_text",
            fps=1 / look.frame_s,
            looks=plan.setup.looks,
            px=look.noise.at_40_px,
            power=look.noise.power,
            constant=look.repeated.constant,
            resting=look.repeated.resting,
        ),
    }
