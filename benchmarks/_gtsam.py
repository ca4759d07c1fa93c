"""A problem of two carriers as GTSAM's own compiled factors.

- ``WnoaMotionFactorPose3``: white noise on acceleration between two epochs of a carrier;
- ``ProjectionFactorPPPCCal3_S2`` (of ``gtsam_unstable``): a corner, by carrier, mount, point and intrinsics;
- ``PriorFactor...``: statics, first pose (translation and rotation apart, as ours) and first velocity;
- a tight prior for every corner of a board and for skews, as this factor takes no point as given. So GTSAM's border is
  27 wider than ours: 57 columns in place of 30.

So boards are exact in this problem. Points tied to boards of unknown pose make GTSAM's system indeterminate
(ties of 0.3 um) or its covariances wrong by 5e-5, more with every epoch (1 um); with hard constraints marginals fail.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.estimation.normal import linearise
from pipeline.estimation.problem import FIRST_POSE, FIRST_RATE, Problem, Weights
from pipeline.estimation.values import Values
from pipeline.geometry import se3

CORNER_M, SKEW_PX = 1e-9, 1e-7
"""Sigmas of what is given: corners of boards, skews."""


class Graph:
    """The factors, a start, and the way back to our values."""

    def __init__(self, problem: Problem):
        import gtsam

        self.gtsam, self.problem = gtsam, problem
        self.factors, self.start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.poses = [[gtsam.symbol("xy"[k], i) for i in range(self.epochs)] for k in (0, 1)]
        self.rates = [[gtsam.symbol("vw"[k], i) for i in range(self.epochs)] for k in (0, 1)]
        self._add_statics()
        self._add_motion()
        self._add_corners()

    @property
    def epochs(self) -> int:
        return len(self.problem.epochs.time_ns)

    def ordering(self) -> Any:
        """Both carriers by nested halves of the log, then the statics.

        As fast as from the first epoch to the last, and a tree of 17 levels in place of 100,000. With COLAMD the
        optimum takes a third longer.
        """
        out = self.gtsam.Ordering()
        for pose, rate in zip(self.poses, self.rates, strict=True):
            for i in halves(0, self.epochs):
                out.push_back(pose[i])
                out.push_back(rate[i])
        for key in [*self.points, *self.intrinsics.values(), *self.mounts.values()]:
            out.push_back(key)
        return out

    def all_keys(self) -> list[int]:
        """Of everything whose covariance we have too."""
        states = [key for keys in (*self.poses, *self.rates) for key in keys]
        return [*states, *self.intrinsics.values(), *self.mounts.values()]

    def values(self, found: Any) -> Values:
        """GTSAM's answer in our unknowns; skews and points are left out, which hold nothing."""
        p = self.problem
        z = np.zeros(p.statics.size)
        for index, key in [*self.mounts.items()]:
            xi = se3.local(p.statics.base[index], found.atPose3(key).matrix())
            z[p.statics.columns[index]] = np.linalg.lstsq(p.statics.scale[index], xi, rcond=None)[0]
        for index, key in self.intrinsics.items():
            fx, fy, _, cx, cy = found.atCal3_S2(key).vector()
            off = np.array([fx, fy, cx, cy, 0, 0, 0, 0, 0]) - p.statics.base[index]
            z[p.statics.columns[index]] = np.linalg.lstsq(p.statics.scale[index], off, rcond=None)[0]
        return replace(
            p.first,
            pose=tuple(np.array([found.atPose3(x).matrix() for x in keys]) for keys in self.poses),
            rate=tuple(
                np.array([se3.swap_rotation_first(found.atVector(v)) for v in keys]) for keys in self.rates
            ),
            z=z,
        )

    def of_ours(self, values: Values) -> Any:
        """Values of ours in GTSAM's unknowns."""
        gtsam, p = self.gtsam, self.problem
        out = gtsam.Values()
        for index, key in [*self.mounts.items()]:
            out.insert(key, gtsam.Pose3(p.statics.value(index, values.z)))
        for index, key in self.intrinsics.items():
            fx, fy, cx, cy = p.statics.value(index, values.z)[:4]
            out.insert(key, gtsam.Cal3_S2(fx, fy, 0.0, cx, cy))
        for m, marker in enumerate(p.network.markers):
            T = p.statics.value(marker.mount, values.z)
            for i, point in enumerate(se3.transform(T, self._p_marker(m))):
                out.insert(self.points[4 * m + i], point)
        for k in (0, 1):
            for i in range(self.epochs):
                out.insert(self.poses[k][i], gtsam.Pose3(values.pose[k][i]))
                out.insert(self.rates[k][i], se3.swap_rotation_first(values.rate[k][i]))
        return out

    def _p_marker(self, m: int):
        tags = np.flatnonzero(self.problem.network.tag_marker == m)
        assert len(tags) == 1
        return self.problem.network.tag_corners[tags[0]]

    def _pose_prior(self, key, index: int):
        gtsam, statics = self.gtsam, self.problem.statics
        scale = statics.scale[index]
        cov = se3.swap_rotation_first(scale @ scale.T, axes=(0, 1))
        T = gtsam.Pose3(statics.base[index])
        self.factors.add(gtsam.PriorFactorPose3(key, T, gtsam.noiseModel.Gaussian.Covariance(cov)))
        self.start.insert(key, T)

    def _add_statics(self):
        gtsam, p, statics = self.gtsam, self.problem, self.problem.statics
        self.mounts, self.intrinsics, self.points = {}, {}, []
        for c, camera in enumerate(p.network.cameras):
            self.mounts[camera.mount] = gtsam.symbol("m", c)
            self._pose_prior(gtsam.symbol("m", c), camera.mount)
            self.intrinsics[camera.intrinsics] = key = gtsam.symbol("k", c)
            base, scale = statics.base[camera.intrinsics], statics.scale[camera.intrinsics]
            sigma = np.insert(np.linalg.norm(scale[:4], axis=1), 2, SKEW_PX)
            K = gtsam.Cal3_S2(base[0], base[1], 0.0, base[2], base[3])
            self.factors.add(gtsam.PriorFactorCal3_S2(key, K, gtsam.noiseModel.Diagonal.Sigmas(sigma)))
            self.start.insert(key, K)
        for m, marker in enumerate(p.network.markers):
            for i, at in enumerate(se3.transform(statics.base[marker.mount], self._p_marker(m))):
                self.points.append(gtsam.symbol("p", 4 * m + i))
                given = gtsam.noiseModel.Isotropic.Sigma(3, CORNER_M)
                self.factors.add(gtsam.PriorFactorPoint3(self.points[-1], at, given))
                self.start.insert(self.points[-1], at)

    def _add_motion(self):
        gtsam, p = self.gtsam, self.problem
        t = p.epochs.time_s
        for k, (pose, rate) in enumerate(zip(self.poses, self.rates, strict=True)):
            for i in range(self.epochs):
                self.start.insert(pose[i], gtsam.Pose3(p.first.pose[k][i]))
                self.start.insert(rate[i], se3.swap_rotation_first(p.first.rate[k][i]))
            states = [gtsam.StateData(x, v, at) for x, v, at in zip(pose, rate, t, strict=True)]
            density = se3.swap_rotation_first(np.repeat(p.tie.variables[k].motion, 3))
            for a, b in itertools.pairwise(states):
                self.factors.add(gtsam.WnoaMotionFactorPose3(a, b, density))
            T = gtsam.Pose3(p.first.pose[k][0])
            sigma = gtsam.noiseModel.Isotropic.Sigma
            self.factors.add(gtsam.PoseTranslationPrior3D(pose[0], T, sigma(3, FIRST_POSE[0])))
            self.factors.add(gtsam.PoseRotationPrior3D(pose[0], T, sigma(3, FIRST_POSE[3])))
            rest = gtsam.noiseModel.Diagonal.Sigmas(se3.swap_rotation_first(FIRST_RATE))
            self.factors.add(gtsam.PriorFactorVector(rate[0], np.zeros(6), rest))

    def _add_corners(self):
        from gtsam_unstable import ProjectionFactorPPPCCal3_S2 as Corner

        gtsam, p = self.gtsam, self.problem
        variable = {v.body: k for k, v in enumerate(p.tie.variables)}
        for group in p.corners:
            camera = p.network.cameras[group.camera]
            pose = self.poses[variable[camera.body]]
            # One sigma for all, as drawn: a noise model of its own for each corner would cost GTSAM memory.
            noise = gtsam.noiseModel.Isotropic.Sigma(2, 1 / group.whitener[0, 0, 0, 0])
            mount, K = self.mounts[camera.mount], self.intrinsics[camera.intrinsics]
            for epoch, uv in zip(group.epoch.tolist(), group.uv, strict=True):
                for i in range(4):
                    point = self.points[4 * group.marker + i]
                    self.factors.add(Corner(uv[i], noise, pose[epoch], mount, point, K))


