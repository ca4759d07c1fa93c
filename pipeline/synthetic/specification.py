"""What a synthetic site is made of: dimensions, cameras, boards, sensors, sigmas, plan of the work.

Lengths in metres, angles in degrees, as a person would write them down. Directions in the plan: a *station*
runs along the alignment, an *offset* is positive to its left. The machine faces back along the alignment
(towards lower stations), digs towards itself and retreats to higher stations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from pipeline.synthetic.touch_plan import TouchPlan


@dataclass(frozen=True)
class CameraPlan:
    """A camera on the cab."""

    name: str
    topic: str
    position: tuple[float, float, float]
    """In the cab frame: x forward along the arm, y left, z up from the ground."""
    yaw_deg: float
    """Direction it looks in, 0 along the arm, positive to the left."""
    pitch_deg: float
    """Positive looks up."""
    roll_deg: float = 0.0
    distortion: tuple[float, float, float, float, float] = (-0.022, 0.008, 0.0003, -0.0002, 0.0)
    stamp_delay_ms: float = 0.0
    """Against the first camera: they run freely and do not fire at the same instant."""


@dataclass(frozen=True)
class BoardPlan:
    """A board of square tags, counted from the top left, row by row."""

    name: str
    first_id: int
    rows: int
    columns: int
    tag_m: float
    gap_m: float
    margin_m: float = 0.05


@dataclass(frozen=True)
class BenchmarkPlan:
    """A board on posts beside the trench."""

    board: BoardPlan
    station: float
    """Relative to the middle of the machine's travel, plus towards higher stations."""
    offset: float
    height: float
    """Of its centre above the ground."""
    turn_deg: float = 0.0
    """Turned away from facing the alignment squarely, about the vertical."""
    lean_deg: float = 0.0
    """Leaning back."""
    roll_deg: float = 0.0
    """Hung askew, counter-clockwise for who looks at it. Edges along the rows of pixels all err alike."""


@dataclass(frozen=True)
class SensorPlan:
    """A sensor on the bucket joint."""

    name: str
    topic: str
    kind: str
    """``potentiometer`` (volts, cylinder length, four-bar linkage), ``encoder`` (radians in JointStates) or
    ``card`` (counts of a rotary encoder card, own small message)."""
    message: str
    encoding: str
    rate_hz: float = 20.0
    noise: float = 0.0025
    step: float = 5.0 / 4095.0
    """Quantisation, raw unit."""
    time_offset_s: float = 0.020
    sigma_time_offset_s: float = 0.002
    jitter_s: float = 0.0008


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations that the files state, and from which their errors are drawn."""

    camera_mm: float = 1.0
    camera_deg: float = 0.01
    focal_px: float = 0.5
    centre_px: float = 0.25
    distortion: tuple[float, float, float, float, float] = (0.002, 0.006, 0.0001, 0.0001, 0.0)
    benchmark_mm: float = 1.0
    benchmark_deg: float = 0.02
    marker_mm: float = 0.8
    marker_deg: float = 0.015
    axis_mm: float = 0.6
    axis_deg: float = 0.03
    linkage_mm: float = 0.25
    horn_deg: float = 0.03
    curve_zero: float = 0.0003
    """Metres of cylinder, or degrees for a sensor of angle (times 200)."""
    curve_scale: float = 0.00015
    """Metres per volt; for a sensor of angle relative."""
    tool_mm: float = 1.0
    tool_deg: float = 0.1
    shot_mm: float = 2.0


@dataclass(frozen=True)
class Arm:
    """The planar arm: boom foot in the cab frame, lengths between pins, tip of the teeth."""

    foot: tuple[float, float] = (0.35, 1.70)
    """x and z of the boom foot in the cab frame."""
    boom_m: float = 4.60
    stick_m: float = 2.45
    bucket_m: float = 1.25
    """Bucket pin to the cutting edge."""
    teeth_deg: float = -42.0
    """Direction of the teeth against pin-to-edge, in the plane of the arm."""
    width_m: float = 1.0
    linkage: tuple[float, ...] = (-1.55, 0.30, -0.28, 0.0, 0.46, 0.40, 0.32, 130.0)
    """Anchor x y, pivot x y, rocker, coupler, horn (m) and direction of the horn (deg)."""
    linkage_side: int = 1


@dataclass(frozen=True)
class Trench:
    """The design and what the operator makes of it."""

    rows: tuple[tuple[float, float], ...]
    """Station and elevation of the design floor, metres above the ground's datum (world z)."""
    side_slope: float = 0.5
    dug: tuple[tuple[float, float, float], ...] = ()
    """Stretches deliberately dug off the design: from, to (stations relative to the first cut), deviation mm."""


