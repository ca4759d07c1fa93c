"""PASS, FAIL or CANNOT TELL, per station and for the job.

The rule is the guard band of ISO 14253-1 and JCGM 106:2012 (8.3.2 guarded acceptance, 8.3.3 guarded rejection): with
U = k sigma, a station passes when the whole interval deviation ± U lies inside the tolerance, fails when the whole
interval lies outside on one side, and cannot be told otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.surface.as_built import AsBuilt
from pipeline.surface.design import Design
from pipeline.surface.one_sweep import sigma_of_sum
from pipeline.surface.sides import SIDES, Sides

PASS, FAIL, CANNOT_TELL, NOT_REACHED = "PASS", "FAIL", "CANNOT TELL", "NOT REACHED"
CUT, PARTLY, UNREACHED = "cut", "partly cut", "not reached"


@dataclass(frozen=True)
class ToleranceBand:
    """Deviation = as-built minus design must lie in ``[-low, +high]``."""

    high_m: float
    """Under-dug, as a positive number, metres."""
    low_m: float
    """Over-dug, as a positive number, metres."""
    coverage_factor: float = 2.0
    """k in U = k sigma."""

    @property
    def half_width_m(self) -> float:
        return 0.5 * (self.high_m + self.low_m)

    def sentence(self) -> str:
        """The rule in words, for the report."""
        return (
            f"Deviation is as-built minus design, + high (under-dug), - low (over-dug); tolerance "
            f"-{self.low_m * 1000:.4g} mm to +{self.high_m * 1000:.4g} mm. PASS where deviation ± U lies inside it, "
            f"FAIL where deviation ± U lies outside, CANNOT TELL otherwise; U = {self.coverage_factor:g} × standard "
            "deviation, own and common parts together (guard band of ISO 14253-1, JCGM 106)."
        )


@dataclass(frozen=True)
class StationRule:
    """When a station counts as reached, and how its cells hang together."""

    reached_share: float = 0.25
    """Of the floor's cells: below this the station is not reached."""
    whole_share: float = 0.75
    """Below this it is partly cut."""
    least_cells: int = 4


@dataclass(frozen=True)
class Stations:
    """One entry per station; arrays (n,)."""

    station: np.ndarray
    state: np.ndarray
    """cut, partly cut, not reached."""
    h: np.ndarray
    """Mean as-built floor elevation over the cut floor cells, metres; nan where not reached."""
    design_h: np.ndarray
    """Mean design elevation: over the same cells, or over the floor where not reached."""
    deviation: np.ndarray
    sigma_own: np.ndarray
    """Own part of the standard deviation of the mean."""
    sigma_common: np.ndarray
    """Common part; the mean does not reduce it."""
    expanded_uncertainty: np.ndarray
    """U = k sigma."""
    scatter: np.ndarray
    """Standard deviation of the cells' deviations about their mean, metres: how far one spot speaks for the station."""
    width: np.ndarray
    """Width of the floor that was cut, metres."""
    cells_cut: np.ndarray
    cells_floor: np.ndarray
    verdict: np.ndarray
    reason: np.ndarray


@dataclass(frozen=True)
class JobVerdict:
    """The verdict over all stations."""

    verdict: str
    sentence: str
    counts: dict[str, int]
    """Stations by verdict."""


LEVEL_WORDS = ("high", "under-dug", "low", "over-dug")
SIDE_WORDS = ("wide", "outside its design", "narrow", "inside its design")


def decide(
    deviation: float, uncertainty: float, band: ToleranceBand, words: tuple[str, str, str, str] = LEVEL_WORDS
) -> tuple[str, str]:
    """Verdict and reason for one deviation with its expanded uncertainty, metres; `words` say what + and - mean.

    A deviation that lies outside by more than U is a FAIL however large U is: a poor measurement can still see a
    gross error. A U wider than half the tolerance can never PASS.
    """
    assert uncertainty >= 0, uncertainty
    low, high = deviation - uncertainty, deviation + uncertainty
    if low > band.high_m:
        beyond = (low - band.high_m) * 1000
        return FAIL, f"{words[0]} by at least {beyond:.1f} mm beyond the tolerance ({words[1]})"
    if high < -band.low_m:
        beyond = (-band.low_m - high) * 1000
        return FAIL, f"{words[2]} by at least {beyond:.1f} mm beyond the tolerance ({words[3]})"
    if low >= -band.low_m and high <= band.high_m:
        return PASS, "deviation ± U lies inside the tolerance"
    if uncertainty > band.half_width_m:
        return CANNOT_TELL, (
            f"measurement not capable: U {uncertainty * 1000:.1f} mm is larger than half the tolerance, "
            f"{band.half_width_m * 1000:.1f} mm"
        )
    if high > band.high_m:
        return CANNOT_TELL, "the upper limit of the tolerance lies within deviation ± U"
    return CANNOT_TELL, "the lower limit of the tolerance lies within deviation ± U"


