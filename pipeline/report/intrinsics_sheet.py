"""The sheet on a lens: is it known well enough, in millimetres at the cutting edge."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.calibration.procedure import Intrinsics
from pipeline.geometry.lenses import BROWN5
from pipeline.report.intrinsics_figures import draw_coverage, draw_halves, draw_placing
from pipeline.report.numbers import column, number, table
from pipeline.report.sheet import GOOD, OPEN, POOR, Part, Picture, Sheet
from pipeline.report.units import text_of
from pipeline.report.words import Words

GOOD_M = 0.010
"""Standard deviation of a tag's place at the working distance up to which a lens is known well enough: two fifths
of the paper's inch, of which mounts, survey and corners want their part."""
FEW_VIEWS = 15


def intrinsics_sheet(
    found: Intrinsics, camera: str, board: str, searched: int, origin: Mapping[str, str], language: str = "en"
) -> Sheet:
    """The sheet on one calibrated lens.

    Parameters
    ----------
    found : Intrinsics
        What was told.
    camera : str
        How people call it.
    board : str
        The board's short text.
    searched : int
        Pictures that were looked at.
    origin : mapping
        Keys of ``intrinsics.origin`` in the words -> text.
    language : str
        Of the words.
    """
    words = Words(language)

    def w(key: str, **places: object) -> str:
        return words(f"intrinsics.{key}", **places)

    solution, placing, halves = found.solution, found.placing, found.halves
    across, along = (float(np.sqrt(np.nanmean(part**2))) for part in (placing.across_m, placing.along_m))
    state = POOR if placing.total_m > GOOD_M or (halves and not halves.fits) else GOOD if halves else OPEN
    distance = f"{found.distance_m:g}"
    used = int(np.count_nonzero(solution.views_used))
    facts = {
        "distance": distance,
        "total": f"{1000 * placing.total_m:.1f}",
        "limit": f"{1000 * GOOD_M:g}",
    }
    names = found.lens.parameters
    rows = [
        {
            "name": name,
            "value": text_of(float(value), 2 if place < 4 else 6, grouped=False),
            "sigma": text_of(float(sigma), 3 if place < 4 else 6),
            "unit": "px" if place < 4 else "",
        }
        for place, (name, value, sigma) in enumerate(zip(names, solution.intrinsics, solution.sigma))
    ]
    columns = [
        column("name", w("parameter"), kind="code"),
        *(column(key, w(key)) for key in ("value", "sigma", "unit")),
    ]
    parts = [
        Part(
            w("lens"),
            [
                w(f"model_{found.lens.name}"),
                w("bend", x=text_of(1000 * solution.bend_m[0], 2), y=text_of(1000 * solution.bend_m[1], 2)),
                *([w("shared", factor=f"{solution.shared_factor**0.5:.1f}")] if solution.shared_factor > 1 else []),
            ],
            tables=[(w("parameters", width=found.size[0], height=found.size[1]), table(columns, rows))],
            pictures=[
                Picture(
                    "placing", w("placing", distance=distance), w("placing_good", **facts),
                    w("placing_seen"), lambda: draw_placing(found),
                )
            ],
        ),
        Part(
            w("views"),
            [
                w("views_used", searched=searched, found=found.found, used=used, board=board),
                w("outliers", outliers=solution.outliers, bad=len(found.views) - used),
                w("held", near=f"{found.coverage.distance_m[0]:.2f}", far=f"{found.coverage.distance_m[1]:.2f}",
                  tilt=f"{found.coverage.tilt_deg:.0f}"),
            ],
            pictures=[
                Picture("coverage", w("coverage"), w("coverage_good"), w("coverage_seen"), lambda: draw_coverage(found))
            ],
        ),
    ]  # fmt: skip
    if halves is not None:
        said = {
            "found": f"{1000 * halves.found_rms_m:.1f}",
            "worst": f"{1000 * float(np.nanmax(halves.found_m)):.1f}",
            "predicted": f"{1000 * halves.predicted_rms_m:.1f}",
            "ratio": f"{halves.ratio:.2f}",
            "limit": f"{halves.limit:.2f}",
            "distance": distance,
        }
        picture = Picture(
            "halves", w("halves_map"), w("halves_good"), w("halves_seen"), lambda: draw_halves(found)
        )
        parts.insert(
            1,
            Part(
                w("halves"),
                [w("halves_found", **said), w("halves_fit" if halves.fits else "halves_misfit", **said)],
                pictures=[picture],
            ),
        )
    return Sheet(
        title=w("title"),
        subject=camera,
        state=state,
        sentence=w(f"sentence_{'misfit' if halves and not halves.fits else state}", **facts),
        numbers=[
            (w("total"), number(1000 * placing.total_m, "mm", 1), w("total_note", distance=distance)),
            (w("across"), number(1000 * across, "mm", 2), w("across_note")),
            (w("along"), number(1000 * along, "mm", 2), w("along_note")),
            (
                w("halves_rms"),
                number(1000 * halves.found_rms_m if halves else None, "mm", 1),
                w("halves_note", predicted=f"{1000 * halves.predicted_rms_m:.1f}")
                if halves
                else w("halves_none"),
            ),
            (
                w("focal"),
                number(float(solution.intrinsics[0]), "px", 2),
                w("focal_note", sigma=f"{solution.sigma[0]:.2f}"),
            ),
            (w("residual"), number(solution.rms_px, "px", 3), w("residual_note", used=used)),
        ],
        remarks=_remarks(found, words, used),
        parts=parts,
        origin={w(f"origin.{key}"): text for key, text in origin.items()},
    )


def _remarks(found: Intrinsics, words: Words, used: int) -> list[str]:
    """What needs attention, a sentence each."""

    def w(key: str, **places: object) -> str:
        return words(f"intrinsics.{key}", **places)

    said = []
    if found.halves is not None and not found.halves.fits:
        said.append(w(f"misfit_{found.lens.name}", ratio=f"{found.halves.ratio:.1f}"))
    if found.coverage.missing:
        places = ", ".join(w(place.replace(" ", "_")) for place in found.coverage.missing)
        said.append(w("missing", places=places))
    if found.coverage.one_distance:
        said.append(w("one_distance", distance=f"{np.mean(found.coverage.distance_m):.2f}"))
    if found.coverage.little_tilt:
        said.append(w("little_tilt", tilt=f"{found.coverage.tilt_deg:.0f}"))
    if used < FEW_VIEWS:
        said.append(w("few", views=used))
    if found.halves is None:
        said.append(w("no_halves", views=used))
    if found.solution.shared_factor > 1:
        said.append(w("shared_remark", factor=f"{found.solution.shared_factor**0.5:.1f}"))
    if found.lens is not BROWN5:
        said.append(w("not_written"))
    return said