@dataclass(frozen=True)
class UtilityPlan:
    """A straight buried line that crosses the trench."""

    name: str
    kind: str
    station: float
    """Where it crosses the alignment, metres."""
    axis: float
    """World z of its axis there, metres."""
    fall: float
    """Per metre to the left of the alignment."""
    radius_mm: float
    sigma_mm: tuple[float, float]
    """Of its place, horizontal and vertical."""
    clearance_mm: float = 500.0
    reach_m: float = 8.0
    """How far the plan shows it on either side."""


@dataclass(frozen=True)
class Specification:
    """One site, one machine, one job."""

    name: str
    title: str
    machine_id: str
    unit: str
    origin: tuple[int, int, int]
    """Grid unit."""
    grid_name: str
    start: tuple[float, float]
    """First point of the alignment in the world, metres."""
    bearing_deg: float
    """Of the alignment, counter-clockwise from east."""
    start_station: float
    """Metres."""
    length_m: float
    ground: float
    """World z of the ground, metres."""
    trench: Trench
    family: str
    cameras: tuple[CameraPlan, ...]
    benchmarks: tuple[BenchmarkPlan, ...]
    stick_board: BoardPlan
    stick_marker: tuple[float, float, float]
    """Centre of the stick board in the stick frame."""
    stick_marker_turn_deg: float
    """Angle of its normal out of the plane of the arm, to the left."""
    stick_marker_tilt_deg: float
    """Of its normal in the plane of the arm, from the belly of the stick towards the boom."""
    sensors: tuple[SensorPlan, ...]
    utilities: tuple[UtilityPlan, ...] = ()
    width: int = 640
    height: int = 480
    focal: float = 850.0
    rate_hz: float = 5.0
    cycles: int = 4
    step_m: float = 1.0
    """Tramming between cycles."""
    sweep_m: float = 2.9
    """Length of one sweep of the edge along the floor."""
    swing_deg: float = 58.0
    control_swing_deg: float = 14.0
    """Where the control point lies; the benchmarks must still be in view."""
    first_station: float = 106.0
    """Where the first sweep begins to cut."""
    axis_reach: float = 6.75
    """Distance of that point from the swing axis."""
    shake_m: tuple[float, float, float] = (0.0022, 0.0015, 0.0022)
    """Shaking of the cab while it cuts, standard deviation along its axes, metres."""
    shake_rad: tuple[float, float, float] = (0.0009, 0.0013, 0.0005)
    """About its axes, radians."""
    start_utc_ns: int = 1_750_000_000_000_000_000
    arm: Arm = Arm()
    sigmas: Sigmas = Sigmas()
    tolerance_mm: tuple[float, float] = (30.0, 30.0)
    design_kind: str = "profile_csv"
    noise: float = 1.2
    """Standard deviation of the picture's noise at mid grey, grey levels."""
    blur_px: float = 0.6
    jpeg_quality: int = 75
    sensor_note: str = ""
    motion: dict[str, tuple[float, float]] = field(
        default_factory=lambda: {"cab": (0.045, 0.01), "stick": (0.12, 0.01), "bucket": (0.12, 1.0)}
    )
    """Spectral densities of white-noise acceleration by body, for machine.toml; measured on the motion itself: what
    interpolation between frames misses while digging."""
    touches: TouchPlan | None = None
    """Instead of digging: the bucket is set on a stake."""
    size_free: bool = True
    """Whether its cameras may be had with other numbers of pixels."""

    @property
    def side(self) -> float:
        """1 if the benchmarks stand to the left of the alignment (right of the machine), -1 if to its right."""
        return 1.0 if self.benchmarks[0].offset > 0 else -1.0

    def scaled(self, width: int, height: int, focal: float) -> Specification:
        """The same site seen by cameras of another size."""
        return replace(self, width=width, height=height, focal=focal)