def stations_along(design: Design, start: float, end: float, step: float) -> np.ndarray:
    """Whole multiples of the step, the round numbers of a stakeout list, that the design reaches; metres.

    Each stands for the piece from half a step before it to half a step behind: there the mean over the piece
    equals the level of a floor with a gradient.
    """
    first, last = design.station_range()
    first, last = max(first, start), min(last, end)
    number = np.arange(np.floor(first / step + 0.5 + 1e-6), np.ceil(last / step - 0.5 - 1e-6) + 1)
    return number * step


def judge(
    built: AsBuilt,
    design: Design,
    station: np.ndarray,
    step_m: float,
    band: ToleranceBand,
    rule: StationRule | None = None,
) -> Stations:
    """Mean floor deviation of each station, its sigma and its verdict.

    A station stands for the cells within half a step of it. The common part of sigma is the mean over the cells (one
    error shared by all of them does not average out); the own part takes each sweep's cells as sharing one error.

    Parameters
    ----------
    built : AsBuilt
        The surface.
    design : Design
        For stations that the surface does not cover.
    station : (n,) array
        Metres, ascending.
    step_m : float
        Length of alignment that a station stands for.
    band : ToleranceBand
        The tolerance.
    rule : StationRule, optional
        What counts as reached.

    Returns
    -------
    Stations
    """
    rule = rule or StationRule()
    n = len(station)
    grid = built.grid
    result = {
        name: np.full(n, np.nan)
        for name in (
            "h",
            "design_h",
            "deviation",
            "sigma_own",
            "sigma_common",
            "expanded_uncertainty",
            "scatter",
            "width",
        )
    }
    cells_cut, cells_floor = np.zeros(n, np.int32), np.zeros(n, np.int32)
    state, verdict = np.full(n, UNREACHED, object), np.full(n, NOT_REACHED, object)
    reason = np.full(n, "", object)
    border = np.searchsorted(
        grid.station, np.concatenate([station - 0.5 * step_m, station[-1:] + 0.5 * step_m])
    )
    expected = _floor_cells(design, station, step_m, grid.cell_m)
    for i in range(n):
        rows = slice(border[i], border[i + 1])
        floor = built.floor[rows] & np.isfinite(built.design_h[rows])
        cut = floor & built.cut[rows]
        cells_floor[i] = max(int(np.count_nonzero(floor)), expected[i])
        cells_cut[i] = int(np.count_nonzero(cut))
        result["design_h"][i] = design.floor_level(station[i : i + 1])[0]
        share = cells_cut[i] / max(int(cells_floor[i]), 1)
        if cells_cut[i] < rule.least_cells or share < rule.reached_share:
            touched = int(np.count_nonzero(floor & (built.state[rows] > 0)))
            reason[i] = (
                f"{cells_cut[i]} of {cells_floor[i]} floor cells cut, at least {rule.reached_share:.0%} are needed"
                + (f"; {touched - cells_cut[i]} more were passed over" if touched > cells_cut[i] else "")
            )
            continue
        own = sigma_of_sum(
            built.sigma_own[rows][cut], built.sigma_pass[rows][cut], built.lowest_time_ns[rows][cut]
        ) / np.count_nonzero(cut)
        common = float(np.mean(built.sigma_common[rows][cut]))
        uncertainty = band.coverage_factor * float(np.hypot(own, common))
        deviation = float(np.mean(built.deviation[rows][cut]))
        state[i] = CUT if share >= rule.whole_share else PARTLY
        verdict[i], reason[i] = decide(deviation, uncertainty, band)
        if state[i] == PARTLY:
            if verdict[i] == PASS:  # what was not cut may stand high: the cut part cannot speak for it
                verdict[i], reason[i] = CANNOT_TELL, "the part that was cut is within tolerance"
            reason[i] += f"; {share:.0%} of the floor was cut"
        result["h"][i] = float(np.mean(built.h[rows][cut]))
        result["design_h"][i] = float(np.mean(built.design_h[rows][cut]))
        result["deviation"][i], result["expanded_uncertainty"][i] = deviation, uncertainty
        result["sigma_own"][i], result["sigma_common"][i] = own, common
        result["scatter"][i] = float(np.std(built.deviation[rows][cut]))
        result["width"][i] = float(np.count_nonzero(cut, axis=1).mean()) * grid.cell_m
    return Stations(
        station=station,
        state=state,
        cells_cut=cells_cut,
        cells_floor=cells_floor,
        verdict=verdict,
        reason=reason,
        **result,
    )


