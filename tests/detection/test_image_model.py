"""The camera's image of a print: derivatives against differences, blur against a picture blurred by brute force."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from pipeline.detection import image_model
from pipeline.detection.image_model import (
    AT_END,
    BLUR,
    GROUND,
    PARAMETERS,
    PLACE,
    RESPONSE,
)
from pipeline.detection.straightening import TERMS

NAMES = [
    "offset", "gain", "offset along x", "offset along y", "gain along x", "gain along y",
    *[f"place {k}" for k in range(8)],
    "blur", "blur more along x", "blur along the diagonal", "response",
    *[f"ground {side}" for side in ("left", "right", "above", "below")],
]  # fmt: skip
CELLS = 10
QUIET = 1.0


def a_print(seed: int = 3) -> np.ndarray:
    """(10, 10) random cells in a black border in a white rim."""
    cells = np.ones((CELLS, CELLS))
    cells[1:-1, 1:-1] = 0
    cells[2:-2, 2:-2] = np.random.default_rng(seed).integers(0, 2, (CELLS - 4, CELLS - 4))
    return cells


def seen_from(side_px: float, tilt_deg: float, axis_deg: float, roll_deg: float, centre) -> np.ndarray:
    """(3, 3) pixel -> print in cells, of a print before a pinhole of 1000 px; written out here once more."""
    tilt, axis, roll = np.deg2rad([tilt_deg, axis_deg, roll_deg])
    k = np.array([np.cos(axis), np.sin(axis), 0])
    K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    R = np.eye(3) + np.sin(tilt) * K + (1 - np.cos(tilt)) * K @ K
    R = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]) @ R
    metric = np.column_stack([R[:, 0], R[:, 1], [0, 0, 1000 / side_px]])
    camera = np.array([[1000, 0, centre[0]], [0, 1000, centre[1]], [0, 0, 1.0]])
    cells = np.array([[1 / 8, 0, -5 / 8], [0, 1 / 8, -5 / 8], [0, 0, 1.0]])
    return np.linalg.inv(camera @ metric @ cells)


@dataclass
class Seen:
    """One print before a camera."""

    G: np.ndarray
    blur: tuple[float, float, float]
    """Mean variance, more along x, along the diagonal; px²."""
    shape: tuple[int, int] = (60, 60)
    response: float = 0.0
    light: tuple[float, ...] = (60.0, 120.0, 0.0, 0.0, 0.0, 0.0)
    ground: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    lens: np.ndarray | None = None
    cells: np.ndarray = field(default_factory=a_print)

    def parameters(self) -> np.ndarray:
        par = np.zeros(PARAMETERS)
        par[:PLACE] = self.light
        par[BLUR : BLUR + 3] = self.blur
        par[RESPONSE] = self.response
        par[GROUND:] = self.ground
        return par

    @property
    def norm(self) -> np.ndarray:
        return np.array([0.5 * self.shape[1], 0.5 * self.shape[0], 0.4 * self.shape[1]])

    def linearise(self, par: np.ndarray, G: np.ndarray, grey: np.ndarray | None = None):
        """Place of each pixel used -> its row of the Jacobian, residual and mark."""
        grey = np.full(self.shape, 100, np.uint8) if grey is None else grey
        room = self.shape[0] * self.shape[1]
        J, r, who = np.empty((room, PARAMETERS)), np.empty(room), np.empty((room, 3), np.int32)
        bent = self.lens is not None
        m = image_model.linearise(
            grey, self.cells, len(self.cells), np.zeros(self.cells.shape, bool), False,
            self.lens if bent else np.zeros((TERMS + 2, 2)), bent, G, self.norm, par,
            np.array([0, 0, self.shape[1], self.shape[0]]), 1, 1, QUIET, J, r, who,
        )  # fmt: skip
        return J[:m], r[:m], who[:m]

    def model(self, par: np.ndarray, G: np.ndarray) -> np.ndarray:
        """(H, W) modelled grey values; nan where a pixel is not used."""
        grey = np.full(self.shape, np.nan)
        _, r, who = self.linearise(par, G)
        grey.ravel()[who[:, 2]] = 100 - r
        return grey

    def moved(self, x: np.ndarray) -> np.ndarray:
        """Pixel -> print after the print went by a step of the eight, in the window's own coordinates."""
        into = np.array(
            [[1, 0, -self.norm[0]], [0, 1, -self.norm[1]], [0, 0, self.norm[2]]]
        ) / self.norm[2]  # fmt: skip
        W = np.eye(3) + np.append(x, 0.0).reshape(3, 3)
        return np.linalg.inv(np.linalg.inv(into) @ W @ into @ np.linalg.inv(self.G))


