"""machine.toml and site.toml of a synthetic site: also the examples a user copies from."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import so3
from pipeline.synthetic.draws import Uncertainty
from pipeline.synthetic.excavator import Mounts, Place, board
from pipeline.synthetic.specification import BoardPlan, SensorPlan, Specification

METRES_PER_UNIT = {"m": 1.0, "international_foot": 0.3048, "us_survey_foot": 1200.0 / 3937.0}


def machine_toml(spec: Specification, mounts: Mounts, sigma: Uncertainty) -> str:
    """Text of machine.toml."""
    s = spec.sigmas
    lines = [
        "# One excavator: what is calibrated once stays with the machine. Lengths are metres, angles degrees,",
        "# sigmas millimetres and degrees; every calibrated quantity says how well it is known.",
        'format = "gradetrace/machine/1"',
        "",
        "[machine]",
        f'id = "{spec.machine_id}"',
        'name = "Tracked excavator, camera cluster on the cab"',
        "",
        "# Bodies. The cab carries the cameras. It and the stick move freely: the cameras find where they are.",
        "# The bucket turns about the z axis of a frame on the stick, which its sensor follows.",
        "[bodies.cab]",
        'kind = "moving"',
        "",
        "[bodies.stick]",
        'kind = "moving"',
        "",
        "[bodies.bucket]",
        'kind = "joint"',
        'parent = "stick"',
        f"axis = {_pose(mounts.axis, s.axis_mm, s.axis_deg)}",
        "",
    ]
    for camera in spec.cameras:
        k = mounts.intrinsics[camera.name]
        lines += [
            "",
            f"[cameras.{camera.name}]",
            f'topic = "{camera.topic}"',
            f'calibration_topic = "{camera.topic.removesuffix("/image")}/calibration"',
            'body = "cab"',
            "# T_body_camera; camera axes are x right, y down, z forward.",
            f"mount = {_pose(mounts.cameras[camera.name], s.camera_mm, s.camera_deg)}",
            "",
            f"[cameras.{camera.name}.intrinsics]",
            f"width = {spec.width}",
            f"height = {spec.height}",
            *[f"{name} = {value:.4f}" for name, value in zip(("fx", "fy", "cx", "cy"), k)],
            f"distortion = {_row(k[4:], 7)}  # k1 k2 p1 p2 k3",
            f"sigma = {_row(sigma.intrinsics, 6)}  # fx fy cx cy k1 k2 p1 p2 k3",
        ]
    lines += [
        "",
        "# The marker on the stick: tags by id, size (outer side of the black border) and centre on the print.",
        f"[markers.{spec.stick_board.name}]",
        'body = "stick"',
        f'family = "{spec.family}"',
        f"mount = {_pose(mounts.stick_marker, s.marker_mm, s.marker_deg)}",
        _tags(spec.stick_board, spec.family),
    ]
    for sensor in spec.sensors:
        lines += ["", *_sensor(spec, sensor, mounts, sigma)]
    lines += [
        "",
        "# The cutting edge: x along it to the operator's right, z along the teeth.",
        "[cutting_edge]",
        'body = "bucket"',
        f"mount = {_pose(mounts.tool, s.tool_mm, s.tool_deg)}",
        f"width_m = {spec.arm.width_m}",
    ]
    if spec.motion:
        lines += ["", "# White-noise acceleration, m^2/s^3 and rad^2/s^3: how lively each body is. Too little smooths",
                  "# real motion away, too much lets the noise through."]  # fmt: skip
    for name, (translation, rotation) in spec.motion.items():
        lines += ["", f"[motion.{name}]", f"translation = {translation}", f"rotation = {rotation}"]
    return "\n".join(lines) + "\n"


def _sensor(spec: Specification, plan: SensorPlan, mounts: Mounts, sigma: Uncertainty) -> list[str]:
    curve, curve_sigma = mounts.curves[plan.name], sigma.curves[plan.name]
    noise = np.hypot(plan.noise, plan.step / np.sqrt(12))
    output = "cylinder_m" if plan.kind == "potentiometer" else "angle_deg"
    lines = [
        f"[sensors.{plan.name}]",
        f'topic = "{plan.topic}"',
    ]
    if plan.message == "joint_states":
        lines += [
            'field = "bucket"  # name of the joint in the message; its position, radians, is the raw reading'
        ]
    lines += [
        'joint = "bucket"',
        f"noise = {noise:.6g}  # of one raw reading, quantisation included",
        f"time_offset_s = {mounts.time_offsets[plan.name]:.5f}  # true time minus stamp",
        f"sigma_time_offset_s = {plan.sigma_time_offset_s}",
        "",
        f"[sensors.{plan.name}.curve]",
        f'output = "{output}"',
        f"coefficients = {_row(curve, 7)}  # c0 + c1 raw + c2 raw^2",
        f"sigma = {_row(curve_sigma, 7)}",
    ]
    if plan.kind == "potentiometer":
        b = mounts.linkage
        lines += [
            "raw_range = [0.3, 4.8]",
            "",
            "# Four-bar linkage from the cylinder to the bucket, in the axis frame of the joint.",
            f"[sensors.{plan.name}.linkage]",
            f"cylinder_anchor_m = {_row(b[0:2], 5)}",
            f"rocker_pivot_m = {_row(b[2:4], 5)}",
            f"rocker_m = {b[4]:.5f}",
            f"coupler_m = {b[5]:.5f}",
            f"horn_m = {b[6]:.5f}",
            f"horn_angle_deg = {np.rad2deg(b[7]):.4f}",
            f"branch = {spec.arm.linkage_side}",
            f"sigma_mm = {spec.sigmas.linkage_mm}",
            f"sigma_horn_angle_deg = {spec.sigmas.horn_deg}",
        ]
    return lines


def site_toml(spec: Specification, mounts: Mounts) -> str:
    """Text of site.toml."""
    unit = METRES_PER_UNIT[spec.unit]
    place = Place(spec)
    ends = [place.point(spec.start_station + d, 0.0, 0.0)[:2] for d in (0.0, spec.length_m)]
    ends = [np.array(spec.origin[:2]) + p / unit for p in ends]
    high, low = spec.tolerance_mm
    lines = [
        "# One job: grid, benchmarks, design, tolerances, check shots. Coordinates are in the grid's own unit.",
        'format = "gradetrace/site/1"',
        "",
        "[site]",
        f'id = "{spec.name}"',
        f'name = "{spec.title}"',
        "",
        "[grid]",
        f'unit = "{spec.unit}"',
        f"origin = [{', '.join(str(v) for v in spec.origin)}]  # whole numbers near the job",
        f'name = "{spec.grid_name}"',
        "",
        "# The boards, as the total station found them: pose of the print (x right, y up, z out of it).",
    ]
    for plan in spec.benchmarks:
        name = plan.board.name
        T = mounts.benchmarks[name]
        enh = np.array(spec.origin) + T[:3, 3] / unit
        pose = (
            f"{{ enh = {_row(enh, 5)}, rpy_deg = {_row(so3.to_rpy_deg(T[:3, :3]), 5)}, "
            f"sigma_mm = {spec.sigmas.benchmark_mm}, sigma_deg = {spec.sigmas.benchmark_deg} }}"
        )
        lines += [
            f"[benchmarks.{name}]",
            f'family = "{spec.family}"',
            f"pose = {pose}",
            _tags(plan.board, spec.family),
            "",
        ]
    lines += [
        "[alignment]",
        "points = [",
        *[f"  {_row(p, 4)}," for p in ends],
        "]",
        f"start_station = {spec.start_station / unit:.4f}",
        "",
        "[design]",
        *(
            ['file = "design.csv"', 'kind = "profile_csv"']
            if spec.design_kind == "profile_csv"
            else ['file = "design.xml"', 'kind = "landxml"', 'surface = "trench"']
        ),
        "",
        "# Deviation = as-built minus design: + is high (under-dug), - is low (over-dug).",
        "[tolerance]",
        f"high_mm = {high}",
        f"low_mm = {low}",
        "",
        "[checks]",
        'file = "checks.csv"',
        'order = "PNEZD"',
        f"sigma_mm = {spec.sigmas.shot_mm}",
        "",
        "[report]",
        f'title = "{spec.title}"',
    ]
    return "\n".join(lines) + "\n"


def afterwards_toml(spec: Specification) -> str:
    """Text that the site.toml beside the log has more than the one inside it: what was found out after the shift."""
    if not spec.utilities:
        return ""
    unit = METRES_PER_UNIT[spec.unit]
    place = Place(spec)
    lines = [
        "",
        "# Entered after the shift, so the log's own copy lacks it: the yard before digging, for volumes.",
        "[ground]",
        f"elevation = {spec.origin[2] + spec.ground / unit:.3f}",
        "sigma_mm = 20.0",
        "",
        "# Buried lines, by the owner's plan and a locator.",
        "# Points run along the axis; sigma is of its place, horizontal and vertical.",
    ]
    for plan in spec.utilities:
        ends = [
            place.point(plan.station, y, plan.axis + plan.fall * y) for y in (-plan.reach_m, plan.reach_m)
        ]
        ends = [np.array(spec.origin) + p / unit for p in ends]
        lines += [
            f"[utilities.{plan.name}]",
            f'kind = "{plan.kind}"',
            "points = [",
            *[f"  {_row(p, 3)}," for p in ends],
            "]",
            f"radius_mm = {plan.radius_mm}",
            f"sigma_mm = {_row(np.array(plan.sigma_mm), 1)}",
            f"clearance_mm = {plan.clearance_mm}",
        ]
    return "\n".join(lines) + "\n"


def _pose(T: np.ndarray, sigma_mm: float, sigma_deg: float) -> str:
    return (
        f"{{ xyz_m = {_row(T[:3, 3], 5)}, rpy_deg = {_row(so3.to_rpy_deg(T[:3, :3]), 4)}, "
        f"sigma_mm = {sigma_mm}, sigma_deg = {sigma_deg} }}"
    )


def _tags(plan: BoardPlan, family: str) -> str:
    made = board(plan, family)
    rows = [
        f"  {{ id = {tag}, size_m = {made.tag_m}, x_m = {x:.4f}, y_m = {y:.4f} }},"
        for tag, (x, y) in zip(made.ids, made.centres)
    ]
    return "\n".join(["tags = [", *rows, "]"])


def _row(values: np.ndarray, digits: int) -> str:
    return "[" + ", ".join(f"{float(value) + 0.0:.{digits}f}" for value in values) + "]"
