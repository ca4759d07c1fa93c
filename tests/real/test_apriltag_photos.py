"""Outdoor photographs with corners that AprilTag's own program wrote (pixel centres at 0.5, its corner order).

Its program decodes before it refines edges, and the corners on file are those of the quads as they were found: 0.000 px
from what the library finds without refinement in the middle, 0.2 px from what it finds with.
"""

import re

import cv2
import numpy as np
import pyapriltags
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares

from pipeline import tables
from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import judge
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.decode import decode_grey
from pipeline.detection.refine import Refiner
from pipeline.detection.seen import search
from pipeline.errors import DetectionError
from pipeline.logs.writer import LogWriter
from pipeline.runs import RunFolder
from pipeline.stages import detect, ingest, stage_named
from pipeline.stages.job import Job, describe, named_files

pytestmark = pytest.mark.real

PHOTOS = {"33369213973_9d9bb4cc96_c": 12, "34085369442_304b6bafd9_c": 25, "34139872896_defdb2f8d9_c": 10}
OURS_IN_THEIRS = [1, 0, 3, 2]
START = 1_700_000_000_000_000_000


def photo(real_data, name):
    return (real_data / "apriltag_photos" / "test" / "data" / f"{name}.jpg").read_bytes()


def corners_on_file(real_data, name):
    """(n, 4, 2) px in our order and origin."""
    path = real_data / "apriltag_photos" / "test" / "data" / f"{name}.txt"
    numbers = [
        [float(word) for word in re.findall(r"[-\d.]+", line)[1:]] for line in path.read_text().splitlines()
    ]
    theirs = np.array([row for row in numbers if len(row) == 8]).reshape(-1, 4, 2)
    return theirs[:, OURS_IN_THEIRS] - 0.5


def tags_of(real_data, name):
    """Corners on file, ours refined, and what reason ours leave with; (n, 4, 2), (n, 4, 2), (n,), and all seen."""
    grey = decode_grey(photo(real_data, name), "jpeg")
    seen = search(grey, TagFinder(["tag36h11"]), Refiner())
    theirs = corners_on_file(real_data, name)
    assert len(theirs) == PHOTOS[name]
    rows = [int(np.argmin(np.abs(seen.uv - corners).max(axis=(1, 2)))) for corners in theirs]
    assert len(set(rows)) == len(rows)
    return theirs, seen.uv[rows], seen.reason[rows], seen


def test_all_47_tags_are_found_where_their_files_say(real_data):
    """One of 11 px that the files do not list may come on top, read with two corrected bits: it has the same id."""
    differences = []
    for name in PHOTOS:
        found = TagFinder(["tag36h11"]).find(decode_grey(photo(real_data, name), "jpeg"))
        assert set(found.tag_id) == {0}
        assert len(found) <= PHOTOS[name] + 1
        theirs = corners_on_file(real_data, name)
        nearest = [found.uv[np.argmin(np.abs(found.uv - corners).max(axis=(1, 2)))] for corners in theirs]
        differences.append(np.array(nearest) - theirs)
    off = np.abs(np.concatenate(differences))
    print(f"{len(off)} tags: median {np.median(off):.3f} px, largest {off.max():.2f} px")
    assert len(off) == 47
    assert np.median(off) < 0.15
    assert off.max() < 1.0


def test_46_tags_stand_refined_and_the_bulging_one_does_not(real_data):
    """The corners on file are the library's own, before any fit: they are good to some tenths of a pixel.

    What differs from them by more than 0.15 px in the middle is no error of ours: the next test asks a third. One print
    is glued to a face that bulges: from 200 starts around it no homography left less than 9 % of the contrast.
    """
    ours, edges, reasons = [], [], []
    for name in PHOTOS:
        theirs, refined, reason, _ = tags_of(real_data, name)
        ours.append(refined - theirs)
        reasons += reason.tolist()
        grey = decode_grey(photo(real_data, name), "jpeg")
        library = pyapriltags.Detector(families="tag36h11", quad_decimate=1.0, refine_edges=1).detect(grey)
        quads = np.array([tag.corners[OURS_IN_THEIRS] - 0.5 for tag in library])
        edges += [quads[np.argmin(np.abs(quads - corners).max(axis=(1, 2)))] - corners for corners in theirs]
    off, fitted = np.abs(np.concatenate(ours)), np.abs(np.array(edges))
    near = fitted.max(axis=(1, 2)) < 5  # the tag it loses has another one as its nearest
    print(
        f"from the corners on file: ours median {np.median(off):.3f} px, largest {off.max():.2f} px, "
        f"the library's fitted edges median {np.median(fitted[near]):.3f} px, largest {fitted[near].max():.2f} px"
    )
    assert [k for k, reason in enumerate(reasons) if reason] == [9]
    assert reasons[9] in ("does not fit", "covered")
    assert np.median(off) < 0.35
    # One tag lies flat on the ground, 33 px by 7: along its sharp angles the file is 3.5 px from the dense fit below.
    assert off.max() < 4.5


