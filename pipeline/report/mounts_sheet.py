"""The sheet of mounts and axes: what was told, how well, and by how much it moved against the file."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from pipeline.calibration.axes import TOLD
from pipeline.calibration.mounts import Mounts, ToldPose
from pipeline.geometry import se3, so3
from pipeline.report import palette
from pipeline.report.drawing import new_figure
from pipeline.report.numbers import column, number, table
from pipeline.report.sheet import Demand, Part, Picture, Sheet
from pipeline.report.words import Words


def mounts_sheet(
    mounts: Mounts,
    demand: Demand,
    subject: str,
    origin: Mapping[str, str],
    language: str = "en",
) -> Sheet:
    """The page of mounts and axes.

    Parameters
    ----------
    mounts : Mounts
        As told.
    demand : Demand
        Of the job.
    subject, origin
        As `Sheet` has them.
    language : str
        Of the words.
    """
    words = Words(language)
    sigmas = {t.key: edge_sigma_m(t, demand.distance_m) for t in mounts.told}
    # A mount that the file did not have serves the calibration only.
    counted = [t.key for t in mounts.told if t.T_file is not None] or list(sigmas)
    worst = max(counted, key=lambda key: sigmas[key])
    state, sentence = demand.judge(sigmas[worst], words, "mounts", what=worst)
    axes = [t for t in mounts.told if t.axis is not None]
    parts = [
        Part(
            words("mounts.told"),
            [words("mounts.told_text")],
            [(words("mounts.told_caption"), _told(mounts, sigmas, words))],
        )
    ]
    if axes:
        parts.append(
            Part(
                words("mounts.axes"),
                [words("mounts.axes_text")],
                [(words("mounts.axes_caption"), _axes(axes, words))],
                [_circle(t, words) for t in axes],
            )
        )
    if mounts.pins:
        parts.append(
            Part(
                words("mounts.pins"),
                [words("mounts.pins_text")],
                [(words("mounts.pins_caption"), _pins(mounts, words))],
            )
        )
    return Sheet(
        title=words("mounts.title"),
        subject=subject,
        state=state,
        sentence=sentence,
        numbers=[
            (words("mounts.edge"), number(1000 * sigmas[worst], "mm", 1), worst),
            (words("cluster.sigma0"), number(mounts.whole.sigma0, "", 2), words("cluster.sigma0_note")),
        ],
        remarks=list(mounts.warnings),
        parts=parts,
        origin=origin,
    )


def edge_sigma_m(told: ToldPose, distance_m: float) -> float:
    """Standard deviation, in its worst direction, of a point away from what was told.

    Of a joint's axis only what motion tells counts: the rest is convention. The point lies along the child's x; an
    axis sees it across its own line.
    """
    covariance = told.covariance
    if told.key.startswith("bodies."):
        covariance = np.zeros((6, 6))
        at = np.ix_(TOLD, TOLD)
        covariance[at] = told.covariance[at]
    J = np.hstack([np.eye(3), -so3.hat(np.array([distance_m, 0.0, 0.0]))])
    return float(np.sqrt(np.linalg.eigvalsh(J @ covariance @ J.T)[-1]))


def _told(mounts: Mounts, sigmas: Mapping[str, float], words: Words) -> dict:
    columns = [
        column("key", words("mounts.quantity"), kind="code"),
        *(column(f"s{a}", words(f"mounts.sigma_{a}"), "mm", 2) for a in "xyz"),
        *(column(f"r{a}", words(f"mounts.sigma_r{a}"), "°", 3) for a in "xyz"),
        column("moved_mm", words("mounts.moved"), "mm", 1),
        column("moved_deg", words("mounts.turned"), "°", 2),
        column("edge", words("mounts.edge"), "mm", 1),
    ]
    rows = []
    for t in mounts.told:
        sigma = np.sqrt(np.diagonal(t.covariance))
        moved = np.full(6, np.nan) if t.T_file is None else se3.local(t.T_file, t.T)
        rows.append(
            {
                "key": t.key,
                **{f"s{a}": 1000 * v for a, v in zip("xyz", sigma[:3], strict=True)},
                **{f"r{a}": np.rad2deg(v) for a, v in zip("xyz", sigma[3:], strict=True)},
                "moved_mm": 1000 * np.linalg.norm(moved[:3]),
                "moved_deg": np.rad2deg(np.linalg.norm(moved[3:])),
                "edge": 1000 * sigmas[t.key],
            }
        )
    return table(columns, rows)


def _axes(axes: list[ToldPose], words: Words) -> dict:
    columns = [
        column("key", words("mounts.quantity"), kind="code"),
        column("turn", words("mounts.turn"), "°", 0),
        column("poses", words("mounts.poses"), digits=0),
        column("circle", words("mounts.circle"), "mm", 1),
        column("plane", words("mounts.plane"), "mm", 1),
    ]
    rows = []
    for t in axes:
        assert t.axis is not None
        rows.append(
            {
                "key": t.key,
                "turn": np.rad2deg(t.axis.turn_rad),
                "poses": len(t.axis.angle_rad),
                "circle": 1000 * t.axis.circle_m,
                "plane": 1000 * t.axis.plane_m,
            }
        )
    return table(columns, rows)


def _pins(mounts: Mounts, words: Words) -> dict:
    columns = [
        column("shot", words("mounts.shot"), kind="code"),
        column("off", words("mounts.off_axis"), "mm", 1),
        column("sigma", words("mounts.off_sigma"), "mm", 1),
        column("sigmas", words("mounts.off_sigmas"), digits=1),
    ]
    rows = [
        {
            "shot": fit.name,
            "off": 1000 * fit.off_m,
            "sigma": 1000 * fit.sigma_m,
            "sigmas": fit.normalised,
        }
        for fit in mounts.pins
    ]
    return table(columns, rows)


def _circle(told: ToldPose, words: Words) -> Picture:
    axis = told.axis
    assert axis is not None

    def draw() -> Figure:
        figure = new_figure(2.2)
        axes = figure.subplots()
        degrees = np.rad2deg(axis.angle_rad)
        off = 1000 * axis.residual[:, :3] @ axis.T_axis_marker[:3, :3].T
        axes.plot(degrees, np.linalg.norm(off[:, :2], axis=1), "o", ms=2.5, color=palette.INK,
                  label=words("mounts.circle"))  # fmt: skip
        axes.plot(degrees, np.abs(off[:, 2]), "s", ms=2.5, color=palette.MUTED, label=words("mounts.plane"))
        axes.set_xlabel(words("mounts.angle"))
        axes.set_ylabel(words("mounts.off"))
        axes.set_ylim(bottom=0)
        axes.legend()
        return figure

    name = told.key.split(".")[1]
    return Picture(
        f"circle-{name}",
        words("mounts.picture", name=name),
        words("mounts.picture_good"),
        words("mounts.picture_seen"),
        draw,
    )