def a_lens() -> np.ndarray:
    """A window's polynomial with bends of up to 2 px."""
    lens = np.zeros((TERMS + 2, 2))
    lens[:TERMS] = np.random.default_rng(1).normal(0, 0.5, (TERMS, 2))
    lens[TERMS], lens[TERMS + 1] = (29, 31), 1 / 30
    return lens


VIEWS = {
    "plain": Seen(seen_from(36, 0, 0, 17, (30.2, 29.7)), (0.7, 0.0, 0.0), response=0.4),
    "oblique": Seen(
        seen_from(48, 60, 40, 10, (30.2, 29.7)),
        (0.6, 0.0, 0.0),
        light=(60, 120, 9, -7, 11, -13),
        ground=(-30, 40, 20, -50),
    ),
    "moved": Seen(
        seen_from(40, 20, 70, 30, (29.6, 30.4)), (1.5, 0.5, -0.7), response=0.3, light=(60, 120, -8, 3, 6, 5)
    ),
    "lens": Seen(seen_from(36, 30, 100, 50, (30.2, 29.7)), (0.8, 0.1, 0.1), response=0.2, lens=a_lens()),
}
STEPS = np.array([1, 1, 1, 1, 1, 1, *[0.003] * 8, 0.03, 0.03, 0.03, 0.05, 1, 1, 1, 1])
"""Small beside the blur, large beside the table of the normal distribution, which is read with straight lines."""


def differences(view: Seen, k: int) -> np.ndarray:
    """(H, W) change of the modelled grey value by one parameter, by central differences.

    The Jacobian carries the print's blur along where the print is turned or stretched, as if the lens were the
    print's: what the blur's share of that is (4 to 8 % of the column) is taken out here for the affine six.
    """
    sides = []
    for sign in (1, -1):
        x = np.zeros(PARAMETERS)
        x[k] = sign * STEPS[k]
        G, par = view.G, view.parameters()
        if PLACE <= k < BLUR:
            G = view.moved(x[PLACE:BLUR])
            A = np.eye(2) + np.array([[x[PLACE], x[PLACE + 1]], [x[PLACE + 3], x[PLACE + 4]]])
            mean, along, across = view.blur
            V = A @ np.array([[mean + along, across], [across, mean - along]]) @ A.T
            par[BLUR : BLUR + 3] = 0.5 * (V[0, 0] + V[1, 1]), 0.5 * (V[0, 0] - V[1, 1]), V[0, 1]
        else:
            par += x
        sides.append(view.model(par, G))
    return (sides[0] - sides[1]) / (2 * STEPS[k])


@pytest.mark.parametrize("name", VIEWS)
def test_jacobian_matches_central_differences(name):
    """RMS of the difference in each column over the RMS of the column, on the pixels near an edge.

    Where the blur's axes are not the print's, the derivatives leave out higher terms of the series than the grey values
    do: 5 % in the place, 23 % in the blur itself. Steps are that much off, not where they end. The last two of
    the place also leave out that the blur, counted in cells, changes over the print.
    """
    view = VIEWS[name]
    skew = name in ("oblique", "moved")
    J, _, who = view.linearise(view.parameters(), view.G)
    near = J[:, BLUR] != 0
    assert near.sum() > 400
    worst = {"light": 0.0, "place": 0.0, "perspective": 0.0, "blur": 0.0}
    for k in range(PARAMETERS):
        numeric = differences(view, k).ravel()[who[:, 2]]
        place = PLACE <= k < BLUR
        kind = "perspective" if place and k >= BLUR - 2 else "place" if place else "light"
        kind = "blur" if BLUR <= k < RESPONSE else kind
        use = np.isfinite(numeric) & (near | (kind == "light") & (k != RESPONSE))
        assert np.mean(use[near]) > 0.9
        error = np.sqrt(np.mean((numeric - J[:, k])[use] ** 2) / np.mean(numeric[use] ** 2))
        worst[kind] = max(worst[kind], error)
        bar = {"light": 1e-6, "place": 0.06 if skew else 0.006, "perspective": 0.12 if skew else 0.09,
               "blur": 0.25 if skew else 0.05}  # fmt: skip
        assert error < bar[kind], (NAMES[k], error)
    print(name, "worst columns:", ", ".join(f"{key} {value:.2g}" for key, value in worst.items()))


