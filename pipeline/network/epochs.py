"""The instants of the trajectory: every frame in which something was seen, and every reading of a sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.network.model import Network, Observations, Readings

FRAMES_MERGE_NS = 100_000
"""Cameras triggered together differ by less; at 1 m/s a tenth of a millisecond is a tenth of a millimetre."""
READINGS_MERGE_NS = 1_000_000
"""A reading this close to another epoch is compared with ``angle + rate dt`` there, which is exact to 1e-6 rad at
1 rad/s²; an epoch of its own would only put a block of condition number 1e12 into the chain."""


@dataclass(frozen=True, eq=False)
class SensorEpochs:
    """Readings of one sensor, laid onto the epochs."""

    epoch: np.ndarray
    """(k,) index of the epoch each reading belongs to."""
    dt_s: np.ndarray
    """(k,) nominal true time of the reading minus that epoch, seconds."""
    raw: np.ndarray
    """(k,) raw readings."""


@dataclass(frozen=True, eq=False)
class Epochs:
    """The epochs of a log, and where its observations and readings belong."""

    time_ns: np.ndarray
    """(E,) int64, strictly rising."""
    observations: Observations
    """Sorted by epoch, without duplicates."""
    epoch: np.ndarray
    """(n,) index of the epoch of each observation."""
    sensors: dict[int, SensorEpochs]
    """By index of the sensor."""
    dropped: dict[str, int]
    """What was left out, by reason."""

    @property
    def time_s(self) -> np.ndarray:
        """(E,) seconds from the first epoch."""
        return (self.time_ns - self.time_ns[0]) * 1e-9


def epochs_of(network: Network, observations: Observations, readings: dict[str, Readings]) -> Epochs:
    """Epochs of a log: frames with observations, and readings at their nominal true time.

    Parameters
    ----------
    network : Network
        Of the sensors and their nominal time offsets.
    observations : Observations
        In any order; the second of two sightings of one tag by one camera at one instant is dropped.
    readings : dict of str to Readings
        By name of the sensor; readings outside ``raw_range``, not finite or at a stamp that was there before
        are dropped.
    """
    dropped: dict[str, int] = {}
    frames, frame_index = _clusters(observations.time_ns, FRAMES_MERGE_NS)
    stamps = frames
    taken: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for s, sensor in enumerate(network.sensors):
        if sensor.name not in readings:
            continue
        time_ns, raw = _clean(sensor, readings[sensor.name], dropped)
        if len(raw):
            offset_ns = round(float(network.statics[sensor.offset].value[0]) * 1e9)
            taken[s] = (time_ns + offset_ns, raw)
    taken = _drifted(network, taken, frames)
    lonely = [t[_distance(t, stamps) > READINGS_MERGE_NS] for t, _ in taken.values()]
    if lonely:
        own, _ = _clusters(np.concatenate(lonely), READINGS_MERGE_NS)
        stamps = np.union1d(stamps, own)
    frame_epoch = np.searchsorted(stamps, frames)[frame_index]
    sensors = {}
    for s, (time_ns, raw) in taken.items():
        epoch = _nearest(time_ns, stamps)
        sensors[s] = SensorEpochs(epoch, (time_ns - stamps[epoch]) * 1e-9, raw)
    key = np.stack([frame_epoch, observations.camera, observations.tag])
    _, first = np.unique(key, axis=1, return_index=True) if len(frame_epoch) else (None, np.array([], int))
    if len(first) < len(frame_epoch):
        dropped["tag seen twice at one instant"] = len(frame_epoch) - len(first)
    return Epochs(stamps, observations.take(first), frame_epoch[first], sensors, dropped)


def _drifted(network: Network, taken, frames):
    """Readings by sensor at their nominal true time, where a clock drifts from the first epoch on."""
    begins_ns = min([int(t[0]) for t, _ in taken.values()] + frames[:1].tolist(), default=0)
    out = {}
    for s, (time_ns, raw) in taken.items():
        drift = network.statics[network.sensors[s].offset].value[1:].sum()
        out[s] = (time_ns + np.rint(1e-6 * drift * (time_ns - begins_ns)).astype(np.int64), raw)
    return out


def _clean(sensor, readings: Readings, dropped: dict[str, int]):
    time_ns, raw = np.asarray(readings.time_ns, np.int64), np.asarray(readings.raw, np.float64)
    good = np.isfinite(raw)
    if sensor.raw_range is not None:
        with np.errstate(invalid="ignore"):
            good &= (raw >= sensor.raw_range[0]) & (raw <= sensor.raw_range[1])
    if not np.all(good):
        dropped[f"reading of '{sensor.name}' outside its calibrated range"] = int(np.sum(~good))
    time_ns, first = np.unique(time_ns[good], return_index=True)
    if len(first) < np.sum(good):
        dropped[f"reading of '{sensor.name}' with a stamp that was there before"] = int(
            np.sum(good) - len(first)
        )
    return time_ns, raw[good][first]


def _clusters(time_ns, within_ns):
    """Representative stamps at least ``within_ns`` apart, and which of them each stamp belongs to."""
    unique, inverse = np.unique(np.asarray(time_ns, np.int64), return_inverse=True)
    leader = np.zeros(len(unique), dtype=np.int64)
    count = 0
    start = None
    starts = []
    for k, t in enumerate(unique.tolist()):
        if start is None or t - start > within_ns:
            start = t
            starts.append(t)
            count += 1
        leader[k] = count - 1
    return np.array(starts, dtype=np.int64), leader[inverse]


def _nearest(time_ns, stamps):
    right = np.clip(np.searchsorted(stamps, time_ns), 1, max(len(stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(stamps) - 1)
    return np.where(np.abs(time_ns - stamps[left]) <= np.abs(stamps[right] - time_ns), left, right)


def _distance(time_ns, stamps):
    if len(stamps) == 0:
        return np.full(len(time_ns), np.iinfo(np.int64).max)
    return np.abs(time_ns - stamps[_nearest(time_ns, stamps)])
