"""Columns of the tables ``states``, ``statics`` and ``residuals``, and the rows of detections as observations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.errors import ArtefactError
from pipeline.estimation.sensitivities import Sensitivities, Source
from pipeline.estimation.solution import BodyStates, CornerResiduals, StaticResult
from pipeline.geometry import gaussian, so3
from pipeline.network.model import Network, Observations, Readings

Columns = dict[str, np.ndarray]

ACCEPTED = "accepted"
_AXES = ("x", "y", "z", "rx", "ry", "rz")
_TRIANGLE = [f"{a}_{b}" for i, a in enumerate(_AXES) for b in _AXES[i:]]
_CORNERS = range(4)
_SOURCE = ("kind", "name", "component", "unit")
_RESPONSE = ("e", "n", "h", "re", "rn", "rh")


def columns_of_states(states: BodyStates) -> Columns:
    """Columns of the ``states`` table for one body."""
    q = so3.to_quaternion(states.T_world_body[:, :3, :3])
    columns = {"time_ns": states.time_ns, "body": np.full(len(states.time_ns), states.body, dtype=object)}
    columns |= dict(zip(("x_m", "y_m", "z_m"), states.T_world_body[:, :3, 3].T, strict=True))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), q.T, strict=True))
    columns |= dict(zip(("vx", "vy", "vz", "wx", "wy", "wz"), states.velocity.T, strict=True))
    columns |= {"angle_rad": states.angle_rad, "seen": states.seen}
    for part, cov in (("own", states.own), ("common", states.common)):
        triangle = gaussian.upper_triangle(cov)
        columns |= {f"{part}_{name}": triangle[:, k] for k, name in enumerate(_TRIANGLE)}
    return columns


def columns_of_statics(results: tuple[StaticResult, ...]) -> Columns:
    """Columns of the ``statics`` table, one row per component."""
    count = [len(r.components) for r in results]
    columns: Columns = {
        "quantity": np.repeat(np.array([r.quantity for r in results], dtype=object), count),
        "source": np.repeat(np.array([r.source for r in results], dtype=object), count),
        "component": np.array([c for r in results for c in r.components], dtype=object),
        "unit": np.array([u for r in results for u in r.units], dtype=object),
    }
    for name in ("file_value", "value", "prior_sigma", "sigma", "shift_sigmas"):
        columns[name] = np.concatenate([getattr(r, name) for r in results])
    return columns


def columns_of_residuals(network: Network, table: CornerResiduals) -> Columns:
    """Columns of the ``residuals`` table."""
    cameras = np.array([c.name for c in network.cameras], dtype=object)
    markers = np.array([m.name for m in network.markers], dtype=object)
    return {
        "camera": cameras[table.camera],
        "time_ns": table.time_ns,
        "marker": markers[table.marker],
        "tag_id": table.tag_id,
        "corner": table.corner,
        "residual_u": table.residual[:, 0],
        "residual_v": table.residual[:, 1],
        "sigma_px": table.sigma_px,
        "normalised": table.normalised,
        "weight": table.weight,
    }


def columns_of_sensitivities(found: Sensitivities) -> Columns:
    """Columns of the ``sensitivities`` table: per kept epoch one row per source."""
    n, count = len(found.time_ns), len(found.sources)
    columns: Columns = {"time_ns": np.repeat(found.time_ns, count)}
    for name in _SOURCE:
        words = np.array([getattr(source, name) for source in found.sources], dtype=object)
        columns["source" if name == "kind" else name] = np.tile(words, n)
    for axis, name in enumerate(_RESPONSE):
        columns[name] = np.ascontiguousarray(found.response[..., axis]).ravel()
    return columns


def sensitivities_from_columns(columns: Columns) -> Sensitivities | None:
    """Sensitivities from their table, None where it has no rows.

    Raises
    ------
    ArtefactError
        When the rows are not those of the same sources at one epoch after the other.
    """
    time_ns = columns["time_ns"]
    if len(time_ns) == 0:
        return None
    count = int(np.searchsorted(time_ns, time_ns[0], side="right"))
    whole = len(time_ns) % count == 0
    if whole:
        epochs = time_ns.reshape(-1, count)
        whole = bool(np.all(epochs == epochs[:, :1])) and bool(np.all(np.diff(epochs[:, 0]) > 0))
    words = [columns["source" if name == "kind" else name] for name in _SOURCE]
    if not whole or any(bool(np.any(w.reshape(-1, count) != w[:count])) for w in words):
        raise ArtefactError(
            "sensitivities.parquet does not hold the same sources at one epoch after the other; "
            "delete it and run the estimate stage again"
        )
    response = np.stack([columns[name].reshape(-1, count) for name in _RESPONSE], axis=-1)
    sources = tuple(Source(*(str(w[i]) for w in words)) for i in range(count))
    return Sensitivities(np.ascontiguousarray(time_ns[::count]), sources, response)


def observations_of(network: Network, detections: Mapping[str, Mapping[str, np.ndarray]]) -> Observations:
    """Accepted tags of the ``detections`` tables, one table per camera, as observations.

    Tags that the network does not have are left out: detection has counted them as unknown.
    """
    parts = [Observations(*_EMPTY)]
    for name, rows in detections.items():
        index = network.tag_index(rows["family"], rows["tag_id"])
        good = np.flatnonzero((rows["status"] == ACCEPTED) & (index >= 0))
        uv = np.stack([np.stack([rows[f"u{k}"], rows[f"v{k}"]], axis=-1) for k in _CORNERS], axis=1)[good]
        cov = np.stack(
            [
                np.stack(
                    [rows[f"cov{k}_uu"], rows[f"cov{k}_uv"], rows[f"cov{k}_uv"], rows[f"cov{k}_vv"]], axis=-1
                )
                for k in _CORNERS
            ],
            axis=1,
        )[good]
        camera_index = network.camera_index(name)
        camera = np.full(len(good), camera_index)
        parts.append(Observations(camera, index[good], rows["time_ns"][good], uv, cov.reshape(-1, 4, 2, 2)))
    fields = ("camera", "tag", "time_ns", "uv", "cov")
    return Observations(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields))


def readings_of(sensors: Mapping[str, np.ndarray]) -> dict[str, Readings]:
    """Rows of the ``sensors`` table by sensor."""
    names = sensors["sensor"].astype(str)
    return {
        str(name): Readings(sensors["time_ns"][names == name], sensors["raw"][names == name])
        for name in np.unique(names)
    }


_EMPTY = (
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros((0, 4, 2)),
    np.zeros((0, 4, 2, 2)),
)
