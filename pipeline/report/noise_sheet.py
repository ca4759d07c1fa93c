"""The sheet on corner noise, after the paper's Fig. 11: scatter while nothing moves, beside what was predicted."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from pipeline.calibration.noise import CornerNoise, one_frame_mm
from pipeline.report import palette
from pipeline.report.drawing import new_figure
from pipeline.report.numbers import column, number, table
from pipeline.report.sheet import GOOD, OPEN, POOR, Part, Picture, Sheet
from pipeline.report.units import text_of
from pipeline.report.words import Words

PAPER_PX = 0.2
"""What the paper's Fig. 11 takes for its camera."""
MARKERS = ("o", "s", "^", "D", "v", "P")


def noise_sheet(
    found: Mapping[str, CornerNoise],
    focal_px: Mapping[str, float],
    distance_m: float,
    subject: str,
    origin: Mapping[str, str],
    language: str = "en",
) -> Sheet:
    """The sheet on the corner noise of a log.

    Parameters
    ----------
    found : mapping
        Camera -> what stood still before it.
    focal_px : mapping
        Camera -> focal length.
    distance_m : float
        Working distance.
    subject : str
        The log.
    origin : mapping
        Keys of ``intrinsics.origin`` in the words -> text.
    language : str
        Of the words.
    """
    words = Words(language)

    def w(key: str, **places: object) -> str:
        return words(f"noise.{key}", **places)

    still = {camera: noise for camera, noise in found.items() if noise.whole is not None}
    along = {}
    for camera, noise in still.items():
        assert noise.whole is not None
        if camera in focal_px:
            along[camera] = one_frame_mm(
                noise.whole.scatter_px, noise.whole.side_px, focal_px[camera], distance_m
            )
    worst = max(along, key=lambda camera: along[camera][1], default="")
    above = [camera for camera, noise in still.items() if noise.surely_above]
    state = OPEN if not worst else POOR if above else GOOD
    facts: dict[str, object] = {"distance": f"{distance_m:g}"}
    numbers = []
    if worst:
        whole = still[worst].whole
        assert whole is not None
        across_mm, along_mm = along[worst]
        facts |= {
            "across": f"{across_mm:.1f}", "along": f"{along_mm:.1f}", "camera": worst,
            "noise": f"{whole.scatter_px:.3f}", "side": f"{whole.side_px:.0f}", "ratio": f"{whole.ratio:.2f}",
        }  # fmt: skip
        numbers = [
            (w("number_noise"), number(whole.scatter_px, "px", 3), w("note_noise", **facts)),
            (w("number_predicted"), number(whole.predicted_px, "px", 3), w("note_predicted")),
            (
                w("number_ratio"),
                number(whole.ratio, "", 2),
                f"{whole.ratio_low:.2f} – {whole.ratio_high:.2f}",
            ),
            (w("number_along"), number(along_mm, "mm", 1), w("note_along", **facts)),
            (w("number_across"), number(across_mm, "mm", 2), w("note_across")),
            (
                w("number_frames"),
                number(sum(n.whole.frames for n in still.values() if n.whole), "", 0),
                w("note_frames"),
            ),
        ]
    rows = [
        {
            "camera": camera, "light": str(light), "size": str(size), "frames": s.frames, "tags": s.tags,
            "noise": s.scatter_px, "predicted": s.predicted_px, "ratio": s.ratio,
            "between": f"{text_of(s.ratio_low, 2)} – {text_of(s.ratio_high, 2)}", "lag1": s.lag1, "shake": s.shake_px,
        }
        for camera, noise in still.items()
        for (light, size), s in sorted(noise.by_class.items(), key=lambda row: (row[0][0].low, row[0][1].low_px))
    ]  # fmt: skip
    columns = [
        column("camera", w("camera"), kind="id"),
        column("light", w("light")),
        column("size", w("size")),
        column("frames", w("frames"), digits=0),
        column("tags", w("tags"), digits=0),
        column("noise", w("noise"), "px", 3),
        column("predicted", w("predicted"), "px", 3),
        column("ratio", w("ratio"), digits=2),
        column("between", w("between")),
        column("lag1", w("lag1"), digits=2, signed=True),
        column("shake", w("shake"), "px", 3),
    ]
    part = Part(
        w("scatter"),
        [w("how"), w("light_is")],
        tables=[(w("caption"), table(columns, rows))] if rows else [],
        pictures=[
            Picture(
                "noise", w("figure"), w("figure_good"), w("figure_seen"), lambda: draw_noise(still, words)
            )
        ]
        if rows
        else [],
    )
    remarks = [w("above", camera=camera) for camera in above]
    remarks += [w("nothing", camera=camera) for camera in found if camera not in still]
    return Sheet(
        title=w("title"),
        subject=subject,
        state=state,
        sentence=w(f"sentence_{state}", **facts),
        numbers=numbers,
        remarks=remarks,
        parts=[part],
        origin={words(f"intrinsics.origin.{key}"): text for key, text in origin.items()},
    )


def draw_noise(still: Mapping[str, CornerNoise], words: Words) -> Figure:
    """Noise of each tag against its size, and its ratio to the prediction against light."""
    figure = new_figure(3.2)
    size, light = figure.subplots(1, 2)
    for number_, (camera, noise) in enumerate(still.items()):
        look = {
            "color": palette.ACCENTS[number_ % len(palette.ACCENTS)],
            "marker": MARKERS[number_ % len(MARKERS)],
            "linestyle": "none",
            "markersize": 4,
        }
        tags = list(noise.by_tag.items())
        side = np.array([s.side_px for _, s in tags])
        size.plot(side, [s.scatter_px for _, s in tags], label=camera, **look)
        size.plot(side, [s.predicted_px for _, s in tags], **{**look, "marker": "_", "markersize": 7})
        middle = np.array(
            [of.low + 20 if math.isinf(of.high) else 0.5 * (of.low + of.high) for (_, of, _), _ in tags]
        )
        # Side by side, or cameras would hide one another.
        middle += 4 * (number_ - 0.5 * (len(still) - 1))
        light.plot(middle, [s.ratio for _, s in tags], **look)
    size.axhline(PAPER_PX, color=palette.MUTED, linestyle="--", linewidth=0.8, label=words("noise.paper"))
    size.set_ylim(bottom=0)
    size.set_xlabel(words("noise.axis_side"))
    size.set_ylabel(words("noise.axis_noise"))
    size.legend(loc="upper right")
    light.axhline(1.0, color=palette.MUTED, linewidth=0.8)
    light.set_ylim(bottom=0)
    light.set_xlabel(words("noise.axis_light"))
    light.set_ylabel(words("noise.axis_ratio"))
    return figure
