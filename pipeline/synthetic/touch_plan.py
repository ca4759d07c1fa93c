"""A bucket's calibration as it is planned: one point that the edge touches at several bucket angles."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TouchPlan:
    """A stake in a shallow pit in front of the machine, and how the bucket is set on it: low, so that the camera
    sees the board on the stick in every touch.
    """

    directions_deg: tuple[float, ...]
    """From the bucket's pin to its edge, above the horizontal, touch by touch."""
    reach: float = 5.8
    """Of the stake from the swing axis, metres."""
    height: float = -0.25
    """Of its top above the ground."""
    name: str = "TP1"
    hold_s: float = 2.2
    move_s: float = 2.4
    lift_m: float = 0.35
    point_mm: float = 1.5
    """Survey of the stake, standard deviation of each coordinate: the same error in every touch."""
    contact_mm: float = 1.0
    """How well the middle of the edge sits on it."""
