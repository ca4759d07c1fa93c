"""The arrow in two sweeps, one part of the log at a time.

Sweep one runs forward and keeps of each part only the message at its end: the normal equations of that epoch with
everything before it eliminated. Sweep two runs backwards and asks for each part again. So memory does not grow with
the log, and 288,000 epochs take a third less time than in one piece, because blocks stay in the caches. ``arrow`` does
the same in one piece, and is the oracle of the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.linalg

from pipeline import threads
from pipeline.estimation import blocks
from pipeline.estimation.arrow import Chain


@dataclass(frozen=True, eq=False)
class Piece:
    """Normal equations of one part of the log.

    Its chains hold the part's own epochs, and after them (but for the last part) one that the part shares with
    the next: what this part says of it.
    """

    chains: tuple[Chain, ...]
    """Independent of each other given the statics."""
    C: np.ndarray
    """(p, p) information of the statics with the states held fixed."""
    g_z: np.ndarray
    """(p,) gradient."""
    count: int
    """The part's own epochs."""
    damping: np.ndarray | None = None
    """(E,) share of each epoch's own diagonal that is added to it; never in the covariance pass."""
    eased: tuple[Chain, ...] = ()
    """The chains with the motion prior eased, where they are asked for; see ``pull``."""


Pieces = Callable[[int], Piece]
"""The normal equations of the part of a number."""


@dataclass(frozen=True, eq=False)
class Message:
    """What everything before an epoch says of its state, one chain."""

    D: np.ndarray
    """(b, b)."""
    W: np.ndarray
    """(b, q + 1) border, and the right-hand side."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """What sweep one leaves: the statics' own system, and the messages between the parts."""

    S: np.ndarray
    """(p, p) information of the statics once the states are eliminated; its inverse is their covariance."""
    dz: np.ndarray
    """(p,) their step."""
    innovations: tuple[float, ...]
    """Per part: ``sum |y_k|²`` of ``y = U^-T (-g)``, the squared length of the step that it asks of its states in
    posterior sigmas, the statics held."""
    pull: float
    """The same of the statics, ``dz' S dz``. With the innovations it makes ``-g' dx``."""
    columns: tuple[np.ndarray, ...]
    """(q,) per chain: which of the statics the messages' columns belong to."""
    messages: tuple[tuple[Message, ...], ...]
    """Per part and chain."""
    log_det: float
    """Of the whole normal matrix, states and statics, damping included."""

    @property
    def longest(self) -> float:
        """What no unknown's step exceeds, in posterior sigmas.

        A state moves by ``v' y - Y_k dz`` with ``|v|² = Z_kk``, and ``v`` lives on its own epoch and those after it for
        as long as motion remembers: in its part and the one that follows. The length of the whole step would bound
        it too, but grows with the root of the log's length.
        """
        two = np.convolve(self.innovations, np.ones(2))
        return float(np.sqrt(max(two.max() + self.pull, 0.0)))


def reduce(pieces: Pieces, count: int) -> Reduced:
    """Sweep one: eliminate all states, then solve for the statics.

    Parameters
    ----------
    pieces : callable
        The part of each number, from 0.
    count : int
        How many parts there are.

    Raises
    ------
    numpy.linalg.LinAlgError
        Something is held by nothing at all; the message names the epoch, counted within its part.
    """
    forward = _Forward()
    with threads.crew() as crew:
        for i, piece in enumerate(crew.each(pieces, range(count))):
            forward.add(piece, crew, i == count - 1)
    return forward.reduced()


def reduce_twice(pieces: Pieces, count: int) -> tuple[Reduced, Reduced]:
    """Sweep one with the motion prior as it is, and eased; each part is asked for once."""
    plain, eased = _Forward(), _Forward()
    with threads.crew() as crew:
        for i, piece in enumerate(crew.each(pieces, range(count))):
            plain.add(piece, crew, i == count - 1)
            eased.add(replace(piece, chains=piece.eased), crew, i == count - 1)
    return plain.reduced(), eased.reduced()


class _Forward:
    """What sweep one has added up so far."""

    def __init__(self):
        self.messages: list[tuple[Message, ...]] = []
        self.columns: tuple[np.ndarray, ...] = ()
        self.S = self.b = np.zeros(0)
        self.innovations: list[float] = []
        self.log_det = 0.0

    def add(self, piece: Piece, crew: threads.Crew, last: bool) -> None:
        """The part that follows."""
        if not self.messages:
            self.S, self.b = np.zeros_like(piece.C), np.zeros_like(piece.g_z)
            self.columns = tuple(chain.columns for chain in piece.chains)
            self.messages.append(tuple(_nothing(chain) for chain in piece.chains))
        self.S += piece.C
        self.b -= piece.g_z
        self.innovations.append(0.0)
        following = []
        of_chains = crew.each(partial(_eliminated, piece), zip(piece.chains, self.messages[-1], strict=True))
        for at, (square, log_det, message) in zip(self.columns, of_chains, strict=True):
            self.S[np.ix_(at, at)] -= square[:-1, :-1]
            self.b[at] -= square[:-1, -1]
            self.innovations[-1] += float(square[-1, -1])
            self.log_det += log_det
            following.append(message)
        self.messages.append(() if last else tuple(following))

    def reduced(self) -> Reduced:
        """Solved for the statics."""
        S, dz, log_det = 0.5 * (self.S + self.S.T), self.b, self.log_det
        if len(self.b):
            root = scipy.linalg.cho_factor(S)
            dz = scipy.linalg.cho_solve(root, self.b)
            log_det += 2 * float(np.sum(np.log(np.diagonal(root[0]))))
        innovations, messages = tuple(self.innovations), tuple(self.messages)
        return Reduced(S, dz, innovations, float(self.b @ dz), self.columns, messages, log_det)


