"""How far a tag is recognised, beside the paper's Table 1: `make bench-range`.

Frames full of tags at one distance are searched as the pipeline does it: found, refined and judged. Recall over
distance gives the furthest one up to which nine of ten tags are accepted with the right id. Beside it the same for
tags that are followed: looked for around a prediction that is 1.2 px off (standard deviation, and 0.3 px each corner),
refined and with corners within 1 px. Bar: in fair weather (blur 0.6 px, noise 2, contrast 150, JPEG 90) the search
reaches 1.5 times as far as the paper in each of its sixteen rows. The paper does not say what its light was.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace

import numpy as np

from benchmarks import _light
from benchmarks._draws import IDS, follow, refine
from benchmarks._results import keep_result
from benchmarks._tag_picture import Shot, View, compress, shoot
from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import ACCEPTED, judge
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.refine import Refiner
from pipeline.detection.seen import search

BAR = 1.5
RECALL = 0.9
FAMILY = "tag36h11"
CAMERAS = {"640x480": (640, 480, 850.0), "1280x960": (1280, 960, 1731.0)}
TAGS_M = (0.2, 0.3, 0.46, 0.6)
ANGLES_DEG = (0, 45)
PAPER_M = {
    ("640x480", 0): (6.10, 8.23, 13.41, 19.51),
    ("640x480", 45): (4.88, 7.01, 11.28, 16.46),
    ("1280x960", 0): (11.28, 14.94, 25.91, 34.44),
    ("1280x960", 45): (8.84, 11.58, 21.64, 30.48),
}
SIDES_PX = (32, 28, 25, 22, 20, 18.5, 17, 16, 15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5)
WEATHER = {
    "fair": View(blur_px=0.6, noise=2, quality=90, black=40, white=190),
    "poor": View(blur_px=1.0, noise=4, quality=80, black=60, white=140),
}
PITCH_PX = 100
CLOSE_PX = 1.0


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    weather: str
    camera: str
    angle_deg: float
    tag_m: float
    paper_m: float
    search_m: float
    follow_m: float


@dataclass(frozen=True)
class Recall:
    """Tags of one size on a camera."""

    side_px: float
    tags: int
    accepted: int
    """Right id, found, refined, judged."""
    followed: int
    """Refined around a prediction, every corner within a pixel."""
    astray: int
    """Accepted or followed with a corner more than a pixel off, or accepted with a wrong id."""


def frame(
    weather: View, camera: str, angle_deg: float, side_px: float, rng: np.random.Generator
) -> tuple[np.ndarray, list[tuple[View, np.ndarray]], np.ndarray]:
    """A picture full of tags: grey values, each tag's view and corners, and the intrinsics."""
    width, height, focal = CAMERAS[camera]
    lens = (focal, focal, width / 2, height / 2, -0.1, 0.01, 0.0005, -0.0005, 0.0)
    background = _light.texture((height, width), 1, rng)
    light = background.astype(float)
    tags: list[tuple[View, np.ndarray]] = []
    numbers = rng.permutation(IDS[FAMILY])
    for left in range(0, width - PITCH_PX + 1, PITCH_PX):
        for top in range(0, height - PITCH_PX + 1, PITCH_PX):
            centre = np.array([left, top]) + PITCH_PX / 2 + rng.uniform(-4, 4, 2)
            view = replace(
                weather,
                tag_id=int(numbers[len(tags)]),
                side_px=side_px,
                tilt_deg=angle_deg,
                axis_deg=rng.uniform(0, 360),
                roll_deg=rng.uniform(0, 360),
                centre=(float(centre[0]), float(centre[1])),
                lens=lens,
            )
            shot = shoot(view, rng, background=background)
            u0, v0 = np.rint(np.array(lens[2:4]) - shot.intrinsics[2:4]).astype(int)
            rows, columns = (np.arange(n) + at for n, at in zip(shot.clean.shape, (v0, u0)))
            on = (rows >= 0) & (rows < height), (columns >= 0) & (columns < width)
            light[np.ix_(rows[on[0]], columns[on[1]])] = shot.clean[np.ix_(*on)]
            tags.append((view, shot.uv + (u0, v0)))
    grey = np.clip(np.rint(light + rng.normal(0, weather.noise, light.shape)), 0, 255).astype(np.uint8)
    return compress(grey, weather.quality), tags, np.array(lens)