def trench() -> Specification:
    """The committed sample: the paper's prototype of Fig. 1 with its 640x480, f = 850 px cameras."""
    return Specification(
        name="trench",
        title="Storm drain, lot 2",
        machine_id="ex-14",
        unit="m",
        origin=(356100, 5812400, 34),
        grid_name="UTM 33N (EPSG:25833), heights DHHN2016",
        start=(31.0, 24.0),
        bearing_deg=28.0,
        start_station=100.0,
        length_m=30.0,
        ground=2.25,
        trench=Trench(
            rows=((100.0, 0.850), (108.0, 0.810), (114.0, 0.750), (130.0, 0.670)),
            dug=((0.9, 1.9, 50.0), (2.9, 3.9, -45.0), (4.6, 5.2, 27.0)),
        ),
        family="tag36h11",
        cameras=(
            CameraPlan("bench", "/cab/bench/image", (0.55, 0.80, 2.45), -92.6, -4.0, stamp_delay_ms=0.0),
            CameraPlan(
                "arm",
                "/cab/arm/image",
                (0.70, 0.95, 2.30),
                -4.0,
                -5.5,
                distortion=(-0.03, 0.012, -0.0002, 0.0003, 0.0),
                stamp_delay_ms=63.0,
            ),
        ),
        benchmarks=(
            BenchmarkPlan(BoardPlan("bm-near", 10, 2, 2, 0.34, 0.07), 0.1, 6.2, 1.05, 12.0, 6.0, 7.0),
            BenchmarkPlan(BoardPlan("bm-west", 20, 2, 2, 0.45, 0.08), -1.75, 9.4, 3.4, -18.0, 0.0, -6.0),
            BenchmarkPlan(BoardPlan("bm-east", 30, 2, 2, 0.45, 0.08), 1.75, 9.9, 1.9, 14.0, 2.0, 5.0),
        ),
        stick_board=BoardPlan("stick-board", 1, 2, 2, 0.26, 0.06, 0.04),
        stick_marker=(0.75, 0.05, -0.55),
        stick_marker_turn_deg=40.0,
        stick_marker_tilt_deg=18.0,
        sensors=(
            SensorPlan("bucket-pot", "/bucket/potentiometer", "potentiometer", "sensor_sample", "protobuf"),
        ),
        utilities=(UtilityPlan("gas-main", "gas", 107.4, 0.230, -0.004, 80.0, (60.0, 30.0)),),
    )


BLOCK_CYCLES = 4
"""As many cycles as one group of benchmarks stays in view for."""
GROUP_IDS = 30
MAX_GROUPS = 18


def lengthened(spec: Specification, cycles: int) -> Specification:
    """The same site worked on for longer: more trench, and a group of benchmarks for every few metres of it.

    What is dug off the design repeats. Once the tags' ids run out, the machine moves on more slowly.
    """
    if cycles <= BLOCK_CYCLES:
        return replace(spec, cycles=cycles)
    travel = min(cycles, BLOCK_CYCLES * MAX_GROUPS) * spec.step_m
    step = travel / cycles
    block = BLOCK_CYCLES * spec.step_m
    middle = 0.5 * (cycles - 1) * step
    benchmarks = []
    for group in range(math.ceil(travel / block - 1e-9)):
        here = 0.5 * (BLOCK_CYCLES - 1) * spec.step_m + group * block - middle
        for plan in spec.benchmarks:
            first_id = plan.board.first_id + group * GROUP_IDS
            board = replace(plan.board, name=f"{plan.board.name}-{group + 1}", first_id=first_id)
            benchmarks.append(replace(plan, board=board, station=plan.station + here))
    period = 6.0
    repeats = range(math.ceil(travel / period) + 1)
    dug = tuple((a + k * period, b + k * period, mm) for k in repeats for a, b, mm in spec.trench.dug)
    length = max(spec.length_m, travel + 24.0)
    rows = spec.trench.rows
    slope = (rows[-1][1] - rows[-2][1]) / (rows[-1][0] - rows[-2][0])
    if (end := spec.start_station + length) > rows[-1][0]:
        rows = (*rows, (end, rows[-1][1] + slope * (end - rows[-1][0])))
    return replace(
        spec,
        cycles=cycles,
        step_m=step,
        benchmarks=tuple(benchmarks),
        trench=replace(spec.trench, rows=rows, dug=dug),
        length_m=length,
    )