SUPERSAMPLES = 5


def dense_fit(grey, uv, steps=12):
    """Corners (4, 2) at which a plain rendering of tag 0 is nearest to the picture, started from some (4, 2).

    Five samples a pixel each way, one Gaussian, black and white that each change linearly over the tag; nothing of it
    is shared with the refinement. A camera's response is not modelled.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    cells = np.pad(cv2.aruco.generateImageMarker(dictionary, 0, 8) > 127, 1, constant_values=True)
    square = np.array([[1, 1], [9, 1], [9, 9], [1, 9]], np.float32)
    low = np.floor(uv.min(axis=0) - 6).astype(int).clip(0)
    high = np.minimum(np.ceil(uv.max(axis=0) + 7).astype(int), grey.shape[::-1])
    (width, height), fine = high - low, SUPERSAMPLES

    def places(corners, across):
        """Where points of the picture, `across` of them a pixel, lie on the print, in cells."""
        to_print = cv2.getPerspectiveTransform(corners.astype(np.float32), square).astype(float)
        x = (np.arange(width * across) + 0.5) / across - 0.5 + low[0]
        y = (np.arange(height * across) + 0.5) / across - 0.5 + low[1]
        points = np.stack([*np.meshgrid(x, y), np.ones((height * across, width * across))])
        s, t, w = np.einsum("ij,jkl->ikl", to_print, points)
        return s / w, t / w

    s, t = places(uv, 1)
    used = (s > 0.2) & (s < 9.8) & (t > 0.2) & (t < 9.8)
    light = np.stack([np.ones_like(s), s - 5, t - 5])[:, used]
    values = grey[low[1] : high[1], low[0] : high[0]].astype(float)[used]

    def residuals(parameters):
        s, t = places(uv + parameters[:8].reshape(4, 2), fine)
        white = cells[np.floor(t).astype(int).clip(0, 9), np.floor(s).astype(int).clip(0, 9)].astype(float)
        white = gaussian_filter(white, fine * np.exp(parameters[8]), mode="nearest")
        white = white.reshape(height, fine, width, fine).mean(axis=(1, 3))[used]
        columns = np.concatenate([light, light * white]).T
        return columns @ np.linalg.lstsq(columns, values, rcond=None)[0] - values

    def jacobian(parameters):
        # Samples jump from cell to cell: steps must be wider than they are apart.
        return np.stack(
            [(residuals(parameters + 0.15 * e) - residuals(parameters - 0.15 * e)) / 0.3 for e in np.eye(9)],
            axis=1,
        )

    start = np.append(np.zeros(8), np.log(0.7))
    fit = least_squares(residuals, start, jacobian, max_nfev=steps, x_scale=1.0)
    return uv + fit.x[:8].reshape(4, 2)


def test_a_dense_fit_of_other_making_agrees_with_ours_more_than_with_the_files(real_data):
    """Every sixth of the 47 tags, and of each photograph the one that is furthest from its file."""
    signed, from_file = [], []
    for name in PHOTOS:
        grey = decode_grey(photo(real_data, name), "jpeg")
        theirs, ours, _, _ = tags_of(real_data, name)
        furthest = int(np.argmax(np.abs(ours - theirs).max(axis=(1, 2))))
        for k in sorted({*range(0, len(theirs), 6), furthest}):
            arbiter = dense_fit(grey, theirs[k])
            signed.append(ours[k] - arbiter)
            from_file.append(np.abs(theirs[k] - arbiter))
    from_ours, bias = np.abs(signed), np.median(signed, axis=(0, 1))
    for k, (here, there) in enumerate(zip(from_ours, from_file)):
        print(
            f"tag {k}: ours {np.median(here):.3f} (largest {here.max():.2f}), on file {np.median(there):.3f} px"
        )
    mine, files = np.median(from_ours), np.median(from_file)
    print(
        f"{len(from_ours)} tags, from the dense fit: ours {mine:.3f} px, on file {files:.3f} px in the median"
    )
    assert mine < 0.5 * files
    print(f"ours from the dense fit along u and v: {bias[0]:+.3f} {bias[1]:+.3f} px in the median")
    assert np.max(from_ours) < 0.2 * np.max(from_file)
    # A mistaken origin of the pixels would be half of one.
    assert np.abs(bias).max() < 0.05


@pytest.mark.parametrize("name", PHOTOS)
def test_many_tags_of_one_id_are_all_refused(real_data, name):
    settings = DetectionSettings()
    *_, seen = tags_of(real_data, name)
    status = judge(seen, {"tag36h11": {0}}, settings)
    assert "accepted" not in status.tolist()


class Watch:
    def total(self, amount, unit=""):
        pass

    def advance(self, amount=1):
        pass

    def warn(self, sentence):
        pass


def photo_job(real_data, folder, marker_id):
    """A log of the photographs, three cameras of one frame each, and a machine whose marker has a given id."""
    log = folder / "photos.mcap"
    sizes = {}
    with LogWriter(log) as writer:
        for number, name in enumerate(PHOTOS):
            data = photo(real_data, name)
            sizes[f"c{number}"] = decode_grey(data, "jpeg").shape[::-1]
            for k in range(3):
                writer.image(f"/c{number}/image", START + k * 100_000_000, f"c{number}", data)
    pose = "xyz_m = [0, 0, 0], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.1"
    cameras = "".join(
        f'[cameras.{name}]\ntopic = "/{name}/image"\nbody = "cab"\nmount = {{ {pose} }}\n'
        f"intrinsics = {{ width = {width}, height = {height}, fx = 800, fy = 800, cx = {width / 2}, cy = {height / 2}, "
        "sigma = [1, 1, 1, 1, 0, 0, 0, 0, 0] }\n"
        for name, (width, height) in sizes.items()
    )
    (folder / "machine.toml").write_text(
        'format = "gradetrace/machine/1"\n[machine]\nid = "M"\n[bodies.cab]\nkind = "moving"\n[bodies.bucket]\n'
        f'kind = "moving"\n{cameras}[markers.plate]\nbody = "bucket"\nfamily = "tag36h11"\n'
        f"tags = [{{ id = {marker_id}, size_m = 0.2 }}]\nmount = {{ {pose} }}\n"
        f'[cutting_edge]\nbody = "bucket"\nwidth_m = 1\nmount = {{ {pose} }}\n'
    )
    (folder / "site.toml").write_text(
        'format = "gradetrace/site/1"\n[site]\nid = "S"\n[grid]\nunit = "m"\norigin = [0, 0, 0]\n'
        '[benchmarks.b]\nfamily = "tag36h11"\ntags = [{ id = 5, size_m = 0.2 }]\n'
        "pose = { enh = [1, 2, 3], rpy_deg = [0, 0, 0], sigma_mm = 2, sigma_deg = 0.1 }\n"
        '[alignment]\npoints = [[0, 0], [0, 10]]\n[design]\nfile = "design.csv"\nkind = "profile_csv"\n'
        "[tolerance]\nhigh_mm = 25\nlow_mm = 25\n"
    )
    (folder / "design.csv").write_text("station,elevation,width,side_slope\n0,0,1,0\n10,0,1,0\n")
    machine, machine_source, site, site_source = describe(log)
    run = RunFolder(folder / "runs")
    run.create()
    return Job(
        log=log, log_sha256="0", folder=run, machine=machine, site=site, machine_source=machine_source,
        site_source=site_source, files=named_files(site, site_source, run), workers=1,
    )  # fmt: skip


def test_a_log_of_the_photographs_goes_through_ingest_and_its_duplicates_are_refused_and_counted(
    real_data, tmp_path
):
    job = photo_job(real_data, tmp_path, marker_id=0)
    assert ingest.run(job.at(stage_named("ingest"), "f" * 64), Watch())["frames"] == {
        "c0": 3,
        "c1": 3,
        "c2": 3,
    }
    with pytest.raises(
        DetectionError, match=r"no marker could be accepted \(.*twice in one frame \d+"
    ) as said:
        detect.run(job.at(stage_named("detect"), "f" * 64), Watch())
    print(said.value)
    for name, count in zip(("c0", "c1", "c2"), PHOTOS.values()):
        columns = tables.read_table(job.folder.file(f"detections/{name}.parquet"), "detections")
        assert set(columns["tag_id"]) == {0}
        assert "accepted" not in set(columns["status"])
        assert np.sum(columns["frame"] == 0) >= count - 1


def test_a_log_of_photographs_with_other_ids_says_what_was_seen(real_data, tmp_path):
    job = photo_job(real_data, tmp_path, marker_id=3)
    ingest.run(job.at(stage_named("ingest"), "f" * 64), Watch())
    with pytest.raises(
        DetectionError, match="seen that nothing describes: tag36h11 id 0; described are tag36h11 ids 3, 5"
    ):
        detect.run(job.at(stage_named("detect"), "f" * 64), Watch())