def recall(weather: View, camera: str, angle_deg: float, side_px: float, frames: int, seed: int) -> Recall:
    """How many tags of one size are accepted."""
    settings = DetectionSettings()
    finder = TagFinder([FAMILY], settings)
    known = {FAMILY: set(range(IDS[FAMILY]))}
    total = accepted = followed = astray = 0
    for k in range(frames):
        rng = np.random.default_rng([seed, len(camera), int(angle_deg), int(10 * side_px), k])
        grey, tags, lens = frame(weather, camera, angle_deg, side_px, rng)
        seen = search(grey, finder, Refiner(lens))
        believed = judge(seen, known, settings) == ACCEPTED
        truth = {view.tag_id: uv for view, uv in tags}
        for number, uv in zip(seen.tag_id[believed], seen.uv[believed]):
            if int(number) in truth and np.abs(uv - truth[int(number)]).max() < CLOSE_PX:
                accepted += 1
            else:
                astray += 1
        for view, uv in tags:
            total += 1
            predicted = uv + rng.normal(0, 1.2, 2) + rng.normal(0, 0.3, (4, 2))
            shot = Shot(grey, uv, lens, grey, grey > 0)
            outcome = refine(view, shot, follow(view, shot, predicted, 4.0))
            if outcome.stands:
                close = np.abs(outcome.error).max() < CLOSE_PX
                followed += int(close)
                astray += int(not close)
    return Recall(side_px, total, accepted, followed, astray)


def reach_px(sides: list[float], shares: list[float]) -> float:
    """Side down to which recall holds, from the largest downward; between two sizes on a line."""
    for k, share in enumerate(shares):
        if share < RECALL:
            if k == 0:
                return float("nan")
            part = (RECALL - share) / (shares[k - 1] - share)
            return sides[k] + part * (sides[k - 1] - sides[k])
    return sides[-1]


def main() -> int:
    """Print the tables and the verdict; 1 if a distance is short of the bar."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=72, help="tags per size, at least (default 72)")
    parser.add_argument("--seed", type=int, default=23)
    options = parser.parse_args()
    rows, curves, astray, judged = [], [], 0, 0
    for weather, how in WEATHER.items():
        for camera, (width, height, focal) in CAMERAS.items():
            frames = -(-options.trials // ((width // PITCH_PX) * (height // PITCH_PX)))
            for angle in ANGLES_DEG:
                curve = [recall(how, camera, angle, side, frames, options.seed) for side in SIDES_PX]
                curves += [
                    {"weather": weather, "camera": camera, "angle_deg": angle, **vars(at)} for at in curve
                ]
                astray += sum(at.astray for at in curve)
                judged += sum(at.accepted + at.followed for at in curve)
                search = reach_px(list(SIDES_PX), [at.accepted / at.tags for at in curve])
                window = reach_px(list(SIDES_PX), [at.followed / at.tags for at in curve])
                print(f"{weather} weather, {camera}, {angle} deg: nine of ten down to {search:.1f} px searched, "
                      f"{window:.1f} px followed (side as if it faced the camera)", flush=True)  # fmt: skip
                print("   side px  " + " ".join(f"{at.side_px:5g}" for at in curve))
                print("   searched " + " ".join(f"{at.accepted / at.tags:5.2f}" for at in curve))
                print("   followed " + " ".join(f"{at.followed / at.tags:5.2f}" for at in curve))
                rows += [
                    Row(weather, camera, angle, tag, paper, focal * tag / search, focal * tag / window)
                    for tag, paper in zip(TAGS_M, PAPER_M[camera, angle])
                ]
    print("\nweather  camera     angle   tag m   paper m   searched m   times   followed m   times")
    for row in rows:
        print(
            f"{row.weather:8} {row.camera:9} {row.angle_deg:6g} {row.tag_m:7.2f} {row.paper_m:9.2f} "
            f"{row.search_m:12.1f} {row.search_m / row.paper_m:7.2f} {row.follow_m:12.1f} "
            f"{row.follow_m / row.paper_m:7.2f}"
        )
    times = {
        weather: [row.search_m / row.paper_m for row in rows if row.weather == weather] for weather in WEATHER
    }
    met = all(ratio >= BAR for ratio in times["fair"])
    line = (
        f"range: {min(times['fair']):.2f} to {max(times['fair']):.2f} times as far as the paper in fair weather "
        f"(bar {BAR}), {min(times['poor']):.2f} to {max(times['poor']):.2f} in poor; {astray} of {judged + astray} "
        f"accepted more than {CLOSE_PX:g} px off" + ("" if met else "; MISSED")
    )
    keep_result("range", [*rows, *curves], line)
    print(line)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
