"""``gradetrace noise``."""

from __future__ import annotations

import os
from pathlib import Path

import click


@click.command()
@click.argument("log", metavar="LOG", type=click.Path(path_type=Path))
@click.option(
    "--machine", metavar="FILE", type=click.Path(path_type=Path), help="machine.toml, as for report."
)
@click.option("--site", metavar="FILE", type=click.Path(path_type=Path), help="site.toml, as for report.")
@click.option(
    "--runs",
    metavar="DIR",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("runs"),
    show_default=True,
    help="Where results go, as for report.",
)
@click.option(
    "--distance",
    metavar="M",
    type=click.FloatRange(0.1, 1000),
    default=10.0,
    show_default=True,
    help="Working distance at which millimetres are told.",
)
@click.option(
    "--out",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="The sheet; else in the run folder.",
)
def noise(
    log: Path, machine: Path | None, site: Path | None, runs: Path, distance: float, out: Path | None
) -> None:
    """Say how corners scatter while nothing moves, by camera, size and light, beside what was predicted.

    Finds the markers of LOG first, if that was not done yet.
    """
    from pipeline.progress import watch_on
    from pipeline.stages.job import open_job
    from pipeline.stages.noise import measure_noise

    job = open_job(log, machine, site, runs, workers=os.cpu_count() or 1, create_folder=True)
    with job.folder.locked():
        sheet, page = measure_noise(job, distance, watch_on(), out)
    click.echo(sheet.sentence)
    for remark in sheet.remarks:
        click.echo(f"! {remark}")
    click.echo(f"sheet: {page}")
