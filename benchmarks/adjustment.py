"""A whole shift adjusted at once, time and memory by its length: `make bench-adjustment`.

Two bodies with rates (a cab that swings, a stick), two cameras on the cab, two surveyed boards, a marker of two tags on
the stick; 44 statics with priors. Corners come straight from the geometry, no pictures: 0.2 px of noise, 10 Hz, the
boards blind for up to 4 s in 13 % of the time, the stick's marker in 20 %. Each length runs in a process of its own;
measured is the way from observations to the marginals of every state and static: ties, epochs, start, iterations,
covariances with their own and common part, and the cutting edge's. Tables and diagnostics that `adjust` makes of
them are not in it.

Bars: 288,000 epochs in 3 minutes and 2 GB; time per epoch flat from 10,000 epochs up (within 25 %). Where the clock
ran 1.3 times as long as the processor worked, the machine did other work too: then the processor's seconds, of all
cores together, are held against the bar, and the closing line says so. The table is drawn in results/adjustment.png.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks._drawn_corners import CYCLE_S, FRAME_S, blind, noisy_corners, true_statics
from benchmarks._results import FOLDER, keep_result
from pipeline.config import Machine, Site
from pipeline.config.site import EstimationSettings
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.marginals import body_track, common_part, marginals_by_part
from pipeline.estimation.optimise import optimise, unpulled
from pipeline.geometry import se3, so3
from pipeline.network import Network, Observations, network_of
from pipeline.network import frames as fr
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation.simulator import MACHINE, SITE

LENGTHS = (1_000, 10_000, 30_000, 100_000, 288_000)
SECONDS_BAR, MEGABYTES_BAR, FLAT_BAR = 180.0, 2000.0, 1.25
BUSY = 1.3
PICTURE = FOLDER / "adjustment.png"
BLIND = {"cab": 0.13, "stick": 0.2}


@dataclass(frozen=True)
class Row:
    """One length."""

    epochs: int
    tags: int
    unknowns: int
    iterations: int
    converged: bool
    cost: float
    seconds: float
    start_cpu_s: float
    """Processor's seconds for ties, epochs, start and sorting."""
    iterations_cpu_s: float
    marginals_cpu_s: float
    megabytes: float
    """Largest resident size of the process, input included."""
    input_megabytes: float
    """The same before."""
    median_sigma_mm: float
    """Of the cutting edge's elevation: median over the epochs."""

    @property
    def cpu_seconds(self) -> float:
        return self.start_cpu_s + self.iterations_cpu_s + self.marginals_cpu_s

    @property
    def held_seconds(self) -> float:
        """What is held against the bar: of the clock, or of the processor where the machine did other work too."""
        return self.cpu_seconds if self.seconds > BUSY * self.cpu_seconds else self.seconds

    @property
    def microseconds_per_epoch(self) -> float:
        """Of the processor."""
        return 1e6 * self.cpu_seconds / self.epochs


def network_drawn() -> Network:
    """Cab and stick, two cameras, two boards of one tag, a marker of two."""
    machine: Any = copy.deepcopy(MACHINE)
    site: Any = copy.deepcopy(SITE)
    del machine["bodies"]["bucket"], machine["sensors"], machine["motion"]["bucket"]
    machine["cutting_edge"]["body"] = "stick"
    machine["motion"]["cab"] = {"translation": 1e-3, "rotation": 3e-2}
    machine["motion"]["stick"] = {"translation": 2e-1, "rotation": 3e-2}
    for camera in machine["cameras"].values():
        camera["intrinsics"]["sigma"] = [1.0] * 4 + [0.0] * 5
    site["benchmarks"] = {name: site["benchmarks"][name] for name in ("B1", "B2")}
    for board in site["benchmarks"].values():
        board["tags"] = [{"id": board["tags"][0]["id"], "size_m": 0.5}]
    return network_of(Machine.model_validate(machine), Site.model_validate(site))


