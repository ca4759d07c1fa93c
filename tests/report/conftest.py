"""A made-up run: small tables with every verdict, a gap, a benchmark nobody saw and hostile names."""

import copy

import numpy as np
import pytest

from pipeline.config import load_machine, load_site
from pipeline.detection.preview import preview_jpeg
from pipeline.report import FileSource, ReportInputs, View
from pipeline.report.moments import Moment
from pipeline.surface.alignment import polyline

T0 = 1_790_000_000_000_000_000
HOSTILE = '<script>alert("x")</script> & $a$'

MACHINE = """
format = "gradetrace/machine/1"
[machine]
id = "pc210"
name = "Komatsu PC210 no. 7"
[bodies.cab]
kind = "moving"
[bodies.stick]
kind = "moving"
[bodies.bucket]
kind = "joint"
parent = "stick"
axis = { xyz_m = [0, 0, 0], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.05 }
[cameras.bench]
topic = "/bench/image"
body = "cab"
mount = { xyz_m = [0, 0, 0], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.05 }
[cameras.stickcam]
topic = "/stick/image"
body = "cab"
mount = { xyz_m = [0, 0, 0], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.05 }
[cutting_edge]
body = "bucket"
mount = { xyz_m = [0, 0, 1.2], rpy_deg = [0, 0, 0], sigma_mm = 2, sigma_deg = 0.1 }
width_m = 1.2
wear = [{ date = 2026-11-01, wear_mm = 3, sigma_mm = 1 }]
"""

SITE = """
format = "gradetrace/site/1"
[site]
id = "north-main"
name = "North main, lot 4"
[grid]
unit = "{unit}"
origin = [{origin}]
name = "Site grid 2026, heights NN2000"
[benchmarks.BM1]
family = "tag36h11"
tags = [{{ id = 1, size_m = 0.3 }}]
pose = {{ enh = [{bm1}], rpy_deg = [90, 0, 0], sigma_mm = 2, sigma_deg = 0.1 }}
[benchmarks.BM2]
family = "tag36h11"
tags = [{{ id = 2, size_m = 0.3 }}]
pose = {{ enh = [{bm2}], rpy_deg = [90, 0, 0], sigma_mm = 2, sigma_deg = 0.1 }}
[benchmarks.BM3]
family = "tag36h11"
tags = [{{ id = 3, size_m = 0.3 }}]
pose = {{ enh = [{bm3}], rpy_deg = [90, 0, 0], sigma_mm = 2, sigma_deg = 0.1 }}
[alignment]
points = [[{p0}], [{p1}], [{p2}]]
start_station = {start}
[design]
file = "design.csv"
kind = "profile_csv"
[tolerance]
high_mm = 30
low_mm = 50
[checks]
file = "checks.csv"
order = "PNEZD"
sigma_mm = 2
[report]
title = "Trench as built"
company = "Made-up Earthworks"
"""

ORIGIN_M = np.array([501_200.0, 4_201_700.0, 60.0])
METRES = {"m": 1.0, "international_foot": 0.3048, "us_survey_foot": 1200.0 / 3937.0}


def site_text(unit="m"):
    """A site in `unit` whose metres are the same for every unit."""
    scale = METRES[unit]

    def enh(*metres):
        return ", ".join(repr(float((m + o) / scale)) for m, o in zip(metres, ORIGIN_M))

    return SITE.format(
        unit=unit,
        origin=", ".join(str(round(o / scale)) for o in ORIGIN_M),
        bm1=enh(2.0, 14.0, 1.5),
        bm2=enh(9.0, 16.0, 1.2),
        bm3=enh(16.0, 13.0, 1.8),
        p0=enh(0.0, 0.0),
        p1=enh(9.0, 3.0),
        p2=enh(18.0, 5.0),
        start=repr(100.0 / scale),
    )