FINE = 32


def blurred_by_force(view: Seen, light) -> np.ndarray:
    """(H, W) `light(s, t)` of the print's coordinates, sampled 32 x 32 times a pixel and blurred in the picture."""
    height, width = view.shape
    at = [(np.arange(size * FINE) + 0.5) / FINE - 0.5 for size in (width, height)]
    x, y = np.meshgrid(*at)
    z = view.G[2, 0] * x + view.G[2, 1] * y + view.G[2, 2]
    s, t = ((view.G[k, 0] * x + view.G[k, 1] * y + view.G[k, 2]) / z for k in (0, 1))
    mean, along, across = view.blur
    fx, fy = np.fft.rfftfreq(width * FINE, 1 / FINE)[None], np.fft.fftfreq(height * FINE, 1 / FINE)[:, None]
    spread = (mean + along) * fx**2 + 2 * across * fx * fy + (mean - along) * fy**2
    blurred = np.fft.irfft2(np.fft.rfft2(light(s, t)) * np.exp(-2 * np.pi**2 * spread), x.shape)
    # A pixel's middle lies between four samples.
    middle = FINE // 2 + FINE * np.arange(height)[:, None], FINE // 2 + FINE * np.arange(width)[None]
    return 0.25 * sum(blurred[middle[0] - a, middle[1] - b] for a in (0, 1) for b in (0, 1))


def the_print(view: Seen):
    """Its light at places on it; what lies beyond has the grey of the cell at the rim."""

    def light(s, t):
        column, row = (np.clip(a.astype(int), 0, CELLS - 1) for a in (s, t))
        return view.cells[row, column]

    return light


def correlation_in_the_print(view: Seen) -> float:
    """Correlation of the blur's parts along the two axes of the print, in its middle."""
    h = 0.01

    def place(x, y):
        p = view.G @ [x, y, 1.0]
        return p[:2] / p[2]

    middle = np.linalg.solve(view.G, [CELLS / 2, CELLS / 2, 1.0])
    x, y = middle[:2] / middle[2]
    D = np.column_stack([place(x + h, y) - place(x - h, y), place(x, y + h) - place(x, y - h)]) / (2 * h)
    mean, along, across = view.blur
    V = D @ np.array([[mean + along, across], [across, mean - along]]) @ D.T
    return float(V[0, 1] / np.sqrt(V[0, 0] * V[1, 1]))


BLURRED = {
    "plain": (Seen(seen_from(30, 0, 0, 17, (30.2, 29.7)), (0.7, 0.0, 0.0)), 0.001),
    "small": (Seen(seen_from(16, 30, 80, 40, (30.2, 29.7)), (0.8, 0.0, 0.0)), 0.0015),
    "oblique": (Seen(seen_from(42, 60, 0, 37, (30.2, 29.7)), (0.7, 0.0, 0.0)), 0.0015),
    "oblique across": (Seen(seen_from(42, 60, 45, 20, (30.2, 29.7)), (0.7, 0.0, 0.0)), 0.0045),
    "moved": (Seen(seen_from(36, 0, 0, 17, (29.6, 30.4)), (1.5, 0.5, -0.7)), 0.0045),
}


