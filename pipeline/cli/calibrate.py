"""The commands that calibrate: ``gradetrace calibrate ...``."""

from __future__ import annotations

import click

from pipeline.cli.bucket import bucket
from pipeline.cli.intrinsics import intrinsics


@click.group()
def calibrate() -> None:
    """Tell cameras, mounts, joints and the bucket from logs made for it, and write them into machine.toml."""


calibrate.add_command(intrinsics)
calibrate.add_command(bucket)
