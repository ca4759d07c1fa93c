"""Logs made for calibrating the machine of a synthetic site, with the truth beside them.

Same specification and seed, same machine: what is told from these logs belongs into that site's machine.toml.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import simplejpeg

from pipeline.logs.writer import LogWriter
from pipeline.synthetic import recording
from pipeline.synthetic.specification import Specification
from pipeline.synthetic.waved_board import PrintedBoard, WavedBoard

Progress = Callable[[int, int], None]
VIEWS = 40
WEEK_NS = 7 * 86_400 * 1_000_000_000
STEP_NS = 500_000_000
JPEG_QUALITY = 92
BOARD = PrintedBoard(columns=11, rows=8, square_m=0.06, tag_share=0.75)


def intrinsics_log(
    spec: Specification, seed: int, folder: Path, progress: Progress, views: int = VIEWS
) -> Path:
    """A board waved before each camera of a site, a week before its shift.

    Parameters
    ----------
    spec, seed
        Of the site whose cameras these are.
    folder
        Made if it does not exist: the log, ``board.txt`` with the board's text, and ``truth/intrinsics.json``.
    progress
        Called with frames written and frames in all.
    views
        Of each camera.

    Returns
    -------
    Path
        The log.
    """
    truth = recording.world(spec, seed).truth.intrinsics
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    (folder / "board.txt").write_text(BOARD.text + "\n", encoding="utf-8")
    known = {name: np.asarray(k).tolist() for name, k in truth.items()}
    (folder / "truth" / "intrinsics.json").write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    path = folder / "calibration-intrinsics.mcap"
    start, done = spec.start_utc_ns - WEEK_NS, 0
    with LogWriter(path) as log:
        for number, camera in enumerate(spec.cameras):
            size = (spec.width, spec.height)
            board = WavedBoard(BOARD, np.asarray(truth[camera.name]), size, 1000 * seed + number)
            for index, T in enumerate(board.poses(views)):
                picture = board.picture(index, T)
                jpeg = simplejpeg.encode_jpeg(picture[..., None], quality=JPEG_QUALITY, colorspace="GRAY")
                log.image(camera.topic, start + (number * views + index) * STEP_NS, camera.name, jpeg)
                done += 1
                progress(done, views * len(spec.cameras))
    return path


LOGS: dict[str, Callable[[Specification, int, Path, Progress], Path]] = {
    "calibration-intrinsics": intrinsics_log,
}
"""What `gradetrace sample-logs --site` knows beside sites."""