@dataclass(frozen=True)
class SideVerdicts:
    """Verdicts of the sides; arrays (n, 2): left, right."""

    expanded_uncertainty: np.ndarray
    """U = k sigma, metres; nan where the side is not told."""
    verdict: np.ndarray
    """PASS, FAIL, CANNOT TELL; NOT REACHED where the side is not told."""
    reason: np.ndarray


def judge_sides(sides: Sides, band: ToleranceBand) -> SideVerdicts:
    """Each side of each station against a band whose high is wide and whose low is narrow."""
    u = band.coverage_factor * np.hypot(sides.sigma_own, sides.sigma_common)
    verdict, reason = np.full(u.shape, NOT_REACHED, object), np.full(u.shape, "", object)
    for i, j in np.argwhere(np.isfinite(sides.outward)):
        verdict[i, j], reason[i, j] = decide(float(sides.outward[i, j]), float(u[i, j]), band, SIDE_WORDS)
    return SideVerdicts(u, verdict, reason)


def side_sentence(band: ToleranceBand) -> str:
    """The rule of the sides in words, for the report."""
    return (
        f"Each side of the floor is judged in the same way: it may lie up to {band.high_m * 1000:.4g} mm outside and "
        f"{band.low_m * 1000:.4g} mm inside its designed place. A station fails by its level or by a side, and passes "
        "only if its level and both sides pass."
    )


def with_sides(stations: Stations, sides: SideVerdicts) -> Stations:
    """The stations with their sides held against them: FAIL if the level or a side fails, PASS if all pass.

    A side that is not told leaves a station that would pass in doubt: its floor may be half as wide as it should be.
    """
    verdict, reason = stations.verdict.copy(), stations.reason.copy()
    for i in np.flatnonzero(stations.verdict != NOT_REACHED):
        of_sides = sides.verdict[i]
        for word in (FAIL, CANNOT_TELL, NOT_REACHED):
            told = [
                f"{SIDES[j]} side {sides.reason[i, j] or 'not told by any pass'}"
                for j in (0, 1)
                if of_sides[j] == word
            ]
            if (
                not told
                or (verdict[i] == FAIL and word != FAIL)
                or (verdict[i] == CANNOT_TELL and word == NOT_REACHED)
            ):
                continue
            said = "; ".join(told)
            found = FAIL if word == FAIL else CANNOT_TELL
            reason[i] = said if verdict[i] == PASS else f"{reason[i]}; {said}"
            verdict[i] = found
    return replace(stations, verdict=verdict, reason=reason)


def job_verdict(stations: Stations) -> JobVerdict:
    """FAIL if any station fails, PASS if the trench passes from the first wholly cut station to the last.

    Where the work began and ended a station is cut only in part; nobody holds that against the trench between. A
    station in between that was not reached, or only in part, may hide anything: then the job cannot be told.
    """
    counts = {v: int(np.count_nonzero(stations.verdict == v)) for v in (PASS, FAIL, CANNOT_TELL, NOT_REACHED)}
    reached = len(stations.verdict) - counts[NOT_REACHED]
    if reached == 0:
        return JobVerdict(CANNOT_TELL, "No station was reached: there is nothing to judge.", counts)
    whole = np.flatnonzero(stations.state == CUT)
    between = stations.verdict[whole[0] : whole[-1] + 1] if len(whole) else np.array([], object)
    ends = reached - int(np.count_nonzero(between != NOT_REACHED))
    if counts[FAIL]:
        verdict = FAIL
        sentence = f"{counts[FAIL]} of {reached} reached stations are out of tolerance"
    elif len(between) and np.all(between == PASS):
        verdict, sentence = PASS, f"All {len(between)} stations that were wholly cut are within tolerance"
        sentence += f"; {ends} at the ends were cut in part only" if ends else ""
    else:
        verdict = CANNOT_TELL
        sentence = f"{counts[CANNOT_TELL]} of {reached} reached stations cannot be told, none fails"
        skipped = int(np.count_nonzero(between == NOT_REACHED))
        sentence += f"; {skipped} between them were not cut" if skipped else ""
    if counts[NOT_REACHED]:
        sentence += f"; {counts[NOT_REACHED]} of {len(stations.verdict)} stations were not reached"
    return JobVerdict(verdict, sentence + ".", counts)


def _floor_cells(design: Design, station: np.ndarray, step_m: float, cell_m: float) -> np.ndarray:
    """Cells of the designed floor at each station, also where no surface was built."""
    reach = min(design.floor_reach(), 50.0)
    across = np.arange(-reach + 0.5 * cell_m, reach, cell_m)
    first, last = design.station_range()
    length = np.minimum(station + 0.5 * step_m, last) - np.maximum(station - 0.5 * step_m, first)
    on_floor = design.is_floor(station[:, None], across[None, :])
    return np.floor(np.count_nonzero(on_floor, axis=1) * np.maximum(length, 0.0) / cell_m + 1e-6).astype(int)
