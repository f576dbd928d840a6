"""The factor graph of problems 3 and 4: variables, factors, Gauss-Newton steps, evidence, marginals.

Variables are the graph poses X_i (pose 1, every measured pose, the last pose), the markers L_j (as
points P_j where no sighting has an orientation), the antennas A_k, and the wheel parameters
w = [R_R, R_L, b], as deviations from their nominal values in units of their sigmas:

* a prior on pose 1, which fixes the world frame, and the prior of table 2 on w;
* a between factor for every sighting, Z_ij = X_i^-1 L_j;
* a range factor for every range, r_ik = |A_k - (x_i, y_i)|;
* an odometry factor between consecutive graph poses, which depends on w too:

      e = log(Delta_i(w)^-1 X_i^-1 X_{i+1}),    Delta_i(w) = Delta_i(0) + dDelta_i/dw w,

  with the noise of rounding and slip (`factors.odometry_noise`). The errors of w repeat in every
  increment; as a variable of the graph they do, as noise of independent factors they could not.

Frames. GTSAM perturbs a pose on the right, X <- X exp(xi): its covariances are those of the
pose's error in the pose's own axes. A between factor's noise lives in the axes of the measured pose
Z, so a covariance given in the axes of the vehicle is turned by R(delta)^T, and a marginal is turned
by R(delta) before it leaves for the world.

The odometry factors are linearised in numpy, all at once, and added to GTSAM's linearisation of the
others: a custom factor in Python would copy all values at every call.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, W, X

from slamlib import se2
from slamlib.dataset import DatasetError
from slamlib.factors import (between_error, linearize, odometry_factors, point_error, range_error)
from slamlib.marginals import marginals
from slamlib.ties import GATE, GATE_OF_POINTS, LOST_HEADING, gather

GAUGE = 1e-5                 # m, sigma of the position of pose 1, which is zero by definition
LOOSE = 1e5                  # m and rad, sigma of a marker that no sighting holds
GUESS = 5.0                  # m, sigma of an antenna's guess: decides where the ranges do not
LEAST = 1e-6                 # relative decrease of the error at which iterations end


@dataclass(frozen=True)
class State:
    """Values of all variables, as arrays."""

    poses: np.ndarray        # (f, 3), headings continuous
    markers: np.ndarray      # (k, 3), heading 0 where a marker is a point
    antennas: np.ndarray     # (a, 2)
    w: np.ndarray            # (3,)


class Graph:
    """The graph of one dataset, with the sensors that it has, and one model of the increments.

    Measurements are numbered: first the s sightings, then the r ranges. A `weight` (s + r,) gives
    each measurement's share of its information: 1 as it is, 0 left out.
    """

    def __init__(self, dataset, model, also=(), wheels="variable"):
        self.dataset, self.model, self.wheels = dataset, model, wheels
        uwb = dataset.uwb
        self.sightings = s = gather(dataset.aruco, also=np.r_[
            0, len(dataset.ticks) - 1, np.array(also, int), [] if uwb is None else uwb.pose])
        self.frame = s.frame
        self.marker, self.label = np.unique(s.marker, return_inverse=True)
        has_heading = s.C[:, 2, 2] < LOST_HEADING**2
        self.oriented = np.bincount(self.label, has_heading, len(self.marker)) > 0
        self.as_pose = self.oriented[self.label]                  # (s,) sightings of these
        noise = se2.rotate_covariance(s.C, -s.z[:, 2])
        self.sighted = [(X(int(i)), L(int(j)), gtsam.Pose2(*z), c) if pose else None for i, j, z, c, pose
                        in zip(s.row, self.label, s.z, noise, self.as_pose)]
        self.antenna = np.zeros(0, int) if uwb is None else np.unique(uwb.antenna)
        self.tag_row = np.searchsorted(s.frame, [] if uwb is None else uwb.pose)
        self.tag = np.searchsorted(self.antenna, [] if uwb is None else uwb.antenna)
        self.range, self.sigma = np.zeros((2, 0)) if uwb is None else (uwb.range, uwb.sigma)
        guess = dataset.antenna_guess
        self.guess = np.zeros((0, 2)) if uwb is None else guess.position[
            np.searchsorted(guess.antenna, self.antenna)]
        self.gate = np.where(self.as_pose, GATE, GATE_OF_POINTS)  # (s,)
        self.ordering = None                                      # of elimination, once it is known
        self.about(np.zeros(3))

    def about(self, w):
        """Make the increments linear about the wheels w (the nominal ones if these are no variable)."""
        d, self.w = self.dataset, w if self.wheels == "variable" else np.zeros(3)
        self.factors = odometry_factors(d.ticks, d.vehicle, self.frame, self.model, self.wheels, self.w)

    def values(self, state):
        """GTSAM's Values of a State."""
        values = gtsam.Values()
        for i, pose in enumerate(state.poses):
            values.insert(X(i), gtsam.Pose2(*pose))
        for j, marker in enumerate(state.markers):
            if self.oriented[j]:
                values.insert(L(j), gtsam.Pose2(*marker))
            else:
                values.insert(P(j), gtsam.Point2(*marker[:2]))
        for k, antenna in enumerate(state.antennas):
            values.insert(A(k), gtsam.Point2(*antenna))
        values.insert(W(0), state.w)
        return values

    def state(self, values):
        """The State of GTSAM's Values (which come in the order of their keys, by letter and number)."""
        poses, points = gtsam.utilities.extractPose2(values), gtsam.utilities.extractPoint2(values)
        seen, known = np.count_nonzero(self.oriented), len(self.antenna)
        markers = np.zeros((len(self.marker), 3))
        markers[self.oriented] = poses[:seen]
        markers[~self.oriented, :2] = points[known:len(self.marker) - seen + known]     # then comes w
        poses = poses[seen:]
        poses[:, 2] = np.unwrap(poses[:, 2])
        return State(poses, markers, points[:known], values.atVector(W(0)))

    def native(self, kernel=None, late=None, weight=None):
        """GTSAM's part: priors, sightings of poses and ranges, with their weights (all 1 if None).

        `kernel` is GTSAM's robust kernel of sightings, `late` that of ranges; None is the quadratic.
        """
        graph = gtsam.NonlinearFactorGraph()
        sigma = [GAUGE, GAUGE, self.dataset.vehicle.sigma_heading]
        graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), gtsam.noiseModel.Diagonal.Sigmas(sigma)))
        graph.add(gtsam.PriorFactorVector(W(0), np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
        weight = self.everything() if weight is None else weight
        of_sightings, of_ranges = np.split(weight.astype(float), [len(self.label)])
        for k in np.flatnonzero(of_sightings * self.as_pose):
            i, j, z, covariance = self.sighted[k]
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance / of_sightings[k])
            graph.add(gtsam.BetweenFactorPose2(i, j, z, _robust(kernel, noise)))
        for j in np.flatnonzero(self._orphans(weight)):     # must not be singular
            graph.add(gtsam.PriorFactorPose2(
                L(j), gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, LOOSE)) if self.oriented[j]
                else gtsam.PriorFactorPoint2(P(j), np.zeros(2), gtsam.noiseModel.Isotropic.Sigma(2, LOOSE)))
        for k in np.flatnonzero(of_ranges):
            noise = gtsam.noiseModel.Isotropic.Sigma(1, self.sigma[k] / np.sqrt(of_ranges[k]))
            graph.add(gtsam.RangeFactor2D(X(int(self.tag_row[k])), A(int(self.tag[k])), self.range[k],
                                          _robust(late, noise)))
        for k, position in enumerate(self.guess):
            graph.add(gtsam.PriorFactorPoint2(
                A(k), position, gtsam.noiseModel.Isotropic.Sigma(2, GUESS)))
        return Native(graph, kernel, late, weight)

    def everything(self):
        """Weight 1 for every measurement."""
        return np.ones(len(self.label) + len(self.range))

    def _orphans(self, weight):
        return np.bincount(self.label, weight[:len(self.label)], len(self.marker)) == 0

    def _points(self, state, native):
        """Sightings of points: rows, keys' numbers, root weights (m,), whitened e and derivatives."""
        of = np.flatnonzero((native.weight[:len(self.label)] > 0) & ~self.as_pose)
        row, label = self.sightings.row[of], self.label[of]
        e, *J = point_error(self.sightings.z[of, :2], state.poses[row], state.markers[label, :2])
        C = self.sightings.C[of, :2, :2] / native.weight[of, None, None]
        root = np.swapaxes(np.linalg.cholesky(np.linalg.inv(C)), 1, 2)
        e, J = (root @ e[..., None])[..., 0], [root @ j for j in J]
        size = np.linalg.norm(e, axis=1)
        if native.kernel is None:
            return row, label, np.ones(len(of)), e, J, np.sum(size**2) / 2
        root = np.sqrt([native.kernel.weight(d) for d in size])
        return row, label, root, e, J, sum(native.kernel.loss(d) for d in size)

    def error(self, values, native, U):
        """Half the sum of squares, kernels applied."""
        state = self.state(values)
        e, *_ = linearize(self.factors, state.poses, state.w)
        points = 0.0 if self.as_pose.all() else self._points(state, native)[-1]
        return native.graph.error(values) + np.sum((U @ e[..., None])**2) / 2 + points

    def linear(self, values, native, U, linearized=None):
        """The linearised graph, GTSAM's factors (or what is given as linearized) and ours."""
        state = self.state(values)
        e, *jacobians = linearize(self.factors, state.poses, state.w)
        first, second, by_w = (U @ J for J in jacobians)
        b = -(U @ e[..., None])[..., 0]
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(native.graph.linearize(values) if linearized is None else linearized)
        for i in range(len(e)):
            graph.add(X(i), first[i], X(i + 1), second[i], W(0), by_w[i], b[i])
        if not self.as_pose.all():
            row, label, root, e, (by_pose, by_point), _ = self._points(state, native)
            for i, j, r, A_i, B_i, e_i in zip(row.tolist(), label.tolist(), root, by_pose, by_point, e):
                graph.add(X(i), r * A_i, P(j), r * B_i, -r * e_i)
        return graph

    def eliminate(self, linear):
        """Bayes tree of a linear graph, w last: it touches all poses."""
        if self.ordering is None:
            self.ordering = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, [W(0)])
        try:
            return linear.eliminateMultifrontal(self.ordering)
        except RuntimeError as error:                 # GTSAM's, with the variable and much advice
            reason = str(error).strip().partition("\n")[0]
            raise DatasetError(f"{self.dataset.name}: expected measurements that determine every pose and "
                               f"landmark; the graph of these cannot be solved ({reason})") from None

    def optimize(self, values, native, U, most=40):
        """Gauss-Newton with step halving; returns values, their error and the number of steps."""
        error, steps = self.error(values, native, U), 0
        for steps in range(1, most + 1):
            step = self.eliminate(self.linear(values, native, U)).optimize()
            for _ in range(8):
                candidate = values.retract(step)
                new_error = self.error(candidate, native, U)
                if new_error <= error:
                    break
                step = _halved(step, values.keys())
            else:
                break
            values, error, decrease = candidate, new_error, error - new_error
            if decrease <= LEAST * (1 + error):
                break
        return values, error, steps

    def log_evidence(self, values, native, slip, linearized=None):
        """Laplace evidence of a slip, up to a constant of the dataset and the weights.

        -e - sum log|Q| / 2 - log|R|, with the graph's error e at its optimum, the noise Q of the
        odometry factors and the square root information R of all variables. The optimum is looked
        for in the graph linearised at `values`, which is exact to second order of the way there.
        """
        U, log_det = self.factors.whitening(slip)
        linear = self.linear(values, native, U, linearized)
        tree = self.eliminate(linear)
        return -linear.error(tree.optimize()) - np.sum(log_det) / 2 - tree.logDeterminant()

    def residuals(self, state):
        """Whitened differences from the measurements: of sightings (s, 3), of ranges (r,), > 0 if late."""
        s = self.sightings
        r = s.z - se2.between(state.poses[s.row], state.markers[self.label])
        r[:, 2] = se2.wrap(r[:, 2]) * self.as_pose
        distance = np.hypot(*(state.antennas[self.tag] - state.poses[self.tag_row, :2]).T)
        root = np.linalg.cholesky(np.where(self.as_pose[:, None, None], s.C, _without_heading(s.C)))
        return np.linalg.solve(root, r[..., None])[..., 0], (self.range - distance) / self.sigma

    def marginals(self, state, U, native):
        """Covariances at the optimum, in GTSAM's axes.

        Returns
        -------
        joint : (f-1, 9, 9) of [X_i, X_{i+1}, w].
        blocks : list of the covariances of every marker (3, 3) or (2, 2), antenna (2, 2), and of w.
        """
        _, *jacobians = linearize(self.factors, state.poses, state.w)
        size = np.r_[np.where(self.oriented, 3, 2), np.full(len(self.antenna), 2), 3]
        begin = np.cumsum(size) - size
        measured = [(row, begin[landmark, None] + np.arange(by_landmark.shape[2]), by_pose, by_landmark)
                    for row, landmark, by_pose, by_landmark in self._whitened(state, native)]
        prior = np.zeros(begin[-1] + 3)
        for j in np.flatnonzero(self._orphans(native.weight)):
            prior[begin[j]:begin[j] + size[j]] = LOOSE**-2
        prior[begin[len(self.marker)]:begin[-1]] = GUESS**-2
        prior[begin[-1]:] = 1
        of_first = np.array([GAUGE, GAUGE, self.dataset.vehicle.sigma_heading])**-2.0
        joint, border = marginals([U @ J for J in jacobians], measured, (np.diag(of_first), prior))
        return joint, [border[b:b + n, b:b + n] for b, n in zip(begin, size)]

    def _whitened(self, state, native):
        """(row, landmark, by_pose, by_landmark) of sightings of poses, of points, and of ranges."""
        s = self.sightings
        weight, of_ranges = np.split(native.weight.astype(float), [len(self.label)])
        of = np.flatnonzero((weight > 0) & self.as_pose)
        noise = se2.rotate_covariance(s.C[of], -s.z[of, 2]) / weight[of, None, None]
        root = np.swapaxes(np.linalg.cholesky(np.linalg.inv(noise)), 1, 2)
        e, by_pose, by_marker, _ = between_error(s.z[of], state.poses[s.row[of]],
                                                 state.markers[self.label[of]])
        if native.kernel is not None:
            size = np.linalg.norm(root @ e[..., None], axis=(1, 2))
            root *= np.sqrt([native.kernel.weight(d) for d in size])[:, None, None]
        yield s.row[of], self.label[of], root @ by_pose, root @ by_marker
        if not self.as_pose.all():
            row, label, root, _, J, _ = self._points(state, native)
            yield row, label, *(root[:, None, None] * j for j in J)
        of = np.flatnonzero(of_ranges)
        e, *J = range_error(self.range[of], state.poses[self.tag_row[of]], state.antennas[self.tag[of]])
        root = np.sqrt(of_ranges[of]) / self.sigma[of]
        if native.late is not None:
            root *= np.sqrt([native.late.weight(d) for d in -root * e])     # measured minus expected
        yield self.tag_row[of], len(self.marker) + self.tag[of], *(root[:, None, None] * j for j in J)


@dataclass(frozen=True)
class Native:
    """GTSAM's factors, and what they were made with."""

    graph: gtsam.NonlinearFactorGraph
    kernel: gtsam.noiseModel.mEstimator.Base | None
    late: gtsam.noiseModel.mEstimator.Base | None
    weight: np.ndarray


def _robust(kernel, noise):
    return gtsam.noiseModel.Robust.Create(kernel, noise) if kernel else noise


def _without_heading(C):
    """Covariances (s, 3, 3) with the heading on its own, of variance 1."""
    alone = C.copy()
    alone[:, 2, :2] = alone[:, :2, 2] = 0
    alone[:, 2, 2] = 1
    return alone


def _halved(step, keys):
    half = gtsam.VectorValues()
    for key in keys:
        half.insert(key, step.at(key) / 2)
    return half
