"""Volumes against closed forms, and one-sided sums against the bias of noise."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.surface.as_built import as_built
from pipeline.surface.design import ProfileDesign
from pipeline.surface.ground import Ground, LevelGround
from pipeline.surface.sides import sides
from pipeline.surface.sweep import path_along
from pipeline.surface.volumes import CUT, LEFT, OVER, _strips, volumes

GROUND = Ground(LevelGround(52.0), 0.02)
STATION = np.arange(0.0, 10.5, 0.5)


def of(trench, edge, ground=GROUND, design=None):
    design = design or trench.design
    path = path_along(edge, trench.alignment)
    built = as_built(edge, trench.alignment, design, 0.05, path=path)
    both = sides(path, built, design, STATION, 0.5)
    return volumes(built, design, ground, both.rows, STATION, 0.5), built


def by_kind(found):
    return {volume.kind: volume for volume in found}


def test_a_box_of_soil_is_cut_and_the_rest_of_the_design_is_left(trench):
    # One metre wide, two metres deep, dug from station 2 to 8 without an error.
    found, built = of(trench, trench.passes([50.0], common=0.003))
    job = by_kind(found.job)
    rounding = 2 * 0.05 * 1.0 * 2.0
    assert job[CUT].m3 == pytest.approx(6.0 * 1.0 * 2.0, abs=rounding)
    assert job[LEFT].m3 == pytest.approx(4.0 * 1.0 * 2.0, abs=rounding)
    assert job[CUT].m3 + job[LEFT].m3 == pytest.approx(10 * 1.0 * 2.0, abs=0.01)
    # The whole floor is off by one error of 3 mm, no telling which way: over-dug is the mean of what that makes
    # below the design, and as uncertain as a half-normal's positive part is.
    below = 0.003 * 6.0 / np.sqrt(2 * np.pi)
    assert job[OVER].m3 == pytest.approx(below, rel=0.05)
    assert job[OVER].sigma_common_m3 == pytest.approx(below * np.sqrt(np.pi - 1), rel=0.05)
    # The ground's error and the edge's are each the same everywhere: they grow with the area, not with its root.
    area = built.cut.sum() * 0.05**2
    assert job[CUT].sigma_common_m3 == pytest.approx(area * np.hypot(0.02, 0.003), rel=1e-3)
    assert sum(by_kind(of_station)[CUT].m3 for of_station in found.of_station) == pytest.approx(job[CUT].m3)


def test_a_trench_narrower_than_a_whole_number_of_cells_keeps_its_volume(trench):
    wide = trench.passes([50.0], width=0.93)
    found, built = of(trench, wide)
    assert built.cut.sum() * 0.05**2 * 2.0 != pytest.approx(6 * 0.93 * 2.0, abs=0.1)  # cells alone would err
    assert by_kind(found.job)[CUT].m3 == pytest.approx(6 * 0.93 * 2.0, abs=0.05 * 2 * 0.93 * 2)


def test_over_dug_and_standing_soil_are_what_the_closed_form_says(trench):
    # A floor that tilts from 30 mm high to 30 mm low: two triangles.
    count = 60
    station = np.linspace(2, 8, count)
    edge = trench.edge(np.arange(count) / 20, station, 0.0, 50.03 - 0.01 * (station - 2), sigma=1e-5)
    found, _ = of(trench, edge, ground=None)
    job = by_kind(found.job)
    assert job[OVER].m3 == pytest.approx(0.5 * 3 * 0.03, rel=0.02)
    assert job[LEFT].m3 == pytest.approx(0.5 * 3 * 0.03, rel=0.02)
    assert np.isnan(job[CUT].m3) and np.isnan(found.not_reached_m3)


def test_noise_does_not_dig(trench):
    """A floor exactly on its design, seen with sigma 6 mm: the plain sum of what lies low says 2.4 mm everywhere."""
    rng = np.random.default_rng(1)
    sigma, plain, freed, error = 0.006, [], [], []
    for _ in range(6):
        sweeps, count = 24, 12
        t = np.concatenate([k * 7 + np.arange(count) / 20 for k in range(sweeps)])
        station = np.concatenate([np.linspace(1.0 + k / 3, 1.4 + k / 3, count) for k in range(sweeps)])
        noise = np.repeat(rng.normal(0, sigma, sweeps), count)
        edge = trench.edge(t, station, 0.0, 50.0 + noise, sigma=sigma)
        found, built = of(trench, edge, ground=None)
        volume = by_kind(found.job)[OVER]
        low = -built.deviation[built.cut & np.isfinite(built.deviation)]
        plain.append(np.maximum(low, 0).sum() * 0.05**2)
        freed.append(volume.m3)
        error.append(volume.m3 / volume.sigma_m3)
    print(
        f"over-dug m³: plain {np.mean(plain):.4f}, freed {np.mean(freed):.4f}, truth 0; in sigmas {np.mean(error):.2f}"
    )
    assert np.mean(freed) < 0.5 * np.mean(plain)
    assert np.sqrt(np.mean(np.square(error))) < 1.5


def test_soil_that_was_only_passed_over_is_left_down_to_where_the_edge_was(trench):
    found, _ = of(trench, trench.passes([51.0]))
    job = by_kind(found.job)
    assert job[CUT].m3 == 0.0
    assert job[LEFT].m3 == pytest.approx(4 * 2.0 + 6 * 1.0, abs=0.25)
    assert found.not_reached_m3 == pytest.approx(job[LEFT].m3)


def test_side_slopes_are_followed_up_to_the_ground(trench):
    flared = ProfileDesign("d", np.array([0.0, 10.0]), np.full(2, 50.0), np.full(2, 1.0), np.full(2, 0.5))
    found, _ = of(trench, trench.passes([53.0]), design=flared)
    # Between floor and ground a prism of 1 m at the bottom and 3 m at the top; the edge flew above the ground.
    assert by_kind(found.job)[LEFT].m3 == pytest.approx(10 * (1.0 + 3.0) / 2 * 2.0, rel=0.01)


@pytest.mark.parametrize("run", [0.25, 0.5, 1.0])
def test_a_trapezoid_that_was_cut_to_its_slopes_keeps_its_volume(trench, run):
    """Floor 1 m, 1.5 m deep, sides cut along the design: the floor's side is no end of what was cut."""
    flared = ProfileDesign("d", np.array([0.0, 10.0]), np.full(2, 50.0), np.full(2, 1.0), np.full(2, run))
    ground = Ground(LevelGround(51.5), 0.0)
    count, columns = 60, np.arange(-0.475 - 1.5, 0.475 + 1.51, 0.05)
    columns = columns[np.abs(columns) < 0.5 + 1.5 * run]
    height = 50.0 + np.maximum(np.abs(columns) - 0.5, 0.0) / run
    t = np.concatenate([k * 7 + np.arange(count) / 20 for k in range(len(columns))])
    edge = trench.edge(
        t,
        np.tile(np.linspace(2, 8, count), len(columns)),
        np.repeat(columns, count),
        np.repeat(height, count),
        width=0.04,
    )
    found, built = of(trench, edge, ground, flared)
    assert built.cut[60].sum() >= len(columns) - 2
    whole = 6.0 * (1.0 + 1.5 * run) * 1.5
    print(f"run {run}: cut {by_kind(found.job)[CUT].m3:.3f} m³, closed form {whole:.3f}")
    assert by_kind(found.job)[CUT].m3 == pytest.approx(whole, rel=0.025)


