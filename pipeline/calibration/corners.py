"""Corners of a calibration board in a picture, each with a covariance.

Chessboards and ChArUco boards are found by OpenCV and their corners refined where the grey values' gradients meet
(Foerstner's point, OpenCV's `cornerSubPix`), in a window that ends before the next corner or tag. What the gradients in
it say of the corner, G, gives the shape of the covariance, noise² G^-1: a corner seen at a slant or out of focus counts
less. Tags come from the search and the refinement of the main job, with theirs.
"""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np

from pipeline.calibration.board import APRILTAG, CHARUCO, CHESSBOARD, CalibrationBoard
from pipeline.calibration.views import View, view_of
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.prints import aruco_dictionary
from pipeline.detection.refine import Refiner
from pipeline.geometry import homography

LEAST_CORNERS = 8
"""Of a view; six tell the pose, two are a check."""
SEARCH_PX = 1400
"""Wider pictures are halved for the search of a chessboard; the corners are refined in the full one."""
WINDOW = 0.35
"""Half width of the refinement's window, as a part of the way to the next corner."""
FLOOR_PX = 0.01
"""Standard deviation that no corner is better than: what resampling and compression leave."""
KEPT_FAILURES = 3
SHARE_OFF = 0.04
"""By which a tag's share of its square may seem other than said: half a pixel at either end of a tag of 25 px."""
_SUBPIX = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
_CHESS = cv2.CALIB_CB_NORMALIZE_IMAGE


class CornerFinder:
    """Finds one board in pictures of one camera.

    Parameters
    ----------
    board : CalibrationBoard
    intrinsics : (9,) array or None
        Brown's five, if known already: the edges of tags are straight before the lens bends them.
    """

    def __init__(self, board: CalibrationBoard, intrinsics: np.ndarray | None = None):
        self.board = board
        self.pictures = 0
        """Looked at."""
        self.ids: Counter[int] = Counter()
        """Tags of the board's family that were seen."""
        self._views: list[View] = []
        self._failures: list[np.ndarray] = []
        self._shares: list[float] = []
        """Side of a tag over that of its square, as each picture shows it."""
        self._pattern: list[Counter[int]] = [Counter(), Counter()]
        if board.kind == CHARUCO:
            self._charuco = [_charuco_detector(board, legacy) for legacy in (False, True)]
        elif board.kind == APRILTAG:
            self._tags, self._refiner = TagFinder([board.family]), Refiner(intrinsics)

    def add(self, name: str, grey: np.ndarray) -> bool:
        """Look at a picture, (H, W) uint8; whether the board was found in it."""
        self.pictures += 1
        search = {CHESSBOARD: self._chessboard, CHARUCO: self._charuco_corners, APRILTAG: self._grid}
        view = search[self.board.kind](name, grey)
        if view is None or view.corners < LEAST_CORNERS:
            if len(self._failures) < KEPT_FAILURES:
                self._failures.append(grey)
            return False
        self._views.append(view)
        return True

    @property
    def found(self) -> int:
        """Pictures in which the board was found."""
        return len(self._views)

    def views(self) -> list[View]:
        """All views, in the order of the pictures."""
        return _laid_out(self.board, self._views) if self.board.kind == APRILTAG else list(self._views)

    def instead(self) -> str:
        """A few words on what was seen where the board was not; empty if nothing is known."""
        if self.board.kind == CHESSBOARD:
            sizes = Counter(size for grey in self._failures if (size := _chessboard_size(grey)) is not None)
            sizes.pop((self.board.columns, self.board.rows), None)
            sizes.pop((self.board.rows, self.board.columns), None)
            if sizes:
                columns, rows = sizes.most_common(1)[0][0]
                return f"a chessboard of {columns}x{rows} inner corners is in view"
            return ""
        ids = sorted(self.ids)
        if not ids:
            return f"no tag of {self.board.family} is in view"
        tags = self.board.columns * self.board.rows // (2 if self.board.kind == CHARUCO else 1)
        first, last = self.board.first_id, self.board.first_id + tags - 1
        return (
            f"tags {ids[0]} to {ids[-1]} of {self.board.family} are in view, the board has {first} to {last}"
        )

    def misprint(self) -> str:
        """What the print shows to be other than said; empty where nothing is, or where it has no tags in squares.

        How large a ChArUco board is no picture tells, but how large its tags are beside its squares: with a wrong share
        OpenCV looks for the corners beside where they are.
        """
        if not self._shares:
            return ""
        said, share = self.board.second_m / self.board.square_m, float(np.median(self._shares))
        if abs(share / said - 1) <= SHARE_OFF:
            return ""
        return (
            f"its tags measure {share:.2f} of a square in the pictures, and {said:.2f} by the board {self.board.text}; "
            "measure the sides of a square and of a tag"
        )

    def _chessboard(self, name: str, grey: np.ndarray) -> View | None:
        size = (self.board.columns, self.board.rows)
        halved = max(grey.shape) > SEARCH_PX
        small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) if halved else grey
        found, corners = cv2.findChessboardCornersSB(small, size, flags=_CHESS)
        if not found:
            return None
        uv = corners.reshape(-1, 2).astype(float)
        uv = 2 * uv + 0.5 if halved else uv
        return _refined(name, grey, np.arange(len(uv)), uv, self.board, WINDOW)

    def _charuco_corners(self, name: str, grey: np.ndarray) -> View | None:
        best: tuple[np.ndarray, np.ndarray] | None = None
        # OpenCV changed how boards with an even number of rows begin; the first pictures tell which it is.
        sure = abs(self._pattern[0].total() - self._pattern[1].total()) > 200
        tries = [0, 1] if not sure else [int(self._pattern[1].total() > self._pattern[0].total())]
        for which in tries:
            corners, ids, around, tags = self._charuco[which].detectBoard(grey)
            if which == tries[0] and tags is not None:
                self.ids.update(int(tag) for tag in np.ravel(tags))
            if ids is None or not len(ids):
                continue
            self._pattern[which].update(int(number) for number in np.ravel(ids))
            if best is None or len(ids) > len(best[0]):
                best = np.ravel(ids), corners.reshape(-1, 2).astype(float)
                outlines = np.reshape(around, (-1, 4, 2)).astype(float)
        if best is None or len(best[0]) < LEAST_CORNERS:
            return None
        # The window must not reach into the tags, whose own edges would pull.
        window = min(WINDOW, 0.5 * (1 - self.board.second_m / self.board.square_m))
        view = _refined(name, grey, best[0], best[1], self.board, window)
        if view is not None:
            self._shares.append(_tag_share(self.board, view, outlines))
        return view

    def _grid(self, name: str, grey: np.ndarray) -> View | None:
        found = self._tags.find(grey)
        sure = np.flatnonzero(found.hamming <= 1)
        self.ids.update(found.tag_id[sure].tolist())
        number = found.tag_id[sure] - self.board.first_id
        mine = sure[(number >= 0) & (number < self.board.columns * self.board.rows)]
        # An id that stands twice in a picture is on none of them for certain.
        once = [row for row in mine if np.count_nonzero(found.tag_id[mine] == found.tag_id[row]) == 1]
        if not once:
            return None
        refined = self._refiner.refine(
            grey, found.family[once].tolist(), found.tag_id[once].tolist(), found.uv[once]
        )
        good = np.flatnonzero(refined.reason == "")
        if not len(good):
            return None
        tag = found.tag_id[once][good] - self.board.first_id
        cov = refined.cov[good] + FLOOR_PX**2 * np.eye(8)
        return View(name, 4 * tag[:, None] + np.arange(4), refined.uv[good], cov)


