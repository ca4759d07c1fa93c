"""Everything to calibrate one machine with, from a tape's machine.toml on: the logs of all calibrations in one folder.

The machine is the sample's of the same seed. What the commands tell from these logs, one after another into the one
machine.toml, is what the sample's shift is measured with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pipeline.synthetic import calibration_log, calibration_logs, calibration_sites, recording, specification
from pipeline.synthetic.specification import Specification
from pipeline.synthetic.touched_stake import calibration_bucket

NAME = "calibration"
Progress = Callable[[int, int], None]


def taped() -> Specification:
    """The sample's site with the sigmas of what tape measure, level and data sheets tell."""
    return replace(
        specification.trench(),
        sigmas=replace(
            calibration_bucket().sigmas,
            camera_mm=calibration_sites.TAPE_MM,
            camera_deg=calibration_sites.TAPE_DEG,
            axis_mm=10.0,
            axis_deg=1.0,
            focal_px=8.0,
            centre_px=4.0,
            distortion=(0.03, 0.1, 0.001, 0.001, 0.0),
        ),
    )


def record_yard(seed: int, folder: Path, jobs: int, progress: Progress) -> Path:
    """Write machine.toml and a folder for each calibration: lenses, cluster, mounts, bucket.

    Parameters
    ----------
    seed
        Of the machine, as for the sample, and of what the files say.
    folder
        Made if it does not exist.
    jobs
        Processes that render.
    progress
        Called with frames written and frames in all, for one log after another.

    Returns
    -------
    Path
        The folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    world = recording.world(taped(), seed)
    machine = calibration_log.machine_text(world.spec, world.files, world.sigma, bucket_board=True)
    (folder / "machine.toml").write_text(machine, encoding="utf-8", newline="\n")
    calibration_logs.intrinsics_log(world.spec, seed, folder / "lenses", progress)
    for name in calibration_sites.NAMES:
        at = folder / name.removeprefix("calibration-")
        calibration_log.record_calibration(name, seed, at, jobs, progress, machine)
    recording.record(calibration_bucket(), seed, folder / "bucket", jobs, progress, machine)
    return folder
