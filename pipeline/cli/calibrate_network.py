"""Calibration of what a network tells: ``gradetrace calibrate cluster``, ``mounts`` and ``history``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.cli.options import (
    FILE,
    JOBS,
    LOG,
    RUNS,
    SITE,
    WRITTEN_MACHINE,
    distance,
    print_table,
    say_written,
    usable_cores,
)


@click.command()
@LOG
@WRITTEN_MACHINE
@SITE
@RUNS
@click.option("--reference", metavar="CAMERA", help="The camera that keeps its mount; by default the first.")
@click.option("--free-intrinsics", is_flag=True, help="Write the lenses as refined along with the mounts.")
@distance(8.0, "From the cameras to the cutting edge, for the line that says whether it is good enough.")
@JOBS
def cluster(log: Path, jobs: int | None, **options: Any) -> None:
    """Tell the mounts of the cameras on one body from LOG, in which they see surveyed markers.

    Writes them into machine.toml with their covariance; the old file stays beside it. Cameras need not be triggered
    together, but each must see markers of the site while another does.
    """
    from pipeline.progress import watch_on
    from pipeline.stages.calibrate_cluster import run

    written = run(log, workers=jobs or usable_cores(), watch=watch_on(), **options)
    say_written(written)


@click.command()
@LOG
@WRITTEN_MACHINE
@SITE
@RUNS
@click.option(
    "--free",
    metavar="KEY",
    multiple=True,
    help="What is to be told: markers.NAME.mount, cameras.NAME.mount or bodies.NAME.axis; may be given several times. "
    "Mounts that machine.toml leaves out are told anyway.",
)
@click.option(
    "--pins",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Shots of pins with their times, named after the joint that turns about them (bucket-L, bucket-R).",
)
@distance(3.0, "From what is told to the cutting edge, for the line that says whether it is good enough.")
@JOBS
def mounts(log: Path, jobs: int | None, **options: Any) -> None:
    """Tell mounts of markers and cameras, and axes of joints, from LOG, in which the machine moves.

    A joint's axis needs a marker on either side of it in view while it turns over its stroke; the one beyond it may be
    held by magnets and needs no mount in machine.toml. Or shots of both ends of its pin, with the machine standing.
    """
    from pipeline.progress import watch_on
    from pipeline.stages.calibrate_mounts import run

    say_written(run(log, workers=jobs or usable_cores(), watch=watch_on(), **options))


@click.command()
@click.argument("files", metavar="FILES...", nargs=-1, required=True, type=FILE)
@distance(8.0, "To the cutting edge.")
@click.option("--old", "old_days", metavar="DAYS", type=click.IntRange(1), default=180, show_default=True,
              help="Age from which a calibration is named.")  # fmt: skip
@click.option("--today", metavar="DAY", type=click.DateTime(["%Y-%m-%d"]), help="Count ages until this day.")
@click.option("--out", metavar="FILE", type=FILE, default=Path("machine-history.html"), show_default=True,
              help="The sheet.")  # fmt: skip
def history(files: tuple[Path, ...], distance_m: float, old_days: int, today: Any, out: Path) -> None:
    """Compare dated machine files: what moved, by how many sigmas and millimetres, and what has grown old.

    FILES are machine.toml and the files that earlier calibrations left beside it, machine.before-*.toml.
    """
    import datetime

    from pipeline.stages.calibrate_history import run

    day = datetime.datetime.now(datetime.UTC).date() if today is None else today.date()
    rows, sentences = run(files, day, distance_m, old_days, out)
    print_table(("quantity", "calibrated", "by", "sigmas", "mm at edge", "age, days"), rows)
    for sentence in sentences:
        click.echo(f"! {sentence}")
    if not sentences:
        click.echo("nothing moved by more than chance, and nothing is old")
    click.echo(f"sheet: {out}")
