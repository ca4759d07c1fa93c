"""One least-squares problem, ways to solve it: ours, GTSAM's own factors, SciPy's least_squares; and the algebra alone.

The problem is that of two carriers (`_two_carriers.py`), which GTSAM can express whole: 24 unknowns per epoch and 30
statics, plain least squares, the same start for all. Every way runs in a process of its own, in one thread, with limits
of the processor's seconds and of memory; where a limit struck, what was done by then is told. In one run:

- **ours**: the solver of the package, to the marginals of every state (12 x 12) and all statics;
- **gtsam**: compiled factors (`_gtsam.py`), Gauss-Newton, and the covariance of every pose (6 x 6), velocity (6 x 6)
  and static from its Bayes tree. Making the factors, in Python, is not counted;
- **scipy**: `least_squares` with a sparse Jacobian (`_scipy.py`), made with our residuals. It has no covariances: its
  optimum is all it does;
- **blocks**, **handed**: the same normal equations at every step, ours, given to our arrow and to GTSAM; counted are
  elimination and marginals, not the linearisation, which is ours in both, nor the handing over.

Costs are compared by both functions at both answers: ours at GTSAM's, and GTSAM's factors at ours and at its own.

Bars: costs equal to 1e-7; covariances equal to 1e-7 of their sigmas at the same values; at 10,000 epochs at least 5
times faster than GTSAM to the optimum and all marginals; at 100,000 within 3 minutes and 2 GB, which is what the whole
adjustment may take for three times as many epochs, and where GTSAM is not done.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass

import numpy as np

from benchmarks import _gtsam, _scipy
from benchmarks._results import keep_result
from benchmarks._two_carriers import NO_LOSS, problem_of_two
from pipeline.estimation import arrow
from pipeline.estimation.gauss_newton import deltas_of
from pipeline.estimation.marginals import marginals, marginals_by_part
from pipeline.estimation.normal import cost_by_epoch, linearise
from pipeline.estimation.optimise import IRLS_STEPS, _approached, _iterate
from pipeline.estimation.problem import Problem, keep_all
from pipeline.estimation.values import Values
from pipeline.geometry import se3

LENGTHS = (1_000, 10_000, 100_000)
LONGEST = {"scipy": 10_000, "blocks": 10_000, "handed": 10_000}
"""Epochs up to which the others run."""
LIMIT_S, LIMIT_GB = 300, 16
COST_BAR, COVARIANCE_BAR, FASTER_BAR = 1e-7, 1e-7, 5.0
BUDGET_S, BUDGET_MB = 180.0, 2000.0
"""Of the processor; what GTSAM is held against at the longest."""


@dataclass
class Row:
    """One way at one length; None where it did not get that far."""

    epochs: int
    way: str
    iterations: int | None = None
    optimum_s: float | None = None
    """The processor's seconds from the start to the optimum."""
    marginals_s: float | None = None
    megabytes: float | None = None
    """Largest resident size, the problem and its start included."""
    cost: float | None = None
    """By our function at its answer."""
    its_cost: float | None = None
    """By GTSAM's factors at its answer."""
    at_ours: float | None = None
    """By GTSAM's factors at our answer."""
    covariances: float | None = None
    """Largest difference from ours of any covariance at the same values, in units of both sigmas."""
    ended: str = ""
    """How it ended, where a limit struck."""

    @property
    def seconds(self) -> float | None:
        """To the optimum and the marginals."""
        parts = self.optimum_s, self.marginals_s
        return None if None in parts else sum(parts)  # type: ignore[arg-type]


def our_cost(problem: Problem, values: Values) -> float:
    local, prior = cost_by_epoch(problem, values, keep_all(problem, NO_LOSS))
    return float(local.sum() + prior)


def plain_optimum(problem: Problem) -> tuple[Values, int]:
    """Where our solver ends without its gates, and after how many iterations: they are no part of the problem."""
    weights = keep_all(problem, NO_LOSS)
    values, near = _approached(problem, weights, 50)
    values, iterations, converged, _, _ = _iterate(
        problem, values, weights, 50, irls=0 if near else IRLS_STEPS
    )
    assert converged
    return values, iterations


