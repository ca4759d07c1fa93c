"""The commands that calibrate: ``gradetrace calibrate ...``."""

from __future__ import annotations

import click

from pipeline.cli.bucket import bucket
from pipeline.cli.calibrate_network import cluster, history, mounts
from pipeline.cli.intrinsics import intrinsics


@click.group()
def calibrate() -> None:
    """Tell cameras, mounts, joints and the bucket from logs made for it, and write them into machine.toml."""


for command in (intrinsics, cluster, mounts, bucket, history):
    calibrate.add_command(command)
