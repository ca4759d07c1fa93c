"""The nouns of the network: bodies, cameras, markers, sensors, statics; observations and readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SOURCES = ("benchmarks", "mounts", "intrinsics", "linkage and sensor", "cutting edge", "time offset")
"""Groups of the error budget: every static belongs to one."""

POSE_COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
POSE_UNITS = ("m", "m", "m", "rad", "rad", "rad")


@dataclass(frozen=True, eq=False)
class Static:
    """One quantity that does not change over the log: the elements of C in eq. (1) of the paper.

    The paper takes C as exact. Here each element has a prior from the files, and the unknown is the vector
    ``z`` of its whitened correction: ``value @ exp(scale @ z)`` for a pose, ``value + scale @ z`` for a
    vector, with ``z ~ N(0, I)``. A direction without variance has no column in ``scale``: it is exact.
    """

    name: str
    source: str
    """One of ``SOURCES``."""
    is_pose: bool
    value: np.ndarray
    """(4, 4) pose ``T_parent_child``, or (n,) vector."""
    covariance: np.ndarray
    """(n, n) prior covariance, of ``xi`` for a pose."""
    components: tuple[str, ...]
    units: tuple[str, ...]
    surveyed: bool = True
    """False for a pose that the log alone must tell: a static body, mount or benchmark that no file gives."""

    @property
    def scale(self) -> np.ndarray:
        """(n, r) square root of the covariance, with the r directions that are not exact."""
        sigma = np.sqrt(np.diagonal(self.covariance))
        unit = np.where(sigma > 0, sigma, 1.0)  # metres and radians are not comparable, correlations are
        values, vectors = np.linalg.eigh(self.covariance / np.outer(unit, unit))
        free = values > 1e-12
        if np.array_equal(self.covariance, np.diag(np.diagonal(self.covariance))):
            return np.diag(sigma)[:, sigma > 0]  # keeps one unknown per component
        return unit[:, None] * vectors[:, free] * np.sqrt(values[free])


@dataclass(frozen=True)
class Body:
    name: str
    kind: str
    """world, static, moving or joint."""
    parent: str | None = None
    """Of a joint."""
    static: int | None = None
    """Index of the pose of a static body, or of the axis ``T_parent_axis`` of a joint."""
    motion: tuple[float, float] = (0.0, 0.0)
    """Spectral densities of white-noise acceleration, m²/s³ and rad²/s³; a joint uses the second."""
    follows: str | None = None
    """Of a joint without an angle of its own: the joint that drives it."""
    ratio: float = 1.0
    """Its turn per turn of that joint."""


@dataclass(frozen=True)
class Camera:
    name: str
    body: str
    mount: int
    """Index of the static ``T_body_camera``."""
    intrinsics: int
    """Index of the static in the order of ``pipeline.geometry.camera.INTRINSICS``."""
    width: int
    height: int


@dataclass(frozen=True)
class Marker:
    name: str
    body: str
    mount: int
    """Index of the static ``T_body_marker``; of a benchmark: ``T_world_marker``."""
    benchmark: bool


@dataclass(frozen=True)
class Sensor:
    name: str
    joint: str
    output: str
    """cylinder_m or angle_deg: what the curve turns the raw reading into."""
    curve: int
    linkage: int | None
    offset: int
    """Index of the static time offset, seconds: true time of a sample minus its stamp at the first epoch; and how much
    it grows, ppm, where the file has a drift."""
    side: int
    """Which way round the linkage is built; see ``pipeline.geometry.linkage``."""
    noise: float
    """Standard deviation of one raw reading."""
    raw_range: tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Network:
    """A machine on a site: everything that is known before anything is seen."""

    bodies: dict[str, Body]
    """By name, ``world`` among them."""
    cameras: tuple[Camera, ...]
    markers: tuple[Marker, ...]
    """Those on the machine, then the benchmarks."""
    tag_marker: np.ndarray
    """(m,) index of the marker of each tag."""
    tag_family: tuple[str, ...]
    tag_id: np.ndarray
    """(m,) printed id."""
    tag_corners: np.ndarray
    """(m, 4, 3) corners in the marker frame, metres, corner order of the house."""
    sensors: tuple[Sensor, ...]
    statics: tuple[Static, ...]
    tool_body: str
    tool: int
    """Index of the static ``T_body_tool``, worn teeth included."""
    edge_m: float
    """Width of the cutting edge."""

    def tag_index(self, family, tag_id):
        """Index of a printed tag; -1 where the network has none such.

        Parameters
        ----------
        family : (n,) sequence of str
            Such as tag36h11.
        tag_id : (n,) int array
            Decoded ids.

        Returns
        -------
        (n,) int array
        """
        known = {(f, int(i)): k for k, (f, i) in enumerate(zip(self.tag_family, self.tag_id, strict=True))}
        pairs = zip(family, np.asarray(tag_id).tolist(), strict=True)
        return np.array([known.get(pair, -1) for pair in pairs], dtype=np.int64)

    def camera_index(self, name: str) -> int:
        return [camera.name for camera in self.cameras].index(name)


@dataclass(frozen=True, eq=False)
class Observations:
    """Corners of tags that were seen, one row per tag in one frame."""

    camera: np.ndarray
    """(n,) index into ``Network.cameras``."""
    tag: np.ndarray
    """(n,) index into the tags of the network."""
    time_ns: np.ndarray
    """(n,) int64 capture stamp."""
    uv: np.ndarray
    """(n, 4, 2) corners in pixels, corner order and pixel convention of the house."""
    cov: np.ndarray
    """(n, 4, 2, 2) covariance of each corner, px²."""

    def __post_init__(self):
        n = len(self.camera)
        assert self.tag.shape == self.time_ns.shape == (n,), (self.tag.shape, self.time_ns.shape)
        assert self.uv.shape == (n, 4, 2) and self.cov.shape == (n, 4, 2, 2), (self.uv.shape, self.cov.shape)

    def take(self, rows) -> Observations:
        """The same observations, some of them: a mask or an index array."""
        return Observations(
            self.camera[rows], self.tag[rows], self.time_ns[rows], self.uv[rows], self.cov[rows]
        )


@dataclass(frozen=True, eq=False)
class Readings:
    """Raw readings of one sensor."""

    time_ns: np.ndarray
    """(n,) int64 stamps as recorded."""
    raw: np.ndarray
    """(n,) raw unit of the sensor."""