def _tag_share(board: CalibrationBoard, view: View, outlines: np.ndarray) -> float:
    """Side of a tag over that of its square: outlines (n, 4, 2) px laid onto the print by the view's corners."""
    H = homography.from_points(view.uv[:, 0], board.corners_m[view.point[:, 0]][:, :2])
    q = np.concatenate([outlines, np.ones((*outlines.shape[:2], 1))], axis=-1) @ H.T
    on_print = q[..., :2] / q[..., 2:]
    # OpenCV's outline runs through the outermost dark pixels, half a pixel inside of either edge: of a sample's tags of
    # 22 px the share was 0.716 instead of 0.75.
    side, seen_px = (np.linalg.norm(q - np.roll(q, 1, axis=1), axis=-1) for q in (on_print, outlines))
    return float(np.median(side * (1 + 1 / seen_px))) / board.square_m


def _charuco_detector(board: CalibrationBoard, legacy: bool) -> cv2.aruco.CharucoDetector:
    ids = np.arange(board.first_id, board.first_id + board.columns * board.rows // 2)
    drawn = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_m, board.second_m, aruco_dictionary(board.family), ids
    )
    drawn.setLegacyPattern(legacy)
    return cv2.aruco.CharucoDetector(drawn)


def _refined(
    name: str, grey: np.ndarray, point: np.ndarray, uv: np.ndarray, board: CalibrationBoard, window: float
) -> View | None:
    """Corners moved to where gradients meet, with covariances; those that jump or lose their window are left out."""
    p = board.corners_m[point][:, :2]
    if len(point) < 4 or np.linalg.matrix_rank(p - p[0]) < 2:
        return None
    # The way to the next corner, from the homography: beside a corner others may be hidden.
    H = homography.from_points(p, uv)
    near = []
    for step in ((board.square_m, 0), (-board.square_m, 0), (0, board.square_m), (0, -board.square_m)):
        q = np.column_stack([p + step, np.ones(len(p))]) @ H.T
        near.append(np.linalg.norm(q[:, :2] / q[:, 2:] - uv, axis=1))
    half = np.clip(window * np.min(near, axis=0), 2, 12).astype(int)
    noise = _noise(grey)
    kept, corners, covariances = [], [], []
    height, width = grey.shape
    for row, (start, w) in enumerate(zip(uv, half.tolist())):
        if not (w + 2 <= start[0] < width - w - 2 and w + 2 <= start[1] < height - w - 2):
            continue
        # From a patch of its own: OpenCV would go through the whole picture's border for each.
        x0, y0 = int(start[0]) - 2 * w - 4, int(start[1]) - 2 * w - 4
        x0, y0 = max(x0, 0), max(y0, 0)
        patch = grey[y0 : y0 + 4 * w + 9, x0 : x0 + 4 * w + 9]
        at = (start - [x0, y0]).astype(np.float32).reshape(1, 1, 2)
        end = cv2.cornerSubPix(patch, at, (w, w), (-1, -1), _SUBPIX).reshape(2).astype(float)
        if np.linalg.norm(end + [x0, y0] - start) > max(1.5, 0.5 * w):
            continue
        cov = _covariance(patch, end, w, noise)
        if cov is not None:
            kept.append(row)
            corners.append(end + [x0, y0])
            covariances.append(cov)
    if len(kept) < LEAST_CORNERS:
        return None
    return view_of(name, point[kept], np.array(corners), np.array(covariances))


