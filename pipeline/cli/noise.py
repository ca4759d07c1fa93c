"""``gradetrace noise``."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.cli.options import FILE, LOG, MACHINE, RUNS, SITE, distance, usable_cores


@click.command()
@LOG
@MACHINE
@SITE
@RUNS
@distance(10.0, "Working distance at which millimetres are told.", 0.1, 1000)
@click.option(
    "--out",
    metavar="FILE",
    type=FILE,
    help="The sheet; else in the run folder.",
)
def noise(
    log: Path, machine: Path | None, site: Path | None, runs: Path, distance_m: float, out: Path | None
) -> None:
    """Say how corners scatter while nothing moves, by camera, size and light, beside what was predicted.

    Finds the markers of LOG first, if that was not done yet.
    """
    from pipeline.progress import watch_on
    from pipeline.stages.job import open_job
    from pipeline.stages.noise import measure_noise

    job = open_job(log, machine, site, runs, workers=usable_cores(), create_folder=True)
    with job.folder.locked():
        sheet, page = measure_noise(job, distance_m, watch_on(), out)
    click.echo(sheet.sentence)
    for remark in sheet.remarks:
        click.echo(f"! {remark}")
    click.echo(f"sheet: {page}")