def halves(start: int, stop: int) -> list[int]:
    """Numbers from ``start`` to ``stop - 1``: both halves, then the one that parts them."""
    if stop <= start:
        return []
    middle = (start + stop) // 2
    return [*halves(start, middle), *halves(middle + 1, stop), middle]


def covariances(equations: Any, ordering: Any, keys) -> dict[int, np.ndarray]:
    """Marginal covariance of each key of a linear graph.

    By the Bayes tree in an order of our own: ``gtsam.Marginals``, which takes COLAMD's, needs 18 times as long with 30
    statics.
    """
    tree = equations.eliminateMultifrontal(ordering)
    return {key: np.linalg.inv(tree.marginalFactor(key).information()) for key in keys}


def handed_over(problem: Problem, values: Values, weights: Weights) -> tuple[Any, Any]:
    """Our normal equations at some values, as GTSAM's ``HessianFactor``, and the order of elimination.

    One key per carrier and epoch with pose and velocity together, one for all statics.
    """
    import gtsam

    chains, C, g_z = linearise(problem, values, weights)
    graph, ordering = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    border = gtsam.symbol("s", 0)
    for c, chain in enumerate(chains):
        E, b = chain.g.shape
        B = np.zeros((E, b, len(g_z)))
        B[:, :, chain.columns] = chain.B
        nothing = (
            np.zeros((b, b)),
            np.zeros((b, len(g_z))),
            np.zeros(b),
            np.zeros(C.shape),
            np.zeros(len(g_z)),
        )
        for k in halves(0, E):
            ordering.push_back(gtsam.symbol("xy"[c], k))
        for k in range(E):
            key = gtsam.symbol("xy"[c], k)
            if k + 1 < E:
                graph.push_back(gtsam.HessianFactor(
                    key, gtsam.symbol("xy"[c], k + 1), border, chain.D[k], chain.A[k], B[k], -chain.g[k],
                    nothing[0], nothing[1], nothing[2], nothing[3], nothing[4], 0.0,
                ))  # fmt: skip
            else:
                graph.push_back(
                    gtsam.HessianFactor(
                        key, border, chain.D[k], B[k], -chain.g[k], nothing[3], nothing[4], 0.0
                    )
                )
    graph.push_back(gtsam.HessianFactor(border, C, -g_z, 0.0))
    ordering.push_back(border)
    return graph, ordering