def stations_table(rng, n=36, step=0.5):
    s = 100.0 + step * (np.arange(n) + 0.5)
    design = 58.5 - 0.01 * (s - 100.0)
    deviation = 0.004 + 0.006 * np.sin(s) + rng.normal(0, 0.003, n)
    deviation[12:14] = [0.071, 0.064]
    deviation[20] = 0.031
    deviation[27] = -0.046
    own, common = np.full(n, 0.003), np.full(n, 0.0045)
    state = np.array(["cut"] * n, object)
    state[-3:] = "not reached"
    state[16] = "partly cut"
    k_sigma = 2 * np.hypot(own, common)
    gone = state == "not reached"
    for values in (deviation, own, common, k_sigma):
        values[gone] = np.nan
    verdict = np.array(["PASS"] * n, object)
    verdict[(deviation - k_sigma > 0.030) | (deviation + k_sigma < -0.050)] = "FAIL"
    unsure = (deviation + k_sigma > 0.030) | (deviation - k_sigma < -0.050)
    verdict[unsure & (verdict != "FAIL")] = "CANNOT TELL"
    verdict[gone] = "NOT REACHED"
    reason = np.array(["inside the tolerance with its uncertainty"] * n, object)
    reason[verdict == "FAIL"] = "above the tolerance, uncertainty included"
    reason[verdict == "CANNOT TELL"] = "the tolerance limit lies inside the uncertainty"
    reason[gone] = "the cutting edge never came here"
    return {
        "station": s,
        "state": state,
        "h": design + deviation,
        "design_h": design,
        "deviation": deviation,
        "sigma_own": own,
        "sigma_common": common,
        "expanded_uncertainty": k_sigma,
        "width": np.where(gone, np.nan, 1.2),
        "cells_cut": np.where(gone, 0, 240).astype(np.int32),
        "cells_floor": np.full(n, 240, np.int32),
        "verdict": verdict,
        "reason": reason,
    }


def sides_and_volumes(stations):
    """Tables of the sides and the volumes of made-up stations."""
    gone = stations["verdict"] == "NOT REACHED"
    n = len(gone)
    outward = np.column_stack([0.02 * np.sin(stations["station"]), 0.015 * np.cos(stations["station"])])
    outward[gone] = np.nan
    outward[3, 1] = np.nan
    known = np.isfinite(outward)
    sides = {
        "station": np.repeat(stations["station"], 2),
        "side": np.tile(np.array(["left", "right"], object), n),
        "width": np.repeat(1.2 + outward.sum(axis=1), 2),
        "sigma_width": np.where(known.all(axis=1), 0.0057, np.nan).repeat(2),
        "outward": outward.ravel(),
        "sigma_own": np.where(known, 0.004, np.nan).ravel(),
        "sigma_common": np.where(known, 0.003, np.nan).ravel(),
        "slope": np.where(known, 0.52, np.nan).ravel(),
        "sigma_slope": np.where(known, 0.04, np.nan).ravel(),
        "expanded_uncertainty": np.where(known, 0.01, np.nan).ravel(),
        "verdict": np.where(known, "PASS", "NOT REACHED").astype(object).ravel(),
        "reason": np.full(2 * n, "", object),
    }
    volumes = {
        "station": np.repeat(stations["station"], 3),
        "kind": np.tile(np.array(["cut", "left to cut", "over-dug"], object), n),
        "volume": np.column_stack([np.where(gone, 0.0, 1.15), np.full(n, 0.02), np.full(n, 0.005)]).ravel(),
        "sigma_own": np.full(3 * n, 0.003),
        "sigma_common": np.full(3 * n, 0.004),
        "area": np.repeat(np.where(gone, 0.0, 0.6), 3),
    }
    return sides, volumes


