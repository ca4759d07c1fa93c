"""What `gradetrace sample-logs` makes: the committed sample, and drawn logs for benchmarks and tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pipeline.errors import UsageError
from pipeline.synthetic import (
    calibration_log,
    calibration_sites,
    recording,
    specification,
    touched_stake,
    yard,
)
from pipeline.synthetic.calibration_logs import LOGS
from pipeline.synthetic.cycle import CYCLE_S, TRAM_S
from pipeline.synthetic.specification import Specification

SIZES = {"640": (640, 480, 850.0), "1280": (1280, 960, 1731.0)}
SITES = {**specification.SITES, **touched_stake.SITES}
SAMPLE_SEED = 17
FOLDER = Path("sample_logs")
DRAWN = FOLDER / "generated"
"""Where drawn logs go; not committed."""

Progress = Callable[[int, int], None]


def specification_of(site: str = "trench", minutes: float | None = None, size: str = "640") -> Specification:
    """The specification of a named site, of a wanted length and camera.

    Raises UsageError.
    """
    if site not in SITES:
        raise UsageError(f"there is no site '{site}': known are {', '.join(SITES)}")
    spec = SITES[site]()
    if size not in SIZES:
        raise UsageError(f"size '{size}' is not known: choose {' or '.join(SIZES)}")
    if spec.size_free and size != "640":
        # More pixels need a finer scale of blur and a better picture; the rest of the site is the same.
        spec = replace(spec.scaled(*SIZES[size]), jpeg_quality=85)
    if minutes is not None and site in touched_stake.SITES:
        raise UsageError(f"site '{site}' is as long as its touches take; leave out --minutes")
    if minutes is not None:
        if not 0.3 <= minutes <= 600:
            raise UsageError(f"the length must lie between 0.3 and 600 minutes, found {minutes:g}")
        cycles = max(1, math.ceil((60 * minutes - 12) / (CYCLE_S * 1.015 + TRAM_S)))
        spec = specification.lengthened(spec, cycles)
    return spec


def make(
    folder: Path | None = None,
    site: str = "trench",
    minutes: float | None = None,
    size: str = "640",
    seed: int = SAMPLE_SEED,
    jobs: int = 2,
    progress: Progress = lambda done, of: None,
) -> Path:
    """Record a synthetic site and return its log; the same arguments give the same bytes.

    Parameters
    ----------
    folder
        Left out: ``sample_logs/trench`` for the committed sample, else ``sample_logs/generated/<name>``.
    site
        ``trench`` or ``other``; ``calibration-bucket``, ``calibration-cluster`` or ``calibration-mounts``, of the
        machine of the sample of this seed; one of `calibration_logs.LOGS`: a log that calibrates its lenses; or
        ``calibration``: all of them in one folder beside one machine.toml, which is returned.
    minutes
        At least this long, in whole cycles; left out, the site's own four cycles.
    size
        ``640`` (640x480, f = 850 px) or ``1280`` (1280x960, f = 1731 px).
    seed
        Of every draw: motion, mounts, errors of calibration and survey, noise.
    jobs
        Processes that render.
    progress
        Called with frames written and frames in all.

    Raises
    ------
    UsageError
    """
    if site in LOGS:
        default = DRAWN / (site if (size, seed) == ("640", SAMPLE_SEED) else f"{site}-{size}-{seed}")
        return LOGS[site](specification_of(size=size), seed, default if folder is None else folder, progress)
    if site == yard.NAME or site in calibration_sites.NAMES:
        if minutes is not None or size != "640":
            raise UsageError(f"'{site}' has a length and a size of its own: leave out --minutes and --size")
        default = DRAWN / f"{site}-{seed}"
        if site == yard.NAME:
            return yard.record_yard(seed, default if folder is None else folder, jobs, progress)
        return calibration_log.record_calibration(
            site, seed, default if folder is None else folder, jobs, progress
        )
    spec = specification_of(site, minutes, size)
    if (site, minutes, size, seed) != ("trench", None, "640", SAMPLE_SEED):
        length = "" if minutes is None else f"-{minutes:g}min"
        pixels = f"-{size}" if spec.size_free else ""
        spec = replace(spec, name=f"{site}{pixels}{length}-{seed}")
        default = DRAWN / spec.name
    else:
        default = FOLDER / spec.name
    return recording.record(spec, seed, default if folder is None else folder, jobs, progress)