def test_left_and_right_are_alike_and_a_design_beyond_the_stations_is_not_counted(trench):
    flared = ProfileDesign("d", np.array([0.0, 500.0]), np.full(2, 50.0), np.full(2, 1.0), np.full(2, 0.5))
    both = trench.passes([50.0], sigma=0.001)
    found, built = of(trench, both, design=flared)
    path = path_along(both, trench.alignment)
    rows = sides(path, built, flared, STATION, 0.5).rows
    wider = replace(rows, outward=np.full_like(rows.outward, 0.02))
    strips = _strips(built, np.full(built.h.shape, 52.0), wider)
    np.testing.assert_allclose(strips.left_m3[:, 0], strips.left_m3[:, 1], atol=1e-6)
    # The design goes on for 500 m, the alignment and its stations end at 10.25: nobody digs the rest.
    prism = (1.0 + 0.5 * 2.0) * 2.0
    assert by_kind(found.job)[LEFT].m3 < 10.6 * prism


def test_ground_that_ends_inside_the_trench_is_told(trench):
    class Half:
        def elevation(self, station, offset):
            return np.where(station + 0 * offset < 5.0, 52.0, np.nan)

    found, _ = of(trench, trench.passes([50.0]), Ground(Half(), 0.01))
    assert found.groundless_m2 > 2.0
    assert of(trench, trench.passes([50.0]))[0].groundless_m2 == 0.0


def test_stations_add_up_to_the_job_and_what_is_in_between_ends_with_the_digging(trench):
    # Dug from 2 to 8 of ten metres: the ends are left, by station as by job.
    found, _ = of(trench, trench.passes([50.0]))
    for k, volume in enumerate(found.job):
        assert sum(parts[k].m3 for parts in found.of_station) == pytest.approx(
            volume.m3, rel=1e-3, abs=1e-3
        ), volume.kind
    assert found.of_station[1][1].m3 == pytest.approx(0.5 * 1.0 * 2.0, rel=1e-2)
    assert found.uncut_m2 == 0.0