def other() -> Specification:
    """Another machine on another job, described by its two files alone: nothing in it is as on the first site.

    Other names, 800x600 pixels, tag25h9, a benchmark more, no potentiometer but two angle sensors (JointStates in
    JSON and an encoder card in the house's own message), benchmarks to the left of the machine, US survey feet.
    """
    foot = 1200.0 / 3937.0
    return Specification(
        name="other",
        title="Water main, section 7",
        machine_id="hx-220",
        unit="us_survey_foot",
        origin=(512345, 4123456, 818),
        grid_name="local grid, NAVD88",
        start=(0.678 * foot, 0.789 * foot),
        bearing_deg=-118.0,
        start_station=1000.0 * foot,
        length_m=24.0,
        ground=2.40,
        trench=Trench(
            rows=((304.0, 1.020), (312.0, 1.050), (332.0, 1.200)),
            side_slope=0.75,
            dug=((0.8, 1.5, 45.0),),
        ),
        family="tag25h9",
        cameras=(
            CameraPlan("stick_cam", "/sensors/stick/compressed", (0.70, 0.95, 2.30), -4.0, -5.5),
            CameraPlan(
                "site_cam",
                "/sensors/site/compressed",
                (0.55, -0.80, 2.45),
                91.0,
                -3.0,
                distortion=(-0.03, 0.01, -0.0001, 0.0004, 0.0),
                stamp_delay_ms=88.0,
            ),
        ),
        benchmarks=(
            BenchmarkPlan(BoardPlan("BM1", 4, 2, 2, 0.34, 0.08), 0.3, -6.4, 1.0, -10.0, 5.0, -6.0),
            BenchmarkPlan(BoardPlan("BM2", 8, 2, 2, 0.45, 0.10), 2.3, -9.6, 3.5, 15.0, 0.0, 5.0),
            BenchmarkPlan(BoardPlan("BM3", 12, 2, 2, 0.45, 0.10), -2.2, -9.9, 2.2, -14.0, 2.0, -8.0),
            BenchmarkPlan(BoardPlan("BM4", 16, 2, 2, 0.45, 0.10), 0.1, -11.0, 3.8, 4.0, 0.0, 7.0),
        ),
        stick_board=BoardPlan("boom_plate", 0, 2, 2, 0.25, 0.07, 0.05),
        stick_marker=(0.75, 0.05, -0.55),
        stick_marker_turn_deg=38.0,
        stick_marker_tilt_deg=18.0,
        sensors=(
            SensorPlan(
                "bucket-encoder",
                "/joints",
                "encoder",
                "joint_states",
                "json",
                rate_hz=25.0,
                noise=0.0008,
                step=0.0002,
                time_offset_s=0.008,
            ),
            SensorPlan(
                "bucket-card",
                "/bucket/card",
                "card",
                "sensor_sample",
                "protobuf",
                noise=0.9,
                step=1.0,
                time_offset_s=-0.015,
            ),
        ),
        width=800,
        height=600,
        focal=1060.0,
        cycles=1,
        swing_deg=-52.0,
        control_swing_deg=5.0,
        first_station=310.2,
        start_utc_ns=1_761_000_000_000_000_000,
        arm=Arm(width_m=0.9),
        tolerance_mm=(25.0, 25.0),
        design_kind="landxml",
        size_free=False,
    )


SITES = {"trench": trench, "other": other}
