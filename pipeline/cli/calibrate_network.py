"""Calibration of what a network tells: ``gradetrace calibrate cluster``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.cli.calibrate import calibrate

FILE = click.Path(path_type=Path, dir_okay=False)
LOG = click.argument("log", metavar="LOG", type=click.Path(path_type=Path))
MACHINE = click.option(
    "--machine",
    metavar="FILE",
    type=FILE,
    help="machine.toml to read and write; else the one beside the log.",
)
SITE = click.option(
    "--site", metavar="FILE", type=FILE, help="site.toml to use; else the one beside the log, else the log's."
)
RUNS = click.option(
    "--runs",
    metavar="DIR",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("runs"),
    show_default=True,
    help="Where the sheet goes, and what was found in the log.",
)
JOBS = click.option(
    "--jobs", metavar="N", type=click.IntRange(1, 512), help="Processes; by default all cores."
)
DISTANCE = click.option(
    "--distance",
    "distance_m",
    metavar="METRES",
    type=click.FloatRange(0.5, 100),
    default=8.0,
    show_default=True,
    help="From the cameras to the cutting edge, for the line that says whether it is good enough.",
)


@calibrate.command()
@LOG
@MACHINE
@SITE
@RUNS
@click.option("--reference", metavar="CAMERA", help="The camera that keeps its mount; by default the first.")
@click.option("--free-intrinsics", is_flag=True, help="Write the lenses as refined along with the mounts.")
@DISTANCE
@JOBS
def cluster(log: Path, jobs: int | None, **options: Any) -> None:
    """Tell the mounts of the cameras on one body from LOG, in which they see surveyed markers.

    Writes them into machine.toml with their covariance; the old file stays beside it. Cameras need not be triggered
    together, but each must see markers of the site while another does.
    """
    from pipeline.cli import usable_cores
    from pipeline.progress import watch_on
    from pipeline.stages.calibrate_cluster import run

    written = run(log, workers=jobs or usable_cores(), watch=watch_on(), **options)
    say(written)


def say(written: Any) -> None:
    """What a calibration left, in a few lines."""
    click.echo(written.sentence)
    for remark in written.remarks:
        click.echo(f"! {remark}")
    click.echo(f"written: {written.file}; the old file is {written.kept.name}")
    click.echo(f"sheet: {written.sheet}")


@calibrate.command()
@LOG
@MACHINE
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
    "--distance",
    "distance_m",
    metavar="METRES",
    type=click.FloatRange(0.5, 100),
    default=3.0,
    show_default=True,
    help="From what is told to the cutting edge, for the line that says whether it is good enough.",
)
@JOBS
def mounts(log: Path, jobs: int | None, **options: Any) -> None:
    """Tell mounts of markers and cameras, and axes of joints, from LOG, in which the machine moves.

    A joint's axis needs a marker on either side of it in view while it turns over its stroke; the one beyond it may be
    held by magnets and needs no mount in machine.toml.
    """
    from pipeline.cli import usable_cores
    from pipeline.progress import watch_on
    from pipeline.stages.calibrate_mounts import run

    say(run(log, workers=jobs or usable_cores(), watch=watch_on(), **options))


@calibrate.command()
@click.argument("files", metavar="FILES...", nargs=-1, required=True, type=FILE)
@click.option(
    "--distance",
    "distance_m",
    metavar="METRES",
    type=click.FloatRange(0.5, 100),
    default=8.0,
    show_default=True,
    help="To the cutting edge.",
)
@click.option("--old", "old_days", metavar="DAYS", type=click.IntRange(1), default=180, show_default=True,
              help="Age from which a calibration is named.")  # fmt: skip
@click.option("--today", metavar="DAY", type=click.DateTime(["%Y-%m-%d"]), help="Count ages until this day.")
def history(files: tuple[Path, ...], distance_m: float, old_days: int, today: Any) -> None:
    """Compare dated machine files: what moved, by how many sigmas and millimetres, and what has grown old.

    FILES are machine.toml and the files that earlier calibrations left beside it, machine.before-*.toml.
    """
    import datetime

    from pipeline.cli import _print_table
    from pipeline.stages.calibrate_history import run

    day = datetime.datetime.now(datetime.UTC).date() if today is None else today.date()
    rows, sentences = run(files, day, distance_m, old_days)
    _print_table(("quantity", "calibrated", "by", "sigmas", "mm at edge", "age, days"), rows)
    for sentence in sentences:
        click.echo(f"! {sentence}")
    if not sentences:
        click.echo("nothing moved by more than chance, and nothing is old")