def _eliminated(piece: Piece, given: tuple[Chain, Message]) -> tuple[np.ndarray, float, Message]:
    """``[W, y]' [W, y]`` of a part of a chain, its share of the determinant's logarithm, and the message at its end."""
    chain, message = given
    D, W = message.D.copy(), message.W.copy()
    square = np.zeros((W.shape[1], W.shape[1]))
    damping = np.zeros(len(chain.D)) if piece.damping is None else piece.damping
    bad, log_det = blocks.eliminate(chain.D, chain.A, chain.B, chain.g, damping, D, W, piece.count, square)
    if bad >= 0:
        raise np.linalg.LinAlgError(f"block {bad} is not positive definite")
    return np.triu(square) + np.triu(square, 1).T, log_det, Message(D, W)


def steps(pieces: Pieces, reduced: Reduced) -> Iterator[tuple[int, list[np.ndarray]]]:
    """Sweep two: the steps of the states, from the last part to the first.

    Yields
    ------
    part : int
    dx : list of (E, b) arrays
        Per chain, of the part's epochs and of the one it shares with the next.
    """
    following: tuple[np.ndarray | None, ...] = (None,) * len(reduced.columns)
    back = range(len(reduced.messages) - 2, -1, -1)
    with threads.crew() as crew:
        for i, piece in zip(back, crew.each(pieces, back), strict=True):
            given = zip(piece.chains, reduced.columns, reduced.messages[i], following, strict=True)
            out = list(crew.each(partial(_moved, piece, reduced.dz), given))
            following = tuple(x[0] for x in out)
            yield i, out


def _moved(piece: Piece, dz, given) -> np.ndarray:
    """(E, b) steps of a part of a chain."""
    chain, columns, message, following = given
    x = -(chain.g + chain.B @ dz[chain.columns])[..., None]
    x[0, :, 0] += message.W[:, -1] - message.W[:, :-1] @ dz[columns]
    U, F = _factored(chain, piece, message)
    blocks.forward(U, F, x, piece.count)
    if following is not None:
        x[-1, :, 0] = following
    blocks.backward(U, F, x, piece.count)
    return x[..., 0]


@dataclass(frozen=True, eq=False)
class Inverse:
    """Published blocks of the inverse, one part of one chain."""

    Z: np.ndarray
    """(E, b, b) diagonal blocks of ``H_xx^-1``: ``Z_k = U_k^-1 U_k^-T + G_k Z_k+1 G_k'``."""
    G: np.ndarray
    """(E - 1, b, b) ``U_k^-1 F_k``: neighbouring blocks follow as ``Z_k,k+1 = -G_k Z_k+1``."""
    Y: np.ndarray
    """(E, b, q) ``H_xx^-1 H_xs``: how the states follow the statics, ``dx = -Y dz``."""


def inverses(pieces: Pieces, reduced: Reduced) -> Iterator[tuple[int, list[Inverse]]]:
    """Sweep two of the covariances: selected inverse and border, from the last part to the first."""
    following: tuple[Inverse | None, ...] = (None,) * len(reduced.columns)
    back = range(len(reduced.messages) - 2, -1, -1)
    with threads.crew() as crew:
        for i, piece in zip(back, crew.each(pieces, back), strict=True):
            given = zip(piece.chains, reduced.messages[i], following, strict=True)
            out = list(crew.each(partial(_inverse, piece), given))
            following = tuple(out)
            yield i, out


def _inverse(piece: Piece, given) -> Inverse:
    """Blocks of the inverse, a part of a chain."""
    chain, message, following = given
    Y = chain.B.copy()
    Y[0] += message.W[:, :-1]
    U, F = _factored(chain, piece, message)
    blocks.forward(U, F, Y, piece.count)
    Z, G = np.empty_like(U), np.empty_like(F)
    if following is not None:
        Y[-1], Z[-1] = following.Y[0], following.Z[0]
    blocks.backward(U, F, Y, piece.count)
    blocks.selected_inverse(U, F, Z, G, piece.count)
    return Inverse(Z, G, Y)


def _nothing(chain: Chain) -> Message:
    b, q = chain.B.shape[1:]
    return Message(np.zeros((b, b)), np.zeros((b, q + 1)))


def _factored(chain: Chain, piece: Piece, message: Message):
    """``U`` and ``F`` of ``H_xx = U' U``, given what was eliminated before."""
    U, F = chain.D.copy(), chain.A.copy()
    if piece.damping is not None:
        i = np.arange(U.shape[-1])
        U[:, i, i] *= 1 + piece.damping[:, None]
    U[0] += message.D
    bad = blocks.factor(U, F, piece.count)
    if bad >= 0:
        raise np.linalg.LinAlgError(f"block {bad} is not positive definite")
    return U, F