def as_built_table(rng, stations):
    s = np.arange(100.025, 118.0, 0.05)
    o = np.arange(-0.875, 0.9, 0.05)
    ss, oo = (a.ravel() for a in np.meshgrid(s, o, indexing="ij"))
    design = 58.5 - 0.01 * (ss - 100.0)
    known = np.isfinite(stations["deviation"])
    deviation = np.interp(ss, stations["station"][known], stations["deviation"][known])
    deviation = deviation + rng.normal(0, 0.003, len(ss))
    state = np.array(["cut"] * len(ss), object)
    state[np.abs(oo) > 0.6] = "passed over"
    state[(np.abs(oo) > 0.75) | (ss > 116.5)] = "never touched"
    state[(ss > 108.0) & (ss < 108.4) & (oo > 0)] = "passed over"
    design[np.abs(oo) > 0.6] = np.nan
    cut = state == "cut"
    return {
        "station": ss,
        "offset": oo,
        "state": state,
        "h": np.where(cut, design + deviation, np.nan),
        "h_lowest": np.where(cut, design + deviation - 0.002, np.nan),
        "design_h": design,
        "deviation": np.where(cut, deviation, np.nan),
        "sigma_own": np.where(cut, 0.004, np.nan),
        "sigma_common": np.where(cut, 0.0045, np.nan),
        "passes": np.where(cut, 5, 0).astype(np.int32),
        "lowest_time_ns": np.where(cut, T0 + 10**9, 0),
    }


def checks_table(rng, n=9):
    s = np.linspace(101.0, 117.5, n)
    difference = rng.normal(0.002, 0.005, n)
    sigma, sigma_ts = np.full(n, 0.0054), np.full(n, 0.002)
    result = np.array(["compared"] * n, object)
    result[-1] = "outside the cut"
    for values in (difference, sigma):
        values[-1] = np.nan
    h = 58.5 - 0.01 * (s - 100.0) + 0.004
    return {
        "point": np.array([f"{i:03d}" for i in range(1, n)] + [HOSTILE], object),
        "code": np.array(["FLOOR"] * (n - 1) + ["</table>"], object),
        "kind": np.full(n, "floor", object),
        "edge_point": np.full(n, "", object),
        "time_ns": np.full(n, T0),
        **{name: np.full(n, np.nan) for name in ("difference_e", "difference_n", "sigma_e", "sigma_n")},
        "sigma_own": 0.6 * sigma,
        "sigma_common": 0.8 * sigma,
        "e": ORIGIN_M[0] + (s - 100),
        "n": ORIGIN_M[1] + (s - 100) / 3,
        "h": h,
        "station": s,
        "offset": np.linspace(-0.3, 0.3, n),
        "as_built_h": h + difference,
        "difference": difference,
        "sigma": sigma,
        "sigma_ts": sigma_ts,
        "z": difference / np.hypot(sigma, sigma_ts),
        "result": result,
    }


