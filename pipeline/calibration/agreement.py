"""Whether touches are enough, agree, and give a curve that can be used; if not, one sentence that says what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.calibration import bucket, curve_fit
from pipeline.calibration.snooping import AXES, Suspect, suspects
from pipeline.calibration.touches import Adjusted, Rig, Stand, Touch
from pipeline.errors import CalibrationError

LEAST_TOUCHES = 5
LEAST_TURN_DEG = 40.0
HOVERED = "stand near the point without touching it"
HOVERED_M = 0.03
"""A stand that nobody gave a time for, and whose edge was further from the point than this, was no touch."""


def agreed(
    rig: Rig,
    stands: Sequence[Stand],
    touches: Sequence[Touch],
    points: Mapping[str, float],
    left_out: dict[str, int] | None = None,
) -> Adjusted:
    """The adjustment of touches that agree.

    Parameters
    ----------
    rig, stands, touches
        As for `bucket.adjust`.
    points : mapping
        Known points in the order of their numbers: name -> sigma of each coordinate, metres.
    left_out : dict, optional
        What else was in the file, by reason, for the message; stands that were no touches are counted here.

    Raises
    ------
    CalibrationError
        Too few touches, at angles that are too alike, or one with a typing error, named.
    """
    n = len(stands)
    wear = rig.curve is not None
    least = 2 if wear else max(LEAST_TOUCHES, rig.coefficients + 1)
    if n < least:
        left = ", ".join(f"{count} {reason}" for reason, count in (left_out or {}).items())
        raise CalibrationError(
            f"the bucket touched at {n} bucket angle{'' if n == 1 else 's'}, at least {least} are needed"
            f"{f' ({left})' if left else ''}; hold each touch still for two seconds with the stick's marker in view, "
            "and check the point's coordinates and the clock of the file"
        )
    try:
        robust = bucket.robust(rig, stands, touches, list(points.values()))
        worst = suspects(robust, len(points))
        if worst and worst[0].wrong and _hovered(robust, worst[0]):
            left_out = {} if left_out is None else left_out
            left_out[HOVERED] = left_out.get(HOVERED, 0) + 1
            stands, touches = bucket.left(stands, touches, worst[0].touch)
            return agreed(rig, stands, touches, points, left_out)
        if worst and worst[0].wrong:
            raise CalibrationError(_named(robust, points, worst[0]))
        adjusted = bucket.adjust(rig, stands, touches, list(points.values()))
    except (FloatingPointError, np.linalg.LinAlgError):
        raise CalibrationError(
            "no curve brings the cutting edge to the points that were touched: check their coordinates, the linkage's "
            "lengths and its branch in machine.toml"
        ) from None
    angle = curve_fit.direction(adjusted, np.array([s.raw for s in stands])).angle_rad
    turn = float(np.rad2deg(np.ptp(np.unwrap(np.sort(angle)))))
    if turn < LEAST_TURN_DEG and not wear:
        raise CalibrationError(
            f"the bucket angles of the touches span {turn:.0f} deg, at least {LEAST_TURN_DEG:.0f} are needed; touch "
            "the point again with the bucket further curled and further opened"
        )
    return adjusted


def kept_of(adjusted: Adjusted, name: str) -> curve_fit.Written:
    """What goes into the file. Raises CalibrationError where no usable curve comes out."""
    try:
        kept = curve_fit.written(adjusted)
        monotone = curve_fit.monotone(adjusted.rig, kept)
    except FloatingPointError:
        monotone = False
    if not monotone:
        raise CalibrationError(
            f"the curve of sensor '{name}' turns back within the stroke that was touched; give it fewer coefficients "
            "in machine.toml, or touch at more bucket angles"
        )
    return kept


def _hovered(found: Adjusted, worst: Suspect) -> bool:
    return worst.touch >= 0 and not found.touches[worst.touch].by_time and abs(worst.size_m) > HOVERED_M


def _named(adjusted: Adjusted, points: Mapping[str, float], worst: Suspect) -> str:
    """A sentence about the coordinate that is wrong."""
    axis = AXES[worst.axis]
    if worst.touch < 0:
        what = f"the {axis} of known point '{list(points)[worst.point]}'"
        size, sigma = worst.size_m, worst.sigma_m
    else:
        touch = adjusted.touches[worst.touch]
        what = f"the {axis} of touch '{touch.name}'"
        size, sigma = worst.size_m, worst.sigma_m
        if len(adjusted.stands) > adjusted.rig.coefficients + 1:
            # Of a large error, a straight line from the whole adjustment gets the size only roughly.
            others = bucket.without(adjusted, worst.touch, list(points.values()))
            away = touch.p_world - bucket.predicted(others, adjusted.stands[touch.stand], touch)
            size = float(away[worst.axis])
    return (
        f"{what} does not go with the others: {1000 * size:+.0f} mm off (sigma {1000 * sigma:.0f} mm, normalised "
        f"{abs(worst.w):.1f}, limit {worst.critical:.1f}); check how it was typed, or that the edge did not slip, and "
        "mend or delete its row"
    )