def tell(**found) -> None:
    """Hand figures to the process that waits, as they come."""
    print(
        json.dumps(found | {"megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}),
        flush=True,
    )


def run_ours(problem: Problem) -> None:
    began = time.process_time()
    values, iterations = plain_optimum(problem)
    tell(optimum_s=time.process_time() - began, iterations=iterations, cost=our_cost(problem, values))
    began = time.process_time()
    for _ in marginals_by_part(problem, values, keep_all(problem, NO_LOSS)):
        pass
    tell(marginals_s=time.process_time() - began)


def run_gtsam(problem: Problem) -> None:
    import gtsam

    graph = _gtsam.Graph(problem)
    settings = gtsam.GaussNewtonParams()
    ordering = graph.ordering()
    settings.setOrdering(ordering)
    settings.setRelativeErrorTol(1e-9)
    began = time.process_time()
    optimiser = gtsam.GaussNewtonOptimizer(graph.factors, graph.start, settings)
    found = optimiser.optimize()
    tell(optimum_s=time.process_time() - began, iterations=optimiser.iterations())
    values = graph.values(found)
    tell(
        cost=our_cost(problem, values),
        its_cost=graph.factors.error(graph.of_ours(values)),
        at_ours=graph.factors.error(graph.of_ours(plain_optimum(problem)[0])),
    )
    began = time.process_time()
    P = _gtsam.covariances(graph.factors.linearize(found), ordering, graph.all_keys())
    tell(marginals_s=time.process_time() - began)
    tell(covariances=covariance_difference(problem, values, graph, P))


def covariance_difference(problem: Problem, values: Values, graph: _gtsam.Graph, P: dict) -> float:
    """Largest difference of GTSAM's covariances from ours, both linearised at its answer."""
    found, worst = marginals(problem, values, keep_all(problem, NO_LOSS)), 0.0

    def differ(ours, key):
        nonlocal worst
        ours = se3.swap_rotation_first(ours, axes=(-2, -1)) if ours.shape[-1] == 6 else ours
        sigma = np.sqrt(np.diagonal(ours))
        theirs = P[key] if len(P[key]) == len(ours) else np.delete(np.delete(P[key], 2, 0), 2, 1)  # no skew
        worst = max(worst, float(np.abs((theirs - ours) / np.outer(sigma, sigma)).max()))

    for index, key in [*graph.mounts.items(), *graph.intrinsics.items()]:
        K, at = problem.statics.sensitivity(index, values.z), problem.statics.columns[index]
        whole = K @ found.P_zz[np.ix_(at, at)] @ K.T
        differ(whole[:4, :4] if index in graph.intrinsics else whole, key)
    for k, (poses, rates) in enumerate(zip(graph.poses, graph.rates, strict=True)):
        c, _ = problem.place(k)
        Y, q = found.Y[c], found.columns[c]
        whole = found.Z[c] + Y @ found.P_zz[np.ix_(q, q)] @ np.swapaxes(Y, -1, -2)
        for i, (x, v) in enumerate(zip(poses, rates, strict=True)):
            differ(whole[i, :6, :6], x)
            differ(whole[i, 6:, 6:], v)
    return worst


def run_blocks(problem: Problem) -> None:
    def solve(values):
        equations = linearise(problem, values, keep_all(problem, NO_LOSS))
        began = time.process_time()
        step = arrow.solve(*equations)
        return time.process_time() - began, step.dx, step.dz, step

    values, step = _gauss_newton(problem, solve)
    _, _, _, step = solve(values)
    began = time.process_time()
    for factor in step.factors:
        arrow.selected_inverse(factor)
    arrow.border(step)
    np.linalg.inv(step.S)
    tell(marginals_s=time.process_time() - began)


def run_handed(problem: Problem) -> None:
    import gtsam

    E, border = len(problem.epochs.time_ns), gtsam.symbol("s", 0)

    def solve(values):
        equations, ordering = _gtsam.handed_over(problem, values, keep_all(problem, NO_LOSS))
        began = time.process_time()
        step = equations.optimize(ordering)
        seconds = time.process_time() - began
        dx = [np.array([step.at(gtsam.symbol("xy"[c], i)) for i in range(E)]) for c in (0, 1)]
        return seconds, dx, step.at(border), (equations, ordering)

    values, _ = _gauss_newton(problem, solve)
    _, _, _, (equations, ordering) = solve(values)
    keys = [ordering.at(i) for i in range(ordering.size())]
    began = time.process_time()
    _gtsam.covariances(equations, ordering, keys)
    tell(marginals_s=time.process_time() - began)


def _gauss_newton(problem: Problem, solve):
    """Steps until the cost stands still; tells the seconds that ``solve`` counted."""
    values, seconds, iterations, settled = problem.first, 0.0, 0, False
    cost = our_cost(problem, values)
    while not settled and iterations < 10:
        used, dx, dz, kept = solve(values)
        values = values.retract(deltas_of(problem, dx), dz)
        before, cost = cost, our_cost(problem, values)
        settled = abs(before - cost) < 1e-9 * cost
        seconds, iterations = seconds + used, iterations + 1
    tell(optimum_s=seconds, iterations=iterations, cost=cost)
    return values, kept


def run_scipy(problem: Problem) -> None:
    began = time.process_time()
    values, _, iterations = _scipy.solve(problem)
    tell(optimum_s=time.process_time() - began, iterations=iterations, cost=our_cost(problem, values))


RUNS = {"ours": run_ours, "gtsam": run_gtsam, "scipy": run_scipy, "blocks": run_blocks, "handed": run_handed}


def measure(epochs: int, way: str, limit_s: int, limit_gb: int) -> Row:
    """Run one way at one length, in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.solvers", "--one", way, "--epochs", str(epochs),
               "--limit-s", str(limit_s), "--limit-gb", str(limit_gb)]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    row = Row(epochs, way)
    for line in done.stdout.splitlines():
        for name, value in json.loads(line).items():
            setattr(row, name, value)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [""])[-1]
        row.ended = (
            f"stopped after {limit_s} s of the processor" if done.returncode in (-9, -24)
            else f"more than {limit_gb} GB" if "bad_alloc" in done.stderr or "MemoryError" in done.stderr
            else f"died of signal {-done.returncode}" if done.returncode < 0 else last
        )  # fmt: skip
    return row


def one(way: str, epochs: int, limit_s: int, limit_gb: int) -> None:
    """The child: load what numba has compiled, then go."""
    small = problem_of_two(60)
    marginals(small, plain_optimum(small)[0], keep_all(small, NO_LOSS))
    arrow.solve(*linearise(small, small.first, keep_all(small, NO_LOSS)))
    problem = problem_of_two(epochs)
    used = round(time.process_time())
    resource.setrlimit(resource.RLIMIT_CPU, (used + limit_s, used + limit_s + 5))
    resource.setrlimit(resource.RLIMIT_AS, (limit_gb * 2**30, limit_gb * 2**30))
    RUNS[way](problem)


def within_budget(row: Row | None) -> bool:
    """Whether it got to the end with what the adjustment of a shift may take."""
    if row is None or row.seconds is None or row.megabytes is None:
        return False
    return row.seconds <= BUDGET_S and row.megabytes <= BUDGET_MB


def missed_bars(rows: list[Row]) -> list[str]:
    """What does not hold."""
    at = {(row.epochs, row.way): row for row in rows}
    missed = []
    for row in rows:
        ours = at.get((row.epochs, "ours"))
        if ours is None or ours.cost is None:
            missed.append(f"{row.epochs} epochs: ours did not finish ({ours.ended if ours else 'not run'})")
            continue
        costs = {"ours": row.cost, "GTSAM's": row.its_cost, "GTSAM's at ours": row.at_ours}
        if row.way in ("gtsam", "handed", "blocks"):
            for name, cost in costs.items():
                if cost is not None and not abs(cost / ours.cost - 1) < COST_BAR:
                    missed.append(
                        f"{row.epochs} epochs: cost of {row.way} by {name} off by {cost / ours.cost - 1:.1e}"
                    )
        if row.covariances is not None and not row.covariances < COVARIANCE_BAR:
            missed.append(f"{row.epochs} epochs: covariances differ by {row.covariances:.1e}")
    for epochs in LENGTHS[1:]:
        ours, other = at.get((epochs, "ours")), at.get((epochs, "gtsam"))
        if ours is None or other is None:
            missed.append(f"{epochs} epochs not run")
        elif ours.seconds is None:
            missed.append(f"{epochs} epochs: ours did not finish")
        elif epochs == LENGTHS[1] and other.seconds and other.seconds < FASTER_BAR * ours.seconds:
            missed.append(f"{epochs} epochs: only {other.seconds / ours.seconds:.1f} times faster")
    if (LENGTHS[-1], "gtsam") in at:
        if not within_budget(at.get((LENGTHS[-1], "ours"))):
            missed.append(f"{LENGTHS[-1]} epochs: ours beyond {BUDGET_S:.0f} s or {BUDGET_MB:.0f} MB")
        if within_budget(at[LENGTHS[-1], "gtsam"]):
            missed.append(f"{LENGTHS[-1]} epochs: GTSAM finishes too")
    return list(dict.fromkeys(missed))


def described(row: Row, ours: Row) -> str:
    """One line of the table."""

    def figure(value, form):
        return f"{'-':>{form.rstrip('def').split('.')[0]}}" if value is None else f"{value:{form}}"

    off = None if row.cost is None or ours.cost is None else row.cost / ours.cost - 1
    theirs = [abs(c / ours.cost - 1) for c in (row.its_cost, row.at_ours) if c is not None and ours.cost]
    slower = None if row.seconds is None or not ours.seconds else row.seconds / ours.seconds
    first = None if row.optimum_s is None or not ours.optimum_s else row.optimum_s / ours.optimum_s
    return (
        f"{row.epochs:7d} {row.way:7} {figure(row.iterations, '5d')} {figure(row.optimum_s, '8.2f')} "
        f"{figure(row.marginals_s, '8.2f')} {figure(first, '7.1f')} {figure(slower, '7.1f')} "
        f"{figure(row.megabytes, '6.0f')} {figure(row.cost, '14.4f')} {figure(off, '8.0e')} "
        f"{figure(max(theirs) if theirs else None, '8.0e')} {figure(row.covariances, '8.0e')} {row.ended}"
    )


def main() -> int:
    """Print the table and the verdict; 1 if a bar is missed."""
    parser = argparse.ArgumentParser(prog="make bench-solvers", description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--epochs", type=int, nargs="+", default=list(LENGTHS), help="lengths, in place of all three"
    )
    parser.add_argument("--ways", choices=list(RUNS), nargs="+", default=list(RUNS))
    parser.add_argument(
        "--limit-s", type=int, default=LIMIT_S, help="of the processor, for each way and length"
    )
    parser.add_argument("--limit-gb", type=int, default=LIMIT_GB)
    parser.add_argument("--one", choices=list(RUNS), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    limits = arguments.limit_s, arguments.limit_gb
    if arguments.one is not None:
        one(arguments.one, arguments.epochs[0], *limits)
        return 0
    print(f"{'epochs':>7} {'way':7} {'iter.':>5} {'optimum':>8} {'marg. s':>8} {'/ours':>7} {'both':>7} {'MB':>6} "
          f"{'cost by ours':>14} {'off':>8} {'theirs':>8} {'P off':>8}")  # fmt: skip
    rows = []
    for epochs in arguments.epochs:
        ours = None
        for way in RUNS:
            if way not in arguments.ways or epochs > LONGEST.get(way, epochs):
                continue
            rows.append(measure(epochs, way, *limits))
            ours = rows[-1] if ours is None else ours
            print(described(rows[-1], ours), flush=True)
    missed = missed_bars(rows)
    at = {(row.epochs, row.way): row for row in rows}
    parts = []
    for epochs in sorted({row.epochs for row in rows}):
        ours, other = at.get((epochs, "ours")), at.get((epochs, "gtsam"))
        if ours and other and ours.seconds:
            times = other.ended or (f"{other.seconds / ours.seconds:.1f} times" if other.seconds else "")
            memory = f", {ours.megabytes:.0f} and {other.megabytes:.0f} MB" if other.megabytes else ""
            parts.append(f"{epochs} epochs {ours.seconds:.1f} s, GTSAM {times}{memory}")
    line = f"solvers: {'; '.join(parts)}" + (f"; MISSED: {', '.join(missed)}" if missed else "")
    keep_result("solvers", [asdict(row) | {"seconds": row.seconds} for row in rows], line)
    print(line)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