@pytest.mark.parametrize("name", BLURRED)
def test_blurred_print_is_that_of_a_picture_blurred_by_force(name):
    """Bars: 0.0005 for table and reach of the normal distribution, and what a series cut after its third power leaves.

    That is rho^4 / 24 He3(a)^2 phi(a)^2 at a cell's corner, 0.0016 at correlation 0.6, with what follows 0.002, and
    twice that where four cells meet as on a chessboard. Cut after the second power it would be 0.011.
    """
    view, bar = BLURRED[name]
    modelled = (view.model(view.parameters(), view.G) - 60) / 120
    use = np.isfinite(modelled)
    difference = (modelled - blurred_by_force(view, the_print(view)))[use]
    worst, rms = np.abs(difference).max(), np.sqrt(np.mean(difference**2))
    print(
        f"{name}: correlation {correlation_in_the_print(view):+.2f}, difference at most {worst:.4f}, rms {rms:.5f} "
        f"of the contrast over {use.sum()} pixels"
    )
    assert use.sum() > 250
    assert worst < bar
    assert rms < 0.15 * bar + 0.0002


def test_the_ground_shines_in_as_far_as_blur_carries_it():
    """Light beyond one end of the print, blurred by force, against what the model adds per grey value of ground."""
    view = Seen(seen_from(30, 40, 70, 25, (30.2, 29.7)), (1.0, 0.2, -0.1))
    J, _, who = view.linearise(view.parameters(), view.G)
    beyond = (lambda s, t: s < 0, lambda s, t: s > CELLS, lambda s, t: t < 0, lambda s, t: t > CELLS)
    worst = 0.0
    for k, light in enumerate(beyond):
        truth = blurred_by_force(view, lambda s, t, light=light: light(s, t).astype(float)).ravel()[who[:, 2]]
        assert truth.max() > 0.1
        worst = max(worst, np.abs(J[:, GROUND + k] - truth).max())
    print(f"share of the ground: at most {worst:.4f} off")
    assert worst < 0.0015


@pytest.mark.parametrize("q", [-0.5, 0.25, 0.55])
def test_response_is_the_parabola_through_black_and_white(q):
    """Of a camera's curve only what bends is told: q = 4 R(1/2) - 2; a square root from a black of 4 % has 0.6."""
    linear, bent = (
        Seen(VIEWS["plain"].G, VIEWS["plain"].blur, response=response, light=(50, 160, 0, 0, 0, 0))
        for response in (0.0, q)
    )
    T = (linear.model(linear.parameters(), linear.G) - 50) / 160
    R = (bent.model(bent.parameters(), bent.G) - 50) / 160
    use = np.isfinite(T)
    assert np.abs(R - (T + q * T * (1 - T)))[use].max() < 1e-9
    G, par = bent.G, bent.parameters()
    brightness = np.array(
        [
            image_model.brightness(bent.cells, CELLS, G, float(x), float(y), par, np.empty((5, 26)))
            for y, x in zip(*np.nonzero(use))
        ]
    )
    print(
        f"q {q}: brightness without the series against the model, at most {np.abs(brightness - R[use]).max():.5f}"
    )
    assert np.abs(brightness - R[use]).max() < 1e-3


def test_pixels_at_the_end_of_the_range_tell_nothing_if_the_model_is_there_too():
    view = Seen(VIEWS["plain"].G, (0.7, 0.0, 0.0), light=(-60, 400, 0, 0, 0, 0))
    clean = view.model(view.parameters(), view.G)
    grey = np.where(np.isfinite(clean), np.clip(np.rint(clean), 0, 255), 100).astype(np.uint8)
    J, r, who = view.linearise(view.parameters(), view.G, grey)
    seen, model = grey.ravel()[who[:, 2]], clean.ravel()[who[:, 2]]
    ends = who[:, 1] == AT_END
    assert 300 < ends.sum() < len(ends) - 300
    assert not np.any(J[ends]) and not np.any(r[ends])
    assert np.abs(r[~ends]).max() <= 0.5 + 1e-9
    assert not np.any(((seen == 255) & (model > 254) | (seen == 0) & (model < 0)) & ~ends)