def _covariance(patch: np.ndarray, at: np.ndarray, w: int, noise: float) -> np.ndarray | None:
    """noise² times the inverse of the gradients' outer products in the window; None of a patch without two edges."""
    x, y = round(float(at[0])), round(float(at[1]))
    part = patch[max(y - w - 1, 0) : y + w + 2, max(x - w - 1, 0) : x + w + 2].astype(float)
    if min(part.shape) < 2 * w + 1:
        return None
    gy, gx = np.gradient(part)
    rows, columns = np.mgrid[0 : part.shape[0], 0 : part.shape[1]]
    r2 = (columns - part.shape[1] // 2) ** 2 + (rows - part.shape[0] // 2) ** 2
    weight = np.exp(-r2 / w**2)
    G = np.array([[np.sum(weight * gx * gx), np.sum(weight * gx * gy)], [0.0, np.sum(weight * gy * gy)]])
    G[1, 0] = G[0, 1]
    if np.linalg.eigvalsh(G)[0] < 25 * noise**2:
        return None
    return np.asarray(noise**2 * np.linalg.inv(G) + FLOOR_PX**2 * np.eye(2))


def _noise(grey: np.ndarray) -> float:
    """Standard deviation of the grey values' noise, from second differences along rows; at least 0.5."""
    part = grey[::4].astype(np.int16)
    second = part[:, 2:] - 2 * part[:, 1:-1] + part[:, :-2]
    return max(float(np.median(np.abs(second))) / 0.6745 / np.sqrt(6), 0.5)


def _laid_out(board: CalibrationBoard, views: list[View]) -> list[View]:
    """Views of a grid with the corners where its print has them.

    Grids are printed with the first row of ids on top or at the bottom, and with tags turned half round (as OpenCV
    draws them, or as the AprilTag project does). One homography per view tells which it is.
    """
    p = board.corners_m[:, :2]
    misses = np.zeros(4)
    for view in views[:12]:
        for layout in range(4):
            q = p[_points(board, view.point, layout).ravel()]
            uv = view.uv.reshape(-1, 2)
            H = homography.from_points(q, uv)
            back = np.column_stack([q, np.ones(len(q))]) @ H.T
            miss = np.linalg.norm(back[:, :2] / back[:, 2:] - uv, axis=1)
            misses[layout] += min(float(np.median(miss)), 50.0)
    layout = int(np.argmin(misses))
    return [View(v.name, _points(board, v.point, layout), v.uv, v.cov) for v in views]


def _points(board: CalibrationBoard, point: np.ndarray, layout: int) -> np.ndarray:
    tag, corner = point // 4, point % 4
    row, column = tag // board.columns, tag % board.columns
    if layout % 2:
        row = board.rows - 1 - row
    if layout >= 2:
        corner = (corner + 2) % 4
    return np.asarray(4 * (row * board.columns + column) + corner)


def _chessboard_size(grey: np.ndarray) -> tuple[int, int] | None:
    """Inner corners (columns, rows) of whatever chessboard is in a picture."""
    flags = _CHESS | cv2.CALIB_CB_LARGER
    found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
    return (int(meta.shape[1]), int(meta.shape[0])) if found and meta is not None else None
