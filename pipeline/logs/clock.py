"""Capture stamps in order: sorted, and what was wrong with them counted.

Only the stamp inside a message says when a picture was taken. log_time says when a recorder received it; it is used
for finding a message again, and, by its difference from the stamp, for noticing clocks that are not set.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

EARLIEST_NS = 946_684_800_000_000_000
"""2000-01-01. A stamp before it comes from a clock that was never set (it counts from boot)."""


@dataclass(frozen=True)
class Stamps:
    """The usable messages of one source, in order of capture, and counts of the others."""

    order: np.ndarray
    """(n,) int indices into what was given: by time_ns, zeros and repeats left out."""
    backwards: int
    """Messages whose stamp is earlier than one that came before; they are sorted in."""
    repeated: int
    """Messages with a stamp that another message of the source has already; the first is kept."""
    zero: int
    """Messages without a stamp."""
    delay_s: float
    """Median of log_time minus stamp, seconds."""
    spread_s: float
    """Half the range of that difference between its 5th and 95th percentile, seconds."""


def in_order(time_ns: np.ndarray, log_time_ns: np.ndarray) -> Stamps:
    """How to put messages of one source into the order of their capture.

    Parameters
    ----------
    time_ns : (n,) int64 array
        Capture stamps in the order of the file; 0 or less where a message has none.
    log_time_ns : (n,) int64 array
        When each was received.
    """
    time_ns, log_time_ns = np.asarray(time_ns, np.int64), np.asarray(log_time_ns, np.int64)
    stamped = np.flatnonzero(time_ns > 0)
    t = time_ns[stamped]
    latest_before = np.maximum.accumulate(t) if len(t) else t
    backwards = int(np.sum(t[1:] < latest_before[:-1]))
    # Equal stamps: the one received first, then the one that stands first in the file, so that detection
    # finds the same message again.
    order = stamped[np.lexsort((log_time_ns[stamped], t))]
    first = np.ones(len(order), bool)
    first[1:] = np.diff(time_ns[order]) > 0
    delay_s = (log_time_ns[stamped] - t) * 1e-9
    low, middle, high = np.percentile(delay_s, [5, 50, 95]) if len(t) else (0.0, 0.0, 0.0)
    return Stamps(
        order=order[first],
        backwards=backwards,
        repeated=int(np.sum(~first)),
        zero=len(time_ns) - len(stamped),
        delay_s=float(middle),
        spread_s=float(high - low) / 2,
    )
