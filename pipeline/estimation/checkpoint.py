"""What an adjustment has finished, kept so that one that is killed goes on from there.

Everything is computed from the same input in the same order, so it is enough to know how far the iterations came: all
that lies between them is done again, and the bytes are those of an adjustment that nobody disturbed. Where the
arrays are kept is the business of who hands in a ``Checkpoint``; this room knows no paths.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipeline.estimation.problem import Weights
from pipeline.estimation.values import Values

Arrays = dict[str, np.ndarray]


class Checkpoint(Protocol):
    """Keeps named arrays; those kept last under a name are those that come back."""

    def recall(self, name: str) -> Arrays | None:
        """What was kept under a name, for this same adjustment; None where nothing was."""

    def keep(self, name: str, arrays: Arrays) -> None:
        """Keep these in place of what the name has; may decline where it took no time to compute them."""

    def forget(self, name: str) -> None:
        """Give up what a name has, if it has anything."""


class Forgetful:
    """Keeps nothing."""

    def recall(self, name: str) -> Arrays | None:
        return None

    def keep(self, name: str, arrays: Arrays) -> None:
        pass

    def forget(self, name: str) -> None:
        pass


FORGETFUL: Checkpoint = Forgetful()


def arrays_of(values: Values) -> Arrays:
    """Values by name."""
    return {
        **{f"pose {k}": T for k, T in enumerate(values.pose)},
        **{f"rate {k}": w for k, w in enumerate(values.rate)},
        "z": values.z,
        "time_s": values.time_s,
    }


def values_of(arrays: Arrays) -> Values:
    """The values that ``arrays_of`` named."""
    count = sum(name.startswith("pose ") for name in arrays)
    return Values(
        tuple(arrays[f"pose {k}"] for k in range(count)),
        tuple(arrays[f"rate {k}"] for k in range(count)),
        arrays["z"],
        arrays["time_s"],
    )


def arrays_of_weights(weights: Weights) -> Arrays:
    """What counts, by name."""
    return {
        **{f"corners {k}": alive for k, alive in enumerate(weights.corners)},
        **{f"sensor {k}": alive for k, alive in enumerate(weights.sensors)},
    }


def weights_of(arrays: Arrays, like: Weights) -> Weights:
    """The weights that ``arrays_of_weights`` named."""
    return Weights(
        like.huber,
        tuple(arrays[f"corners {k}"] for k in range(len(like.corners))),
        tuple(arrays[f"sensor {k}"] for k in range(len(like.sensors))),
    )


@dataclass(frozen=True)
class Iterations:
    """Where the iterations of one round are kept."""

    checkpoint: Checkpoint = FORGETFUL
    name: str = ""

    def recall(self) -> tuple[Values, np.ndarray, int, float, float, bool, bool] | None:
        """Values, damping, steps taken, the last one's length and what it left, whether converged and patient."""
        found = self.checkpoint.recall(self.name)
        if found is None:
            return None
        used, sigmas, left, converged, patient = found["state"].tolist()
        return values_of(found), found["damping"], int(used), sigmas, left, bool(converged), bool(patient)

    def keep(self, values: Values, damping, *state) -> None:
        self.checkpoint.keep(
            self.name, {**arrays_of(values), "damping": damping, "state": np.array(state, dtype=float)}
        )


UNKEPT = Iterations()
