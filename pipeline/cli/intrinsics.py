"""``gradetrace calibrate intrinsics``."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import click

from pipeline.cli.options import FILE, distance, say_written


@click.command()
@click.argument("source", metavar="LOG|FOLDER", type=click.Path(path_type=Path))
@click.option(
    "--board",
    metavar="BOARD",
    required=True,
    help="chessboard:COLUMNSxROWS:SQUARE (inner corners, metres), charuco:COLUMNSxROWS:SQUARE:TAG:DICTIONARY or "
    "apriltag:COLUMNSxROWS:TAG:GAP:FAMILY[:FIRST_ID].",
)
@click.option("--camera", metavar="NAME", default="", help="Name of the camera in machine.toml.")
@click.option(
    "--topic", metavar="TOPIC", default="", help="Its pictures in the log; else as machine.toml says."
)
@click.option(
    "--machine",
    metavar="FILE",
    type=FILE,
    help="machine.toml to write the intrinsics into; the old file is kept beside it.",
)
@click.option(
    "--model",
    type=click.Choice(("brown5", "brown8", "fisheye")),
    default="brown5",
    show_default=True,
    help="Model of the lens; machine.toml holds brown5.",
)
@distance(10.0, "Working distance at which millimetres are told.", 0.1, 1000)
@click.option(
    "--size", metavar="WxH", default="", help="Size of the pictures, px; only of a corner file (vnl)."
)
@click.option(
    "--out",
    metavar="FILE",
    type=FILE,
    help="The sheet; else intrinsics-NAME.html.",
)
def intrinsics(
    source: Path,
    board: str,
    camera: str,
    topic: str,
    machine: Path | None,
    model: str,
    distance_m: float,
    size: str,
    out: Path | None,
) -> None:
    """Tell a camera's lens from pictures of a board that was waved before it.

    Pictures come from a log, a folder (png, jpg), a video (mp4) or a corner file (vnl).
    """
    from pipeline.stages.intrinsics import calibrate_intrinsics

    wanted = re.fullmatch(r"(\d{2,5})x(\d{2,5})", size)
    if size and wanted is None:
        raise click.BadParameter(f"'{size}' is no size; for example 1280x720", param_hint="--size")
    written = calibrate_intrinsics(
        source,
        board,
        camera,
        topic,
        machine,
        model,
        distance_m,
        (int(wanted[1]), int(wanted[2])) if wanted else None,
        out,
        _tell if sys.stderr.isatty() else lambda pictures: None,
    )
    say_written(written)


def _tell(pictures: int) -> None:
    if pictures % 10 == 0:
        click.echo(f"pictures {pictures}\r", err=True, nl=False)
