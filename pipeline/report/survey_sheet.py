"""The sheet of a survey of markers: their poses, and how well the shots fit the prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.calibration.corner_survey import MarkerPose, SurveyedMarker, datum_sigma_m
from pipeline.report.numbers import column, number, table
from pipeline.report.sheet import Demand, Part, Sheet
from pipeline.report.words import Words

ODD_SIZE = 3.0
"""Sigmas of a print's size in the survey against the file's from which it is remarked."""


def survey_sheet(
    poses: Sequence[MarkerPose],
    markers: Sequence[SurveyedMarker],
    demand: Demand,
    subject: str,
    origin: Mapping[str, str],
    language: str = "en",
) -> Sheet:
    """The page of a survey.

    Parameters
    ----------
    poses, markers
        What was told, and from what; in the same order.
    demand : Demand
        Of the job.
    subject, origin
        As `Sheet` has them.
    language : str
        Of the words.
    """
    words = Words(language)
    sigma_m = datum_sigma_m(poses, demand.distance_m)
    chi_square, redundancy = (sum(getattr(p, key) for p in poses) for key in ("chi_square", "redundancy"))
    state, sentence = demand.judge(sigma_m, words, "marker_survey")
    return Sheet(
        title=words("marker_survey.title"),
        subject=subject,
        state=state,
        sentence=sentence,
        numbers=[
            (words("marker_survey.edge"), number(1000 * sigma_m, "mm", 1), words("marker_survey.edge_note")),
            (words("marker_survey.markers"), number(len(poses)), ""),
            (
                words("marker_survey.fit"),
                number(np.sqrt(chi_square / redundancy), "", 2),
                words("marker_survey.fit_note"),
            ),
        ],
        remarks=[
            words("marker_survey.size", name=p.name, percent=f"{100 * (p.scale - 1):+.2f}")
            for p in poses
            if abs(p.scale - 1) > ODD_SIZE * p.sigma_scale
        ],
        parts=[
            Part(
                words("marker_survey.poses"),
                [words("marker_survey.poses_text")],
                [
                    (words("marker_survey.poses_caption"), _poses(poses, words)),
                    (words("marker_survey.corners_caption"), _corners(poses, markers, words)),
                ],
            )
        ],
        origin=origin,
    )


def _poses(poses: Sequence[MarkerPose], words: Words) -> dict:
    columns = [
        column("name", words("marker_survey.marker"), kind="id"),
        column("corners", words("marker_survey.corners"), digits=0),
        column("sigma_mm", words("marker_survey.sigma"), "mm", 2),
        column("sigma_deg", words("marker_survey.sigma_turn"), "°", 3),
        column("in_plane", words("marker_survey.in_plane"), "mm", 2),
        column("out_of_plane", words("marker_survey.out_of_plane"), "mm", 2),
        column("size", words("marker_survey.size_column"), "%", 2, signed=True),
        column("size_sigma", words("marker_survey.size_sigma"), "%", 2),
        column("fit", words("marker_survey.fit"), digits=2),
    ]
    return table(
        columns,
        [
            {
                "name": p.name,
                "corners": len(p.residual),
                "sigma_mm": 1000 * np.sqrt(np.trace(p.covariance[:3, :3]) / 3),
                "sigma_deg": np.rad2deg(np.sqrt(np.trace(p.covariance[3:, 3:]) / 3)),
                "in_plane": 1000 * p.in_plane_m,
                "out_of_plane": 1000 * p.out_of_plane_m,
                "size": 100 * (p.scale - 1),
                "size_sigma": 100 * p.sigma_scale,
                "fit": np.sqrt(p.chi_square / p.redundancy),
            }
            for p in poses
        ],
    )


def _corners(poses: Sequence[MarkerPose], markers: Sequence[SurveyedMarker], words: Words) -> dict:
    columns = [
        column("corner", words("marker_survey.corner"), kind="id"),
        *(
            column(axis, words(f"marker_survey.{axis}"), "mm", 1, signed=True)
            for axis in ("right", "up", "out")
        ),
    ]
    rows = [
        {"corner": corner, **dict(zip(("right", "up", "out"), 1000 * r, strict=True))}
        for pose, marker in zip(poses, markers, strict=True)
        for corner, r in zip(marker.corners, pose.residual, strict=True)
    ]
    return table(columns, rows)