def corners_drawn(network: Network, epochs: int, seed: int = 0) -> Observations:
    """Noisy corners of a log of this length; the statics differ from the files by draws from their priors."""
    rng = np.random.default_rng(seed)
    truth = true_statics(rng, network)
    t = np.arange(epochs) * FRAME_S
    phase = 2 * np.pi * t / CYCLE_S
    wobble = np.cumsum(rng.standard_normal((epochs, 3)), axis=0) * 1e-5
    turn = np.stack([0.01 * np.sin(3 * phase), 0.01 * np.cos(2 * phase), 0.12 * np.sin(phase)], axis=-1)
    way = np.stack([0.02 * np.sin(2 * phase), 0.02 * np.cos(phase), 1.5 + 0.01 * np.sin(3 * phase)], axis=-1)
    T_world_cab = se3.from_rotation_translation(so3.exp(turn), way + wobble)
    stick_turn = np.stack([0.25 * np.sin(phase + 1), 0.02 * np.sin(phase), 0.02 * np.cos(phase)], axis=-1)
    stick_way = np.stack([1.0 + 0 * t, 6.0 + 0.5 * np.sin(phase), -1.2 + 0.4 * np.cos(phase)], axis=-1)
    T_cab_stick = se3.from_rotation_translation(so3.exp(stick_turn), stick_way)
    T_world = {"world": se3.identity((epochs,)), "cab": T_world_cab, "stick": T_world_cab @ T_cab_stick}
    unseen = {body: blind(rng, epochs, share) for body, share in BLIND.items()}

    def hidden(c: int, m: int):
        benchmark = network.markers[m].benchmark
        if benchmark == (network.cameras[c].name == "dig"):
            return None
        return unseen["cab"] if benchmark else unseen["stick"] & ~unseen["cab"]  # no epoch is empty

    return noisy_corners(rng, network, truth, T_world, hidden)


def run(epochs: int) -> Row:
    """Adjust a log of this length, in this process."""
    network = network_drawn()
    _adjusted(network, corners_drawn(network, 50))  # loads what numba has compiled
    drawn = [corners_drawn(network, epochs)]
    tags = len(drawn[0].tag)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    started = time.monotonic()
    problem, optimum, sigma, cpu = _adjusted(network, drawn.pop())  # the problem has them sorted
    return Row(
        len(problem.epochs.time_ns),
        tags,
        problem.statics.size + len(problem.epochs.time_ns) * sum(v.size for v in problem.tie.variables),
        optimum.iterations,
        optimum.converged,
        optimum.cost,
        time.monotonic() - started,
        cpu[0],
        cpu[1],
        cpu[2],
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        before,
        1000 * float(np.median(sigma)),
    )


def _adjusted(network: Network, observations: Observations):
    clock = [time.process_time()]
    tied = tie(network, observations, {})
    epochs = epochs_of(network, observations.take(tied.used), {})
    del observations
    problem = problem_of_log(network, tied, epochs)
    clock.append(time.process_time())
    settings = EstimationSettings()
    optimum = unpulled(problem, optimise(problem, settings.huber, settings.max_iterations))
    clock.append(time.process_time())
    sigma = np.empty(len(problem.epochs.time_ns))
    for part, found in marginals_by_part(problem, optimum.values, optimum.weights, optimum.eased):
        track = body_track(part.problem, part.values, found, fr.TOOL, "tool")
        cov = (track.own + common_part(track, found.P_zz))[: part.epochs, :3, :3]
        up = track.T_world_body[: part.epochs, 2, :3]
        sigma[part.start : part.stop] = np.sqrt(np.einsum("ni,nij,nj->n", up, cov, up))
    clock.append(time.process_time())
    return problem, optimum, sigma, np.diff(clock).tolist()


