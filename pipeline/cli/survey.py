"""``gradetrace survey``: benchmarks from a surveyor's file of marker corners."""

from __future__ import annotations

import datetime
from pathlib import Path

import click

from pipeline.cli.options import FILE, Finite, distance, finite_numbers, say_written
from pipeline.errors import UsageError


@click.command()
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@click.option("--site", metavar="FILE", type=FILE, default=Path("site.toml"), show_default=True,
              help="site.toml with the prints of the markers; their poses are written into it.")  # fmt: skip
@click.option("--order", type=click.Choice(["PNEZD", "PENZD", "named"]), default="PNEZD", show_default=True,
              help="Order of the columns; named: as the line of headings says.")  # fmt: skip
@click.option("--sigma-mm", type=Finite(0.01, 100), default=2.0, show_default=True,
              help="Of each coordinate, where FILE has no column sigma_mm.")  # fmt: skip
@click.option("--layout", metavar="ID=CORNER,...",
              help="What points of other names are: 101=BM1-TL,102=BM1-TR (of one tag: BM1-17-TL).")  # fmt: skip
@click.option("--station", metavar="E,N,H", help="The instrument's place, grid unit: prints must face it.")
@click.option("--date", metavar="DAY", type=click.DateTime(["%Y-%m-%d"]),
              help="Of the survey; else the day FILE was last changed.")  # fmt: skip
@distance(8.0, "From the markers to the cutting edge, for the line that says whether it is good enough.")
def survey(
    file: Path,
    site: Path,
    order: str,
    sigma_mm: float,
    layout: str | None,
    station: str | None,
    date: datetime.datetime | None,
    distance_m: float,
) -> None:
    """Turn surveyed corners of markers (FILE) into benchmarks with covariance, in site.toml.

    Points are named after marker and corner: BM1-TL, BM1-TR, BM1-BR, BM1-BL are top left, top right, bottom right and
    bottom left of the whole print as one looks at it. Three of a marker are enough; every further one checks them.
    """
    from pipeline.stages.survey_markers import run

    written = run(
        file,
        site,
        order,
        sigma_mm,
        _layout(layout),
        _station(station),
        None if date is None else date.date(),
        distance_m,
    )
    say_written(written)


def _layout(text: str | None) -> dict[str, str]:
    pairs = [part.partition("=") for part in (text or "").split(",") if part.strip()]
    if any(not middle for _, middle, _ in pairs):
        raise UsageError("--layout: write pairs such as 101=BM1-TL, separated by commas")
    return {point.strip(): corner.strip() for point, _, corner in pairs}


def _station(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    found = finite_numbers(text, ",", 3)
    if found is None:
        raise UsageError("--station: write easting, northing and elevation, such as 356131.2,5812424.0,36.1")
    return found[0], found[1], found[2]
