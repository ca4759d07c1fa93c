"""Options that several commands have, and how they print."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import click


class Finite(click.FloatRange):
    """A number in a range: click takes nan for one in any, and infinity where the range is open."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number


FILE = click.Path(path_type=Path, dir_okay=False)
LOG = click.argument("log", metavar="LOG", type=click.Path(path_type=Path))
MACHINE = click.option(
    "--machine",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="machine.toml to use; else the one beside the log, else the log's attachment.",
)
WRITTEN_MACHINE = click.option(
    "--machine",
    metavar="FILE",
    type=FILE,
    help="machine.toml to read and write; else the one beside the log.",
)
SITE = click.option(
    "--site",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="site.toml to use; else the one beside the log, else the log's attachment.",
)
RUNS = click.option(
    "--runs",
    metavar="DIR",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("runs"),
    show_default=True,
    help="Where results go; each log has a folder of its own there.",
)
JOBS = click.option(
    "--jobs", metavar="N", type=click.IntRange(1, 512), help="Processes to use; by default all cores."
)


def distance(default: float, what: str, least: float = 0.5, most: float = 100) -> Any:
    """The option `--distance`, handed on as `distance_m`: where millimetres are told."""
    return click.option(
        "--distance",
        "distance_m",
        metavar="METRES",
        type=Finite(least, most),
        default=default,
        show_default=True,
        help=what,
    )


def finite_numbers(text: str, separator: str, count: int) -> list[float] | None:
    """So many numbers with a separator between them; None where the text is anything else."""
    try:
        found = [float(part) for part in text.split(separator)]
    except ValueError:
        return None
    return found if len(found) == count and all(map(math.isfinite, found)) else None


def usable_cores() -> int:
    """Cores this process may use; a container or `taskset` may leave it fewer than the machine has."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


def print_table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Columns side by side; the last one as long as it is."""
    widths = [max(len(row[column]) for row in [head, *rows]) for column in range(len(head) - 1)]
    for row in [head, *rows]:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=False)]
        click.echo("  ".join([*cells, row[-1]]).rstrip())


def say_written(written: Any) -> None:
    """What a calibration left (`stages.calibrated.Written`), in a few lines."""
    click.echo(written.sentence)
    for remark in written.remarks:
        click.echo(f"! {remark}")
    if written.file is not None:
        click.echo(f"written: {written.file}; the old file is {written.kept}")
    click.echo(f"sheet: {written.sheet}")