def draw(rows: list[Row], path=PICTURE) -> None:
    """Seconds and microseconds per epoch by stage, and memory, over the length of the log."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    whole, each, memory = figure.subplots(1, 3)
    epochs = np.array([row.epochs for row in rows])
    whole.loglog(epochs, [row.cpu_seconds for row in rows], "o-", label="all")
    below = np.zeros(len(rows))
    for name in ("start", "iterations", "marginals"):
        part = np.array([getattr(row, f"{name}_cpu_s") for row in rows])
        whole.loglog(epochs, part, ".-", linewidth=0.8, label=name)
        above = below + 1e6 * part / epochs
        each.fill_between(epochs, below, above, alpha=0.6, label=name)
        below = above
    whole.axhline(SECONDS_BAR, color="k", linestyle=":", linewidth=0.8)
    whole.set(xlabel="epochs", ylabel="s of all cores", title=f"time (bar {SECONDS_BAR:.0f} s)")
    whole.legend(fontsize=7)
    each.set(xscale="log", ylim=(0, None), xlabel="epochs", ylabel="us of all cores", title="time per epoch")
    each.legend(fontsize=7)
    memory.semilogx(epochs, [row.megabytes for row in rows], "o-", label="largest")
    memory.semilogx(epochs, [row.input_megabytes for row in rows], ".-", linewidth=0.8, label="input alone")
    memory.axhline(MEGABYTES_BAR, color="k", linestyle=":", linewidth=0.8)
    memory.set(ylim=(0, None), xlabel="epochs", ylabel="MB", title=f"memory (bar {MEGABYTES_BAR:.0f} MB)")
    memory.legend(fontsize=7)
    figure.savefig(path, dpi=80, metadata={"Software": None})


def main() -> int:
    """Print the table and the verdict; 1 if a bar is missed."""
    parser = argparse.ArgumentParser(prog="make bench-adjustment", description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--epochs", type=int, nargs="+", default=list(LENGTHS), help="lengths, in place of all five"
    )
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one is not None:
        print(json.dumps(dataclasses.asdict(run(arguments.one))))
        return 0
    print(f"{'epochs':>8} {'tags':>8} {'iterations':>10} {'s':>7} {'CPU s':>7} {'start':>6} {'iter.':>6} "
          f"{'marg.':>6} {'MB':>6} {'input':>6} {'us/epoch':>8} {'sigma mm':>8}")  # fmt: skip
    rows = []
    for epochs in arguments.epochs:
        command = [sys.executable, "-m", "benchmarks.adjustment", "--one", str(epochs)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        row = Row(**json.loads(done.stdout.splitlines()[-1]))
        rows.append(row)
        print(f"{row.epochs:8d} {row.tags:8d} {row.iterations:10d} {row.seconds:7.1f} {row.cpu_seconds:7.1f} "
              f"{row.start_cpu_s:6.1f} {row.iterations_cpu_s:6.1f} {row.marginals_cpu_s:6.1f} {row.megabytes:6.0f} "
              f"{row.input_megabytes:6.0f} {row.microseconds_per_epoch:8.0f} {row.median_sigma_mm:8.2f} "
              f"{'#' * round(row.microseconds_per_epoch / 20)}", flush=True)  # fmt: skip
    missed = [f"{row.epochs} epochs did not converge" for row in rows if not row.converged]
    long = [row.microseconds_per_epoch for row in rows if row.epochs >= 9_000]
    if long and max(long) > FLAT_BAR * long[0]:
        missed.append(f"time per epoch not flat ({max(long) / long[0]:.2f} times that of the shortest)")
    last = rows[-1]
    if last.epochs < LENGTHS[-1]:
        missed.append(f"{LENGTHS[-1]} epochs not run")
    if last.held_seconds > SECONDS_BAR or last.megabytes > MEGABYTES_BAR:
        missed.append(f"{last.epochs} epochs beyond {SECONDS_BAR:.0f} s or {MEGABYTES_BAR:.0f} MB")
    line = (
        f"adjustment: {last.epochs} epochs, {last.unknowns} unknowns, {last.iterations} iterations in "
        f"{last.seconds:.0f} s ({last.cpu_seconds:.0f} of the processor), {last.megabytes:.0f} MB, "
        f"{last.microseconds_per_epoch:.0f} us an epoch"
        + (" (the machine was busy)" if last.held_seconds < last.seconds else "")
        + (f"; MISSED: {', '.join(missed)}" if missed else "")
    )
    draw(rows)
    keep_result(
        "adjustment",
        [{**dataclasses.asdict(row), "us_per_epoch": row.microseconds_per_epoch} for row in rows],
        line,
    )
    print(line)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