def log_tables(rng, seconds=120, rate=5):
    times = T0 + (np.arange(seconds * rate) * (10**9 // rate)).astype(np.int64)
    n = len(times)
    frames = {
        "camera": np.array(["bench"] * n + ["stickcam"] * n, object),
        "frame": np.tile(np.arange(n, dtype=np.int32), 2),
        "time_ns": np.tile(times, 2),
    }
    seen = np.ones(n, bool)
    seen[200:260] = False
    detections = {}
    for camera, tags in (("bench", (1, 2)), ("stickcam", (11,))):
        t = np.concatenate([times[seen]] * len(tags))
        status = np.array(["accepted"] * len(t), object)
        status[rng.random(len(t)) < 0.06] = "low margin"
        status[rng.random(len(t)) < 0.02] = "cut by the border"
        detections[camera] = {
            "time_ns": t,
            "tag_id": np.repeat(np.array(tags, np.int32), int(seen.sum())),
            "status": status,
        }
    m = 4000
    whitened = rng.rayleigh(1.0, m)
    residuals = {
        "camera": np.array(["bench", "stickcam"], object)[np.arange(m) % 2],
        "time_ns": np.sort(rng.choice(times, m)),
        "marker": np.array(["BM1", "stick", "BM2", "stick"], object)[np.arange(m) % 4],
        "tag_id": np.array([1, 11, 2, 11], np.int32)[np.arange(m) % 4],
        "corner": (np.arange(m) % 4).astype(np.int32),
        "residual_u": rng.normal(0, 0.1, m),
        "residual_v": rng.normal(0, 0.1, m),
        "sigma_px": np.full(m, 0.1),
        "normalised": whitened,
        "weight": np.minimum(1.0, 2.5 / whitened),
    }
    # Strokes of the edge, and from the 70th to the 90th second it waits.
    t = np.arange(n) / rate
    stroke = np.where((t >= 70) & (t < 90), 0.0, np.sin(2 * np.pi * (t - 70) / 16))
    middle = np.stack([4 * stroke, 1.5 * stroke, -1 + 0.5 * stroke], axis=1) + ORIGIN_M
    points = middle[:, None] + np.array([[-0.6, 0, 0], [0, 0, 0], [0.6, 0, 0]])
    points = (points + rng.normal(0, 0.003, points.shape)).reshape(-1, 3)
    edge = {
        "time_ns": np.repeat(times, 3),
        "point": np.array(["left", "middle", "right"] * n, object),
        **dict(zip("enh", points.T)),
        "seen": np.repeat(seen, 3),
    }
    return frames, detections, residuals, edge


STATICS = {
    "quantity": ["camera bench mount", "camera bench mount", "benchmark BM2", "sensor bucket"],
    "source": ["mounts", "mounts", "benchmarks", "linkage and sensor"],
    "component": ["rx", "x", "z", "c0"],
    "unit": ["rad", "m", "m", "m"],
    "file_value": [0.1, 0.5, 61.5, 0.02],
    "value": [0.1001, 0.5004, 61.507, 0.0203],
    "prior_sigma": [0.00087, 0.001, 0.002, 0.0004],
    "sigma": [0.0002, 0.0009, 0.0015, 0.0003],
    "shift_sigmas": [0.11, 0.4, 3.5, 0.75],
}


def square(u, v, side):
    """(4, 2) corners of an upright tag."""
    return np.array([[u, v], [u + side, v], [u + side, v + side], [u, v + side]], float)


def view(stations=(106.25,), camera="bench", seed=0):
    """A frame of noise with a tag that was used, one left out as gross and one that is covered."""
    rng = np.random.default_rng(seed)
    uv = np.stack([square(100, 120, 60), square(300, 200, 40), square(420, 90, 30)])
    predicted = uv + np.array([0.3, -0.4])
    predicted[1] += 3.0
    predicted[2] = np.nan
    tags = {
        "tag": np.array(["tag36h11 1", "tag36h11 2", "tag36h11 11"], object),
        "marker": np.array(["BM1", "BM2", "stick"], object),
        "status": np.array(["accepted", "accepted", "covered"], object),
        "uv": uv,
        "predicted": predicted,
        "normalised": np.array([1.2, 27.0, np.nan]),
        "weight": np.array([0.9, 0.0, np.nan]),
    }
    picture = rng.integers(0, 256, (480, 640), dtype=np.uint8)
    return View(stations, camera, T0 + 10**9, 640, 480, preview_jpeg(picture), "", tags)


def made_up_inputs(unit="m", seed=7):
    """The whole made-up run for a site whose grid is in `unit`."""
    rng = np.random.default_rng(seed)
    stations = stations_table(rng)
    sides, volumes = sides_and_volumes(stations)
    views = (
        view(),
        view((106.25, 106.75), "stickcam", 1),
        View((113.75,), "bench", T0, why="it is not there"),
    )
    frames, detections, residuals, edge = log_tables(rng)
    statics = {
        key: np.array(values, object if isinstance(values[0], str) else float)
        for key, values in STATICS.items()
    }
    return ReportInputs(
        machine=load_machine(MACHINE, "machine.toml"),
        site=load_site(site_text(unit), "site.toml"),
        log=FileSource("shift.mcap", "shift.mcap", "a" * 64),
        machine_file=FileSource("machine.toml", "attachment of the log", "b" * 64),
        site_file=FileSource("site.toml", "sites/site.toml", "c" * 64),
        named_files={
            "design": FileSource("design.csv", "beside site.toml", "d" * 64),
            "checks": FileSource("checks.csv", "beside site.toml", "e" * 64),
        },
        alignment=polyline(np.array([[0.0, 0.0], [9.0, 3.0], [18.0, 5.0]]) + ORIGIN_M[:2], 100.0),
        tables={
            "frames": frames,
            "residuals": residuals,
            "statics": statics,
            "cutting_edge": edge,
            "as_built": as_built_table(rng, stations),
            "stations": stations,
            "station_budgets": {
                "station": np.repeat(stations["station"][:33], 3),
                "source": np.tile(np.array(["benchmarks", "mounts", "time offset"], object), 33),
                "sigma": np.tile([0.0036, 0.0027, 0.0], 33),
            },
            "sides": sides,
            "volumes": volumes,
            "checks": checks_table(rng),
        },
        detections=detections,
        moments=(
            Moment(106.25, 0.071, 0.0108, "FAIL", T0 + 10**9, 200, 240),
            Moment(106.75, 0.064, 0.0108, "FAIL", T0 + 2 * 10**9, 130, 240),
        ),
        views=views,
        log_facts=copy.deepcopy(LOG_FACTS),
        detection=copy.deepcopy(DETECTION),
        solution=copy.deepcopy(SOLUTION),
        survey=copy.deepcopy(SURVEY),
        manifests={
            stage: {"stage": stage, "version": 1, "fingerprint": f"{i}" * 64, "seconds": 1.5}
            for i, stage in enumerate(("ingest", "detect", "estimate", "track", "survey"))
        },
        versions={"gradetrace": "0.1.0", "python": "3.11", "numpy": "2.3"},
    )


LOG_FACTS = {
    "start_ns": T0,
    "end_ns": T0 + 120 * 10**9,
    "recovery": {
        "complete": False,
        "lost_bytes": 2_000_000,
        "lost_seconds": 14.2,
        "damaged_chunks": 0,
        "sentence": "The recording ends in the middle of a chunk.",
    },
}


def scatter(ratio, shake_ratio=1.0, **others):
    """A row of detection.json for corners of 0.02 px predicted noise."""
    return {
        "frames": 480,
        "corners": 1920,
        "outliers": 0,
        "scatter_px": 0.02 * ratio,
        "predicted_px": 0.02,
        "ratio": ratio,
        "ratio_low": 0.96 * ratio,
        "ratio_high": 1.04 * ratio,
        "lag1": 0.1,
        "shake_px": 0.01 * shake_ratio,
        "shake_ratio": shake_ratio,
        "shake_low": 0.9 * shake_ratio,
        **others,
    }


def tag_scatter(tag_id, side, ratio, shake_ratio=1.0):
    return scatter(ratio, shake_ratio, family="tag36h11", tag_id=tag_id, tags=1, side_px=side)


DETECTION = {
    "cameras": {
        "bench": {
            "pixel_noise": {
                "sizes": [
                    scatter(1.1, low_px=0.0, high_px=25.0, tags=1),
                    scatter(1.9, low_px=25.0, high_px=50.0, tags=1),
                ],
                "tags": [tag_scatter(1, 22.0, 1.1), tag_scatter(2, 41.0, 1.9, 6.0)],
            }
        },
        "stickcam": {
            "pixel_noise": {
                "sizes": [scatter(0.3, low_px=100.0, high_px=None, tags=1)],
                "tags": [tag_scatter(11, 140.0, 0.3)],
            }
        },
    }
}
SOLUTION = {
    "iterations": 6,
    "global_test": {
        "measurements": 9000,
        "redundancy": 7421.0,
        "sigma0_squared": 1.04,
        "bounds_95": [0.968, 1.033],
        "passed": False,
    },
    "error_budget": {
        "own": 0.0021,
        "benchmarks": 0.0019,
        "mounts": 0.0031,
        "intrinsics": 0.0004,
        "linkage and sensor": 0.0024,
        "cutting edge": 0.0010,
        "time offset": 0.0002,
    },
    "error_budget_by_class": {
        "digging": {"epochs": 1500, "sigma": 0.0049, "own": 0.0019, "benchmarks": 0.0019},
        "bridged": {"epochs": 60, "sigma": 0.031, "own": 0.0305, "benchmarks": 0.0019},
    },
    "correlation_time_s": {"median": 0.31, "longest": 2.4, "digging": 0.31, "bridged": 1.72},
    "warnings": ["benchmark BM2 moved 3.5 sigma from its file value"],
}
CHECKED = {"n": 8, "bias": 0.0021, "rmse": 0.0049, "worst": -0.0092, "reduced_chi_square": 0.83}


def candidate(kind, name="", component="", unit="m", value=0.012, w=6.0):
    """One cause of a diagnosis, as survey.json has it."""
    return {
        "kind": kind, "name": name, "component": component, "unit": unit, "value": value,
        "sigma": value / w, "w": w, "p_value": 1e-8, "left_p_value": 0.4, "seen_from": 0.008, "told_from": None,
        "plausible": True,
    }  # fmt: skip


SURVEY = {
    "verdict": "FAIL",
    "reach": {"first": 100.0, "last": 116.5, "dug": 16.0, "gaps": [[108.0, 108.5]], "sigma": 0.0144},
    "uncut_floor": 0.6,
    "left_where_not_cut": 2.5,
    "side_tolerance": {"wide": 0.05, "narrow": 0.02},
    "volumes": [
        {"kind": "cut", "m3": 38.05, "sigma_own": 0.03, "sigma_common": 0.04, "area": 19.8},
        {"kind": "left to cut", "m3": 3.125, "sigma_own": 0.006, "sigma_common": 0.008, "area": 1.2},
        {"kind": "over-dug", "m3": 0.18, "sigma_own": 0.012, "sigma_common": 0.005, "area": 9.0},
    ],
    "wanted_shots": {
        "shots": [{"station": 110.25, "settles": 0.75}, {"station": 108.25, "settles": 1.25}],
        "open": 2,
        "partly": 1,
        "best_alone": 1.5,
        "sigma_shot": 0.002,
    },
    "checks": {
        **CHECKED,
        "kinds": {
            "floor": {
                **CHECKED,
                "horizontal_rmse": None,
                "shots": 9,
                "global_test": {"statistic": 7.1, "components": 8, "p_value": 0.5251},
            },
            "control": {
                **dict.fromkeys(("bias", "rmse", "worst", "horizontal_rmse"), 0.004),
                "n": 1,
                "reduced_chi_square": 0.5,
                "shots": 2,
                "global_test": {"statistic": 2.2, "components": 2, "p_value": 0.3329},
            },
        },
        "diagnosis": {
            "state": "named",
            "named": candidate("wear"),
            "rivals": [],
            "telling_shot": None,
            "global_test": {"statistic": 44.0, "components": 8, "p_value": 6e-7},
            "critical": 2.6,
            "common_factors": True,
            "candidates": [
                candidate("wear"),
                candidate("time offset", "pot", unit="s", value=-0.02, w=-1.2),
                candidate("sensor", "pot", unit="deg", value=0.31, w=1.0),
                candidate("benchmark", "B<2>", "n", value=0.03, w=0.5),
                candidate("datum", component="h", value=-0.003, w=-0.2),
            ],
        },
    },
}


@pytest.fixture(scope="session")
def made_up():
    """`made_up_inputs`, for tests that need their own."""
    return made_up_inputs
