"""The sheet of a calibrated belt: its phase, the edge, and how well the touches agree."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.calibration.belt import ToldBelt
from pipeline.report.numbers import column, number, table
from pipeline.report.sheet import GOOD, POOR, Part, Sheet
from pipeline.report.units import text_of
from pipeline.report.words import Words

K = 2.0


def belt_sheet(
    told: ToldBelt, allowed_m: float, subject: str, origin: Mapping[str, str], language: str = "en"
) -> Sheet:
    """The page of a belt.

    Parameters
    ----------
    told : ToldBelt
        As told.
    allowed_m : float
        What the bucket may use of the job's tolerance.
    subject, origin
        As `Sheet` has them.
    language : str
        Of the words.
    """
    words = Words(language)

    def say(key: str, **places: object) -> str:
        return words(f"belt.{key}", **places)

    u_m = K * told.edge_sigma_m
    state = GOOD if u_m <= allowed_m else POOR
    phase_deg = float(np.rad2deg(told.moved_rad))
    radius_m = float(np.hypot(*told.T_bucket_tool[:2, 3]))
    rows = [
        {"touch": fit.name, "off": 1000 * fit.off_m, "sigma": 1000 * fit.sigma_m, "sigmas": fit.normalised}
        for fit in told.fits.each
    ]
    columns = [
        column("touch", say("touch"), kind="id"),
        column("off", say("off"), "mm", 1),
        column("sigma", say("off_sigma"), "mm", 1),
        column("sigmas", say("sigmas"), digits=1),
    ]
    return Sheet(
        title=say("title"),
        subject=f"{subject}, {told.joint}",
        state=state,
        sentence=say(
            state, u=text_of(1000 * u_m, 1), radius=text_of(radius_m, 2), limit=text_of(1000 * allowed_m, 1)
        ),
        numbers=[
            (say("phase"), number(phase_deg, "°", 2), say("phase_note")),
            (say("angle"), number(float(np.rad2deg(told.phase_sigma_rad)), "°", 3), say("angle_note")),
            (say("radius"), number(1000 * radius_m, "mm", 1), ""),
            (say("touches"), number(len(told.fits.each)), ""),
            (words("cluster.sigma0"), number(told.whole.sigma0, "", 2), words("cluster.sigma0_note")),
        ],
        remarks=list(told.whole.warnings),
        parts=[Part(say("touches"), [say("text")], [(say("caption"), table(columns, rows))])],
        origin=origin,
    )
