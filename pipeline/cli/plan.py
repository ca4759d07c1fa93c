"""The command that predicts: ``gradetrace plan MACHINE SITE``."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.cli.options import Finite, finite_numbers
from pipeline.errors import UsageError


@click.command()
@click.argument("machine", metavar="MACHINE", type=click.Path(path_type=Path))
@click.argument("site", metavar="SITE", type=click.Path(path_type=Path))
@click.option("--log", "run", metavar="RUN", type=click.Path(path_type=Path, file_okay=False),
              help="Run folder of a log (runs/LOG), which tells the arm, the corners and how it moved.")  # fmt: skip
@click.option("--area", metavar="FROM:TO", help="Stations to plan, grid unit; else the whole trench.")
@click.option(
    "--at", metavar="POSTURE", help="One posture too: boom,stick,bucket in degrees, or reach=6,depth=1.5."
)
@click.option("--reach", type=Finite(1, 15), default=6.0, show_default=True,
              help="From the swing centre to the edge while it cuts, m.")  # fmt: skip
@click.option("--faces", type=click.Choice(["down", "up"]), default="down", show_default=True,
              help="Which stations the machine looks towards; it retreats the other way.")  # fmt: skip
@click.option("--boom", type=Finite(1, 15), help="Length of the boom, m.")
@click.option("--boom-foot", metavar="X,Y,Z", help="Pin of the boom in the cab, m.")
@click.option("--ground", type=Finite(-1e5, 1e5), help="Elevation that the tracks stand on, grid unit.")
@click.option("--sigma-px", type=Finite(0.001, 5), help="Of a corner of a tag of 40 px; the paper had 0.2.")
@click.option("--frame-rate", type=Finite(0.1, 200), help="Of each camera, 1/s.")
@click.option("--looks", type=Finite(1, 1e6), help="Over the shift, each from another posture.")
@click.option(
    "--points", type=click.IntRange(10, 300), default=100, show_default=True, help="Along a side of a map."
)
@click.option("--search/--no-search", default=True, help="Whether to try changes and places for a benchmark.")
@click.option("--out", metavar="FILE", type=click.Path(path_type=Path, dir_okay=False), default=Path("plan.html"),
              show_default=True, help="Where the page goes; its numbers go beside it as JSON.")  # fmt: skip
def plan(machine: Path, site: Path, run: Path | None, area: str | None, at: str | None, reach: float, faces: str,
         boom: float | None, boom_foot: str | None, ground: float | None, sigma_px: float | None,
         frame_rate: float | None, looks: float | None, points: int, search: bool, out: Path) -> None:  # fmt: skip
    """Predict how well the cutting edge will be known, before anything is measured.

    MACHINE and SITE are machine.toml and site.toml. Says whether the job's tolerance can be met, where, what limits it,
    and where one more benchmark would help most.
    """
    from pipeline.planning.work import Habits
    from pipeline.stages.calibrated import put_sheet
    from pipeline.stages.plan import Wishes, plan_of_files

    directions, reach_depth = parse_at(at) if at else (None, None)
    stations = _numbers("--area", area, ":", 2)
    foot = _numbers("--boom-foot", boom_foot, ",", 3)
    wishes = Wishes(
        None if stations is None else (stations[0], stations[1]),
        directions,
        reach_depth,
        None if foot is None else (foot[0], foot[1], foot[2]),
        boom,
        ground,
        Habits(reach_m=reach, faces=-1 if faces == "down" else 1),
        looks,
        None if frame_rate is None else 1 / frame_rate,
        sigma_px,
        points,
        search,
    )
    if out.suffix == ".json":
        raise UsageError(f"--out {out}: the numbers go into a .json beside the page; name the page .html")
    sheet, sentence, _ = plan_of_files(machine, site, wishes, run)
    put_sheet(sheet, out)
    click.echo(sentence)
    for remark in sheet.remarks:
        click.echo(remark)
    click.echo(f"plan: {out}")


def parse_at(text: str) -> tuple[tuple[float, float, float] | None, tuple[float, float] | None]:
    """``boom,stick,bucket`` in degrees, or ``reach=M,depth=M``.

    Raises UsageError for anything else.
    """
    named = dict(part.strip().split("=", 1) for part in text.split(",") if "=" in part)
    if not named and (angles := finite_numbers(text, ",", 3)) is not None:
        return (angles[0], angles[1], angles[2]), None
    if set(named) == {"reach", "depth"} and text.count(",") == 1:
        place = finite_numbers(f"{named['reach']},{named['depth']}", ",", 2)
        if place is not None:
            return None, (place[0], place[1])
    raise UsageError(
        f"--at {text}: give boom,stick,bucket in degrees such as 30,-60,-100, or reach=6,depth=1.5"
    )


def _numbers(option: str, text: str | None, separator: str, count: int) -> list[float] | None:
    if text is None:
        return None
    found = finite_numbers(text, separator, count)
    if found is None:
        raise UsageError(f"{option} {text}: give {count} numbers with '{separator}' between them")
    return found
