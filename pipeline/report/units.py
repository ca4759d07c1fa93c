"""Units of the page: lengths in the site's own unit, deviations in millimetres or hundredths of a foot.

A surveyor reads elevations to the millimetre (or the thousandth of a foot) and deviations as they are
staked: millimetres, or feet to the hundredth. Inside the house everything is metres; this is the only
module that turns metres into what is printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

MINUS = "\N{MINUS SIGN}"
MISSING = "\N{EN DASH}"


@dataclass(frozen=True)
class Units:
    """What lengths and deviations are printed in."""

    length: str
    """Unit of stations, offsets, elevations and coordinates, as printed."""
    per_metre: float
    """Length units in one metre."""
    length_digits: int
    """Digits after the point of an elevation or a coordinate."""
    station_digits: int
    deviation: str
    """Unit of deviations and of their uncertainties, as printed."""
    deviation_per_metre: float
    deviation_digits: int
    fine_digits: int
    """Digits after the point of a standard deviation or an RMSE in the deviation unit."""

    def to_length(self, metres: Any) -> Any:
        """Metres -> length unit; arrays and numbers alike."""
        return np.asarray(metres, float) * self.per_metre

    def to_deviation(self, metres: Any) -> Any:
        """Metres -> deviation unit; arrays and numbers alike."""
        return np.asarray(metres, float) * self.deviation_per_metre

    @property
    def area(self) -> str:
        """Unit of areas, as printed."""
        return "m²" if self.length == "m" else f"sq {self.length}"

    @property
    def volume(self) -> str:
        """Unit of volumes, as printed: soil is paid by the cubic metre or the cubic yard."""
        return "m³" if self.length == "m" else "cu yd"

    @property
    def volume_digits(self) -> int:
        """Digits after the point of a volume."""
        return 2

    def to_area(self, square_metres: Any) -> Any:
        """Square metres -> area unit."""
        return np.asarray(square_metres, float) * self.per_metre**2

    def to_volume(self, cubic_metres: Any) -> Any:
        """Cubic metres -> volume unit."""
        return np.asarray(cubic_metres, float) * (1.0 if self.length == "m" else self.per_metre**3 / 27.0)

    def describe(self) -> str:
        """The units in words, for the page's method."""
        return f"{UNIT_NAMES[self.length]} ({self.length}), deviations in {UNIT_NAMES[self.deviation]}"


UNIT_NAMES = {"m": "metres", "mm": "millimetres", "ft": "international feet", "US ft": "US survey feet"}


def units_of(grid_unit: str, metres_per_unit: float) -> Units:
    """The units of a page for a site whose grid is in `grid_unit` (as site.toml spells it)."""
    if grid_unit == "m":
        return Units("m", 1.0, 3, 2, "mm", 1000.0, 0, 1)
    name = {"us_survey_foot": "US ft"}.get(grid_unit, "ft")
    per_metre = 1.0 / metres_per_unit
    return Units(name, per_metre, 3, 2, name, per_metre, 3, 3)


def text_of(value: float | int | None, digits: int, signed: bool = False, grouped: bool = True) -> str:
    """A number as printed: fixed digits, a real minus sign, no negative zero, a dash for what is not there.

    Thousands are set apart by a thin space from five digits before the point on, so that 2000.125 stays a
    station that can be typed and 4123456.789 stays readable.
    """
    if value is None or not np.isfinite(value):
        return MISSING
    rounded = round(float(value), digits) + 0.0
    shown = f"{abs(rounded):.{digits}f}"
    if grouped:
        whole, point, rest = shown.partition(".")
        if len(whole) > 4:
            whole = f"{int(whole):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
        shown = whole + point + rest
    if rounded < 0:
        return MINUS + shown
    return "+" + shown if signed and rounded > 0 else shown
