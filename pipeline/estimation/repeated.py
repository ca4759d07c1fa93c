"""Errors of corners that come back: what stays with a print, and what stays while nothing moves.

The sigma of a corner tells how far off it is in one picture. In rendered logs of known truth about 0.6 of its variance
is there again in the next picture while the corner stays where it is (JPEG's grid, the pixels' phase), and 0.2 for
ever (the print's own pattern, blur that is no Gaussian, the lens's model). A thousand pictures do not average that
away:

    error = constant (per camera, tag and corner) + one draw per rest (per stay within REACH_PX) + one draw per picture
    variances, in units of the stated one:  kappa,  rho,  the rest

The constant is a static with a prior of its own, so it goes into the common part. The draw per rest takes information
from each of its ``n`` pictures, ``1 / (1 + rho (n - 1))`` of it, Kish's design effect: together they know what one
mean of ``n`` correlated errors knows. Until now 0.04 px of white noise stood for both, 16 times the variance of a
median corner in every picture, and yet averaged away: at ten pictures a second, in three minutes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from pipeline.network.model import Network, Observations, Static

REACH_PX = 1.0
"""A corner that moved by more has another error: residuals of successive pictures then share only the constant
(in a rendered log 0.2 of their variance, at one picture apart as at fifty; while at rest 0.6)."""
SOURCE = "corners"
OFFSET_COMPONENTS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "uv")
MOST = 1e4
"""Of either share: lenses that are wrong by a hundred sigmas of a corner are a fault, not an error."""


@dataclass(frozen=True)
class Repeated:
    """Variances of what repeats, as shares of a corner's stated variance."""

    constant: float = 0.2
    """kappa: the same in all pictures of a tag by a camera."""
    resting: float = 0.4
    """rho: the same while the corner stays within ``REACH_PX``."""


WHITE = Repeated(0.0, 0.0)
"""Nothing repeats: drawn corners of simulations."""


def offset_name(network: Network, camera: int, tag: int) -> str:
    """Name of the static with the constant errors of a tag's corners in a camera."""
    return (
        f"camera {network.cameras[camera].name} tag {network.tag_family[tag]} {network.tag_id[tag]} corners"
    )


def with_offsets(network: Network, observations: Observations, repeated: Repeated) -> Network:
    """The network with the constant errors among its statics, one per camera and tag that met.

    Each has eight components, px: u and v of the four corners, with the share of the median stated variance. Those that
    are among the statics already stay as they are: half of a log has the errors of the whole.
    """
    if repeated.constant <= 0:
        return network
    there = {static.name for static in network.statics if static.source == SOURCE}
    pairs = np.unique(np.stack([observations.camera, observations.tag], axis=1), axis=0)
    offsets = []
    for camera, tag in pairs.tolist():
        name = offset_name(network, camera, tag)
        if name in there:
            continue
        cov = np.median(observations.cov[(observations.camera == camera) & (observations.tag == tag)], axis=0)
        prior = np.zeros((8, 8))
        for k in range(4):
            prior[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = repeated.constant * cov[k]
        offsets.append(Static(name, SOURCE, False, np.zeros(8), prior, OFFSET_COMPONENTS, ("px",) * 8))
    return replace(network, statics=(*network.statics, *offsets))


def rests(observations: Observations):
    """Which stay within ``REACH_PX`` each sighting belongs to.

    A stay ends when a corner is further than that from where it was in the stay's first picture. A tag that is lost and
    found again in the same place is still the same stay: its error is that of the place.

    Returns
    -------
    (n,) int array
        Number of the stay; every camera and tag has its own.
    """
    order = np.lexsort([observations.time_ns, observations.tag, observations.camera])
    track = np.stack([observations.camera, observations.tag], axis=1)[order]
    new = np.ones(len(order), dtype=bool)
    if len(order):
        new[1:] = np.any(track[1:] != track[:-1], axis=1)
    out = np.empty(len(order), dtype=np.int64)
    out[order] = _stays(np.ascontiguousarray(observations.uv[order]), new, REACH_PX)
    return out


@njit(cache=True)
def _stays(uv, new, reach):
    stay, first = -1, 0
    out = np.empty(len(uv), np.int64)
    for i in range(len(uv)):
        moved = new[i]
        if not moved:
            for k in range(4):
                du, dv = uv[i, k, 0] - uv[first, k, 0], uv[i, k, 1] - uv[first, k, 1]
                moved = moved or du * du + dv * dv > reach * reach
        if moved:
            stay += 1
            first = i
        out[i] = stay
    return out


def information_share(stay, repeated: Repeated):
    """Share of its information that each sighting keeps, (n,): ``1 / (1 + rho (n - 1))`` with n that of its stay."""
    count = np.bincount(stay)[stay] if len(stay) else np.zeros(0)
    return 1 / (1 + repeated.resting * (count - 1))


def measured(whitened, track, stay, use) -> Repeated | None:
    """The two shares as products of residuals tell them.

    The mean product of a component's residuals in two pictures of one stay is ``kappa + rho``, in pictures of two
    stays ``kappa``. What the statics and states took up of the errors is missing in it, so it is never believed to be
    less than the rendered logs show.

    Parameters
    ----------
    whitened : (n, 8) array
        Residuals without what the offsets explain of them, in stated sigmas.
    track : (n,) int array
        Camera and tag.
    stay : (n,) int array
        Of ``rests``.
    use : (n, 8) bool array
        What is not rejected.

    Returns
    -------
    Repeated or None
        None where no tag was seen in two stays, or none twice in one.
    """
    r = np.where(use, whitened, 0.0)
    one = use.astype(float)

    def products(key):
        _, at = np.unique(key, return_inverse=True)
        total, count = np.zeros((at.max() + 1, 8)), np.zeros((at.max() + 1, 8))
        np.add.at(total, at, r)
        np.add.at(count, at, one)
        return np.sum(total**2), np.sum(count**2)

    if len(r) == 0:
        return None
    (all_sum, all_pairs), (stay_sum, stay_pairs) = products(track), products(stay)
    self_sum, self_pairs = np.sum(r**2), np.sum(one)
    if all_pairs - stay_pairs < 100 or stay_pairs - self_pairs < 100:
        return None
    between = (all_sum - stay_sum) / (all_pairs - stay_pairs)
    within = (stay_sum - self_sum) / (stay_pairs - self_pairs)
    least = Repeated()
    return Repeated(
        float(np.clip(between, least.constant, MOST)), float(np.clip(within - between, least.resting, MOST))
    )
