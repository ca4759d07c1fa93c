"""``gradetrace calibrate bucket``."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.cli.options import JOBS, LOG, RUNS, SITE, WRITTEN_MACHINE, Finite, say_written, usable_cores


@click.command()
@LOG
@click.argument("checks", metavar="[CHECKS]", required=False, type=click.Path(path_type=Path, exists=True))
@WRITTEN_MACHINE
@SITE
@click.option("--point", metavar="E,N,H|ID", help="The point that was touched, grid unit, or its id.")
@click.option(
    "--tooth",
    type=click.Choice(["left", "middle", "right", "any"]),
    default="middle",
    show_default=True,
    help="What touched a known point, where CHECKS does not say; any tells nothing along the edge.",
)
@click.option("--contact-mm", type=Finite(0.1, 50), default=1.0, show_default=True,
              help="How well a tooth sits on the mark, standard deviation.")  # fmt: skip
@click.option("--sensor", metavar="NAME", help="Which sensor, where several read the bucket's joint.")
@click.option("--wear", is_flag=True, help="Hold curve and mount, and tell how much the teeth are worn.")
@RUNS
@JOBS
def bucket(
    log: Path,
    checks: Path | None,
    machine: Path | None,
    site: Path | None,
    point: str | None,
    tooth: str,
    contact_mm: float,
    sensor: str | None,
    wear: bool,
    runs: Path,
    jobs: int | None,
) -> None:
    """Tell the bucket's sensor and cutting edge from touches of a known point at several bucket angles.

    LOG was recorded while the edge stood on the point, two seconds each time; CHECKS has the point's coordinates
    and when it was touched, or shots of the parked edge.
    """
    from pipeline.progress import watch_on
    from pipeline.stages.calibrate_bucket import Wanted, calibrate_bucket

    wanted = Wanted(
        log, checks, machine, site, runs, point, tooth, sensor, contact_mm, wear, jobs or usable_cores()
    )
    say_written(calibrate_bucket(wanted, watch_on()))
