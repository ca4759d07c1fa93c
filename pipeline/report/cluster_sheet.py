"""The sheet of a camera cluster: how well the cameras are known against each other, and what says so."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from pipeline.calibration.cluster import CameraPair, Cluster, point_sigma_m
from pipeline.report import palette
from pipeline.report.drawing import new_figure
from pipeline.report.numbers import column, number, table
from pipeline.report.sheet import Demand, Part, Picture, Sheet
from pipeline.report.words import Words

OFF = 3.0
"""Normalised difference of odd and even instants, root mean square of its components, from which it is remarked."""


def cluster_sheet(
    cluster: Cluster,
    demand: Demand,
    free_intrinsics: bool,
    subject: str,
    origin: Mapping[str, str],
    language: str = "en",
) -> Sheet:
    """The page of a cluster.

    Parameters
    ----------
    cluster : Cluster
        As told.
    demand : Demand
        Of the job.
    free_intrinsics : bool
        Whether the lenses are written too.
    subject, origin
        As `Sheet` has them.
    language : str
        Of the words.
    """
    words = Words(language)
    tied = [pair for pair in cluster.pairs if cluster.reference in (pair.first, pair.second)]
    sigmas_m = [point_sigma_m(_against_reference(cluster, pair), demand.distance_m) for pair in tied]
    sigma_m = max(sigmas_m)
    pair = tied[sigmas_m.index(sigma_m)]
    state, sentence = demand.judge(sigma_m, words, "cluster")
    numbers = [
        (
            words("cluster.edge"),
            number(1000 * sigma_m, "mm", 1),
            words("cluster.edge_note", distance=f"{demand.distance_m:g}"),
        ),
        (
            words("cluster.rotation"),
            number(np.rad2deg(pair.sigma_rad), "°", 3),
            f"{pair.first} – {pair.second}",
        ),
        (words("cluster.translation"), number(1000 * pair.sigma_m, "mm", 2), f"{pair.first} – {pair.second}"),
        (words("cluster.instants"), number(pair.instants), words("cluster.instants_note")),
        (words("cluster.sigma0"), number(cluster.whole.sigma0, "", 2), words("cluster.sigma0_note")),
    ]
    parts = [
        Part(
            words("cluster.pairs"),
            [words("cluster.pairs_text", reference=cluster.reference, body=cluster.body)],
            [(words("cluster.pairs_caption"), _pairs(cluster, words))],
            [_closure_picture(cluster, words)] if any(p.closures for p in cluster.pairs) else [],
        ),
        Part(
            words("cluster.cross"),
            [words("cluster.cross_text")],
            [(words("cluster.cross_caption"), _cross(cluster, words))],
        ),
        Part(
            words("cluster.site"),
            [words("cluster.site_text")],
            [
                (words("cluster.residuals_caption"), _residuals(cluster, words)),
                (words("cluster.site_caption"), _benchmarks(cluster, words)),
            ],
        ),
    ]
    if free_intrinsics:
        parts.append(
            Part(
                words("cluster.lenses"),
                [words("cluster.lenses_text")],
                [(words("cluster.lenses_caption"), _lenses(cluster, words))],
            )
        )
    return Sheet(
        title=words("cluster.title"),
        subject=subject,
        state=state,
        sentence=sentence,
        numbers=numbers,
        remarks=_remarks(cluster, words),
        parts=parts,
        origin=origin,
    )


def _against_reference(cluster: Cluster, pair: CameraPair) -> np.ndarray:
    """Covariance of the other camera of a pair, felt in it."""
    other = pair.second if pair.first == cluster.reference else pair.first
    return cluster.mounts[other][1]


def _remarks(cluster: Cluster, words: Words) -> list[str]:
    remarks = []
    for name, (xi, expected) in cluster.cross.items():
        ratio = float(np.sqrt(xi @ np.linalg.solve(expected, xi) / 6))
        if ratio > OFF:
            remarks.append(words("cluster.apart", camera=name, ratio=f"{ratio:.1f}"))
    for name, facts in cluster.benchmarks.items():
        if facts.get("off"):
            remarks.append(words("cluster.moved", name=name, sigmas=f"{facts['normalised']:.1f}"))
    if cluster.whole.sigma0 > 1.5:
        remarks.append(words("cluster.noisy", sigma0=f"{cluster.whole.sigma0:.1f}"))
    return [*remarks, *cluster.whole.warnings]


def _pairs(cluster: Cluster, words: Words) -> dict:
    columns = [
        column("first", words("cluster.first"), kind="id"),
        column("second", words("cluster.second"), kind="id"),
        column("instants", words("cluster.instants"), digits=0),
        column("sigma_mm", words("cluster.translation"), "mm", 2),
        column("sigma_deg", words("cluster.rotation"), "°", 4),
        column("closure_mm", words("cluster.closure_mm"), "mm", 1),
        column("closure_deg", words("cluster.closure_deg"), "°", 3),
    ]
    rows = [
        {
            "first": p.first,
            "second": p.second,
            "instants": p.instants,
            "sigma_mm": 1000 * p.sigma_m,
            "sigma_deg": np.rad2deg(p.sigma_rad),
            "closure_mm": None if p.closures is None else 1000 * p.closures.rms_m,
            "closure_deg": None if p.closures is None else np.rad2deg(p.closures.rms_rad),
        }
        for p in cluster.pairs
    ]
    return table(columns, rows)


def _cross(cluster: Cluster, words: Words) -> dict:
    columns = [
        column("camera", words("cluster.camera"), kind="id"),
        column("mm", words("cluster.apart_mm"), "mm", 2),
        column("expected_mm", words("cluster.expected_mm"), "mm", 2),
        column("deg", words("cluster.apart_deg"), "°", 4),
        column("expected_deg", words("cluster.expected_deg"), "°", 4),
        column("ratio", words("cluster.ratio"), digits=2),
    ]
    rows = []
    for name, (xi, expected) in cluster.cross.items():
        rows.append(
            {
                "camera": name,
                "mm": 1000 * np.linalg.norm(xi[:3]),
                "expected_mm": 1000 * np.sqrt(np.trace(expected[:3, :3])),
                "deg": np.rad2deg(np.linalg.norm(xi[3:])),
                "expected_deg": np.rad2deg(np.sqrt(np.trace(expected[3:, 3:]))),
                "ratio": np.sqrt(xi @ np.linalg.solve(expected, xi) / 6),
            }
        )
    return table(columns, rows)


def _residuals(cluster: Cluster, words: Words) -> dict:
    columns = [
        column("camera", words("cluster.camera"), kind="id"),
        column("corners", words("cluster.corners"), digits=0),
        column("px", words("cluster.px"), "px", 3),
        column("normalised", words("cluster.normalised"), digits=2),
    ]
    residuals, rows = cluster.whole.residuals, []
    for k, camera in enumerate(cluster.whole.network.cameras):
        own = (residuals.camera == k) & (residuals.weight > 0)
        rows.append(
            {
                "camera": camera.name,
                "corners": int(np.sum(own)),
                "px": np.sqrt(np.mean(residuals.residual[own] ** 2)),
                "normalised": np.sqrt(np.mean(residuals.normalised[own] ** 2) / 2),
            }
        )
    return table(columns, rows)


def _benchmarks(cluster: Cluster, words: Words) -> dict:
    columns = [
        column("name", words("cluster.benchmark"), kind="id"),
        *(column(axis, words(f"cluster.{axis}"), "mm", 1, signed=True) for axis in ("de", "dn", "dh")),
        column("normalised", words("cluster.normalised"), digits=1),
        column("why", words("cluster.note"), kind="why"),
    ]
    rows = []
    for name, facts in cluster.benchmarks.items():
        moved = facts.get("difference_mm", [None] * 3)
        rows.append(
            {
                "name": name,
                **dict(zip(("de", "dn", "dh"), moved, strict=True)),
                "normalised": facts.get("normalised"),
                "why": facts.get("why", ""),
            }
        )
    return table(columns, rows)


def _lenses(cluster: Cluster, words: Words) -> dict:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    columns = [column("camera", words("cluster.camera"), kind="id"), column("row", words("cluster.what"))]
    columns += [column(name, name, "px" if k < 4 else "", 2 if k < 4 else 5) for k, name in enumerate(names)]
    rows = []
    for camera, (lens, covariance) in cluster.intrinsics.items():
        for row, values in (("value", lens), ("sigma", np.sqrt(np.diagonal(covariance)))):
            rows.append(
                {"camera": camera, "row": words(f"cluster.{row}"), **dict(zip(names, values, strict=True))}
            )
    return table(columns, rows)


def _closure_picture(cluster: Cluster, words: Words) -> Picture:
    def draw() -> Figure:
        figure = new_figure(2.4)
        left, right = figure.subplots(1, 2)
        begin = min(int(p.closures.time_ns[0]) for p in cluster.pairs if p.closures is not None)
        marks = ("o", "s", "^", "D", "v")
        for k, pair in enumerate(p for p in cluster.pairs if p.closures is not None):
            assert pair.closures is not None
            t = (pair.closures.time_ns - begin) * 1e-9
            for axes, values in (
                (left, 1000 * np.linalg.norm(pair.closures.xi[:, :3], axis=1)),
                (right, np.rad2deg(np.linalg.norm(pair.closures.xi[:, 3:], axis=1))),
            ):
                axes.plot(t, values, marks[k % len(marks)], ms=2.5, color=palette.INK, alpha=max(0.35, 1 - 0.2 * k),
                          label=f"{pair.first} – {pair.second}")  # fmt: skip
        for axes, label in ((left, "cluster.closure_axis_mm"), (right, "cluster.closure_axis_deg")):
            axes.set_xlabel(words("cluster.seconds"))
            axes.set_ylabel(words(label))
            axes.set_ylim(bottom=0)
        figure.legend(*left.get_legend_handles_labels(), loc="outside upper right", ncols=3)
        return figure

    return Picture(
        "closures",
        words("cluster.closures"),
        words("cluster.closures_good"),
        words("cluster.closures_seen"),
        draw,
    )
