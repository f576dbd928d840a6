"""Problem 3: SLAM with GTSAM on odometry and markers, self-calibrating.

A factor graph over the graph poses X_i (pose 1, every measured pose, the last pose), the markers
L_j and the wheel parameters w = [R_R, R_L, b], as deviations from their nominal values in units of
their sigmas:

* a prior on pose 1, which fixes the world frame, and the prior of table 2 on w;
* a between factor for every sighting, Z_ij = X_i^-1 L_j; a Cauchy kernel, narrowed round by round,
  finds the wrong labels, and the last rounds do without them and without a kernel;
* an odometry factor between consecutive graph poses, which depends on w too:

      e = log(Delta_i(w)^-1 X_i^-1 X_{i+1}),    Delta_i(w) = Delta_i(0) + dDelta_i/dw w,

  with the noise of rounding and slip (`odometry.increment_noise`). The errors of w repeat in every
  increment; as a variable of the graph they do, as noise of independent factors they could not.

Frames. GTSAM perturbs a pose on the right, X <- X exp(xi): its covariances are those of the
pose's error in the pose's own axes. A between factor's noise lives in the axes of the measured pose
Z, so a covariance given in the axes of the vehicle is turned by R(delta)^T, and a marginal is turned
by R(delta) before it leaves this module.

The odometry factors are linearised in numpy, all at once, and added to GTSAM's linearisation of the
others: a custom factor in Python would copy all values at every call.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, W, X
from scipy.optimize import minimize_scalar

from slamlib import odometry, se2
from slamlib.factors import (between_error, least_noise, linearize, odometry_factors,
                             vehicle_with)
from slamlib.fusion import SLIPS, TYPICAL_SLIP, log_slip_prior
from slamlib.localization import localize, most_certain
from slamlib.marginals import marginals
from slamlib.odometry import wheel_sigmas
from slamlib.ties import GATE, gather

GAUGE = 1e-6                 # m, sigma of the position of pose 1, which is zero by definition
CAUCHY = (100.0, 30.0, 10.0, 3.0)   # scale of the kernel in sigmas, round after round
LOOSE = 1e5                  # m and rad, sigma of a marker that no sighting holds
REPEATS = 4                  # at most, of learning the slip and judging the sightings anew
LEAST = 1e-6                 # relative decrease of the error at which iterations end


@dataclass(frozen=True)
class Slam:
    """What the graph says of every encoder pose, of the markers and of the wheels."""

    poses: np.ndarray               # (n, 3) world frame
    covariances: np.ndarray         # (n, 3, 3)
    marker: np.ndarray              # (k,) ids, ascending, of markers that most sightings agree on
    marker_in_world: np.ndarray     # (k, 3)
    marker_covariance: np.ndarray   # (k, 3, 3) of [x, y, heading] in world axes
    wheel: np.ndarray               # (3,) R_R, R_L, b
    wheel_covariance: np.ndarray    # (3, 3)
    slip: float                     # sqrt(m), as given or learned
    model: str                      # "arc" or "euler", as given or chosen
    log_evidence: float             # Laplace, up to a constant of the dataset
    chi2_per_dof: float             # twice the error over the degrees of freedom
    outlier: np.ndarray             # (s,) bool, gathered sightings beyond the 99.9 % quantile
    residual: np.ndarray            # (s, 3) whitened residuals of the sightings


class Graph:
    """The graph of one dataset and one model of the increments."""

    def __init__(self, dataset, model, also=(), wheels="variable"):
        self.dataset, self.model, self.wheels = dataset, model, wheels
        self.sightings = gather(dataset.aruco, also=[0, len(dataset.ticks) - 1, *also])
        self.frame = self.sightings.frame
        self.factors = odometry_factors(dataset.ticks, dataset.vehicle, self.frame, model, wheels)
        self.marker, self.label = np.unique(self.sightings.marker, return_inverse=True)
        s = self.sightings
        noise = se2.rotate_covariance(s.C, -s.z[:, 2])
        self.measured = [(X(int(i)), L(int(j)), gtsam.Pose2(*z), gtsam.noiseModel.Gaussian.Covariance(c))
                         for i, j, z, c in zip(s.row, self.label, s.z, noise)]

    def relinearize(self, values):
        """Make the increments linear about the wheels that the values have."""
        self.factors = odometry_factors(self.dataset.ticks, self.dataset.vehicle, self.frame, self.model,
                                        self.wheels, values.atVector(W(0)))

    def native(self, cauchy=None, kept=None):
        """GTSAM's part: priors, and the kept sightings (all if None), with a Cauchy kernel if any."""
        graph = gtsam.NonlinearFactorGraph()
        sigma = [GAUGE, GAUGE, self.dataset.vehicle.sigma_heading]
        graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), gtsam.noiseModel.Diagonal.Sigmas(sigma)))
        graph.add(gtsam.PriorFactorVector(W(0), np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
        kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(cauchy) if cauchy else None
        for k, (i, j, z, noise) in enumerate(self.measured):
            if kept is None or kept[k]:
                model = gtsam.noiseModel.Robust.Create(kernel, noise) if cauchy else noise
                graph.add(gtsam.BetweenFactorPose2(i, j, z, model))
        if kept is not None:                     # what no sighting holds must not be singular
            for j in np.setdiff1d(self.label, self.label[kept]):
                graph.add(gtsam.PriorFactorPose2(
                    L(int(j)), gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, LOOSE)))
        return graph

    def initial(self, landmarks="consensus"):
        """Odometry's poses, and the markers where `landmarks` (one of LANDMARKS) puts them."""
        d, s = self.dataset, self.sightings
        poses, covariances = odometry.first_order(d.ticks, d.vehicle, model=self.model)
        seen_from = self.frame[s.row]
        A, B = se2.compose_jacobians(poses[seen_from], s.z)
        spread = A @ covariances[seen_from] @ np.swapaxes(A, 1, 2) + B @ s.C @ np.swapaxes(B, 1, 2)
        in_world = se2.compose(poses[seen_from], s.z)
        return self.values(poses[self.frame], LANDMARKS[landmarks](self, in_world, spread), np.zeros(3))

    def values(self, poses, markers, w):
        values = gtsam.Values()
        for i, pose in enumerate(poses):
            values.insert(X(i), gtsam.Pose2(*pose))
        for j, pose in enumerate(markers):
            values.insert(L(j), gtsam.Pose2(*pose))
        values.insert(W(0), w)
        return values

    def poses(self, values):
        """Graph poses (f, 3), headings continuous, and markers (k, 3)."""
        def rows(key, count):
            each = (values.atPose2(key(i)) for i in range(count))
            return np.array([[p.x(), p.y(), p.theta()] for p in each]).reshape(-1, 3)
        poses = rows(X, len(self.frame))
        poses[:, 2] = np.unwrap(poses[:, 2])
        return poses, rows(L, len(self.marker))

    def error(self, values, native, U):
        e, *_ = linearize(self.factors, self.poses(values)[0], values.atVector(W(0)))
        return native.error(values) + np.sum((U @ e[..., None])**2) / 2

    def linear(self, values, native, U):
        """The linearised graph, GTSAM's factors and ours."""
        e, *jacobians = linearize(self.factors, self.poses(values)[0], values.atVector(W(0)))
        first, second, by_w = (U @ J for J in jacobians)
        b = -(U @ e[..., None])[..., 0]
        graph = native.linearize(values)
        for i in range(len(e)):
            graph.add(X(i), first[i], X(i + 1), second[i], W(0), by_w[i], b[i])
        return graph

    def optimize(self, values, native, U, most=40):
        """Gauss-Newton with step halving; returns values, their error and the number of steps."""
        error, steps = self.error(values, native, U), 0
        for steps in range(1, most + 1):
            step = self.linear(values, native, U).eliminateMultifrontal().optimize()
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

    def marginals(self, values, U, kept):
        """Covariances of consecutive poses with w, (f-1, 9, 9), and of markers and w, at the optimum."""
        poses, markers = self.poses(values)
        _, *jacobians = linearize(self.factors, poses, values.atVector(W(0)))
        s, label = self.sightings, self.label[kept]
        row, z = s.row[kept], s.z[kept]
        root = np.linalg.cholesky(np.linalg.inv(se2.rotate_covariance(s.C[kept], -z[:, 2])))
        _, by_pose, by_marker, _ = between_error(z, poses[row], markers[label])
        whitened = (np.swapaxes(root, 1, 2) @ J for J in (by_pose, by_marker))
        loose = np.bincount(label, minlength=len(markers)) == 0
        prior = (np.diag(np.array([GAUGE, GAUGE, self.dataset.vehicle.sigma_heading])**-2.0), np.eye(3),
                 loose[:, None, None] / LOOSE**2 * np.eye(3))
        return marginals([U @ J for J in jacobians], (row, label, *whitened), prior)

    def residuals(self, values):
        """(s, 3) whitened differences of the sightings from the values: of unit variance."""
        poses, markers = self.poses(values)
        s = self.sightings
        r = s.z - se2.between(poses[s.row], markers[self.label])
        r[:, 2] = se2.wrap(r[:, 2])
        return np.linalg.solve(np.linalg.cholesky(s.C), r[..., None])[..., 0]

    def log_evidence(self, values, native, slip, kept):
        """Values at the optimum for this slip and their Laplace evidence, up to a constant.

        -e - sum log|Q| / 2 - log|R|, with the graph's error e, the noise Q of the odometry factors
        and the square root information R of all variables. A sighting left out costs what one at the
        gate would, and a marker that none holds adds nothing, so that graphs which leave out other
        sightings can be compared.
        """
        U, log_det = self.factors.whitening(slip)
        values, error, _ = self.optimize(values, native, U)
        tree = self.linear(values, native, U).eliminateMultifrontal()
        orphans = len(np.setdiff1d(self.label, self.label[kept]))
        return values, (-error - np.sum(log_det) / 2 - tree.logDeterminant()
                        - np.count_nonzero(~kept) * GATE / 2 - 3 * orphans * np.log(LOOSE))


def _first(graph, in_world, spread):
    return in_world[np.unique(graph.label, return_index=True)[1]]


def _most_certain(graph, in_world, spread):
    order = np.lexsort((np.linalg.slogdet(spread)[1], graph.label))
    return in_world[order[np.unique(graph.label[order], return_index=True)[1]]]


def _mean(graph, in_world, spread):
    """Average by information, of angles about the most certain sighting's."""
    middle = _most_certain(graph, in_world, spread)[graph.label]
    apart = in_world - middle
    apart[:, 2] = se2.wrap(apart[:, 2])
    information = np.linalg.inv(spread)
    total, moment = np.zeros((len(graph.marker), 3, 3)), np.zeros((len(graph.marker), 3))
    np.add.at(total, graph.label, information)
    np.add.at(moment, graph.label, (information @ apart[..., None])[..., 0])
    return _first(graph, middle, None) + np.linalg.solve(total, moment[..., None])[..., 0]


def _consensus(graph, in_world, spread):
    return in_world[most_certain(graph.label, in_world, spread)]


def _from_problem2(graph, in_world, spread):
    """Problem 2's map, and the consensus for markers that it does not have."""
    markers = _consensus(graph, in_world, spread)
    found = localize(graph.dataset.aruco)
    if found.frame[0] == 0 and np.isfinite(found.poses[0, 0]):          # the same world
        has = np.isin(graph.marker, found.marker)
        markers[has] = found.marker_in_world[np.searchsorted(found.marker, graph.marker[has])]
    return markers


LANDMARKS = {"first sighting": _first, "most certain sighting": _most_certain,
             "mean by information": _mean, "consensus": _consensus, "problem 2's map": _from_problem2}


def _halved(step, keys):
    half = gtsam.VectorValues()
    for key in keys:
        half.insert(key, step.at(key) / 2)
    return half


def solve(dataset, slip=None, model=None):
    """SLAM on odometry and markers.

    Parameters
    ----------
    dataset : Dataset with markers.
    slip : sqrt(m), standard deviation of a wheel's slip after one metre; None learns it by maximizing
        the Laplace evidence.
    model : "arc" or "euler"; None takes the one of greater evidence (at the arc's slip).

    Returns
    -------
    Slam
    """
    found = solve_graph(Graph(dataset, model or "arc"), slip)
    if model is None:
        other = solve_graph(Graph(dataset, "euler"), found[3], start=found[1])
        if other[-1] > found[-1]:
            found = other if slip is not None else solve_graph(Graph(dataset, "euler"), None, start=other[1])
    return result(*found)


def evidence_curve(dataset, slips, model="arc"):
    """Log evidence (len(slips),) of values of the slip, each at its own optimum."""
    graph, values, kept, _, _ = solve_graph(Graph(dataset, model), slips[0])
    native, curve = graph.native(kept=kept), []
    for slip in slips:
        values, evidence = graph.log_evidence(values, native, slip, kept)
        curve.append(evidence)
    return np.array(curve)


def solve_graph(graph, slip=None, landmarks="consensus", start=None):
    """Optimum of a Graph: (graph, values, kept, slip, log evidence), as `result` takes them.

    Rounds with an ever narrower Cauchy kernel find the sightings that agree; on them, without a
    kernel, the slip of greatest evidence times prior is looked for (unless given). `start` are values
    near the optimum, instead of odometry and `landmarks`: one round with the last kernel is enough.
    """
    values = graph.initial(landmarks) if start is None else start
    U, _ = graph.factors.whitening(max(TYPICAL_SLIP if slip is None else slip, SLIPS[0]))
    for cauchy in CAUCHY if start is None else CAUCHY[-1:]:
        values, _, _ = graph.optimize(values, graph.native(cauchy), U)

    def agreeing():
        return np.sum(graph.residuals(values)**2, axis=1) < GATE

    def cost(log_slip):
        nonlocal values
        values, evidence = graph.log_evidence(values, native, np.exp(log_slip), kept)
        return -evidence - log_slip_prior(log_slip)

    kept, learned = agreeing(), slip
    for _ in range(REPEATS):                   # wheels, slip and the sightings that agree, in turn
        graph.relinearize(values)
        native = graph.native(kept=kept)
        if slip is None:
            learned = np.exp(minimize_scalar(cost, bounds=np.log(SLIPS), method="bounded",
                                             options={"xatol": 0.1}).x)
        learned = float(max(learned, SLIPS[0]))
        values, evidence = graph.log_evidence(values, native, learned, kept)
        before, kept = kept, agreeing()
        if (kept == before).all():
            break
    kept = before
    return graph, values, kept, learned, evidence


def result(graph, values, kept, slip, evidence):
    """Every encoder pose, the markers and the wheels, with covariances in world axes."""
    vehicle = graph.dataset.vehicle
    U, _ = graph.factors.whitening(slip)
    native = graph.native(kept=kept)
    poses, markers = graph.poses(values)
    w = values.atVector(W(0))
    joint, border = graph.marginals(values, U, kept)
    every = _between_frames(graph, poses, joint, w, slip)
    agreeing, others = (np.bincount(graph.label[which], minlength=len(graph.marker))
                        for which in (kept, ~kept))
    held = np.flatnonzero(agreeing > others)      # the rest: nobody knows which sighting is right
    blocks = border.reshape(len(markers) + 1, 3, -1, 3)
    spread, of_w = blocks[held, :, held], blocks[-1, :, -1]
    markers = markers[held]
    markers[:, 2] = se2.wrap(markers[:, 2])
    sigma_w = wheel_sigmas(vehicle)
    wheel = np.array([vehicle.right_radius, vehicle.left_radius, vehicle.wheelbase]) + sigma_w * w
    freedom = 3 * (np.count_nonzero(kept) - np.count_nonzero(agreeing))   # odometry, priors: none
    return Slam(*every, graph.marker[held], markers, se2.rotate_covariance(spread, markers[:, 2]),
                wheel, sigma_w[:, None] * of_w * sigma_w, slip, graph.model,
                float(evidence), 2 * graph.error(values, native, U) / max(1, freedom), ~kept,
                graph.residuals(values))


def _between_frames(graph, poses, joint, w, slip):
    """Poses (n, 3) and covariances (n, 3, 3) of every encoder pose, given the graph's.

    Between two graph poses a and b a pose depends on nothing but them and w: X_a Delta_ak(w) and
    X_b Delta_kb(w)^-1 are two estimates of it with the independent noise of the encoder steps before
    and after, and their average by information is exact to first order.

    `joint` (f-1, 9, 9) are the covariances of [X_i, X_{i+1}, w] in GTSAM's axes.
    """
    ticks, vehicle = graph.dataset.ticks, vehicle_with(graph.dataset.vehicle, w)
    turned = np.zeros_like(joint)
    turned[:, range(9), range(9)] = 1
    turned[:, :2, :2], turned[:, 3:5, 3:5] = (se2.rotation(poses[rows, 2])
                                              for rows in (slice(-1), slice(1, None)))
    joint = turned @ joint @ np.swapaxes(turned, 1, 2)

    last = np.searchsorted(graph.frame, np.arange(len(ticks)), side="right") - 1
    all_poses = poses[last].copy()
    covariances = np.concatenate([joint[:, :3, :3], joint[-1:, 3:6, 3:6]])[last]
    between = np.flatnonzero(~np.isin(np.arange(len(ticks)), graph.frame))
    if not len(between):
        return all_poses, covariances
    a, b = last[between], last[between] + 1
    sigma_w = wheel_sigmas(vehicle)

    def increment(start, end):
        delta, by_w = odometry.increments(ticks, vehicle, start, end, graph.model)
        by_w = by_w * sigma_w * (graph.wheels == "variable")
        noise = odometry.increment_noise(ticks, vehicle, start, end, slip)
        noise[:, [0, 1], [0, 1]] += least_noise(vehicle)
        return delta, by_w, noise

    forward, forward_by_w, noise = increment(graph.frame[a], between)
    A, B = se2.compose_jacobians(poses[a], forward)
    N_a = B @ noise @ np.swapaxes(B, 1, 2)
    ahead, ahead_by_w, noise = increment(between, graph.frame[b])
    back = se2.inverse(ahead)
    A_b, B_b = se2.compose_jacobians(poses[b], back)
    B_b = B_b @ se2.inverse_jacobian(ahead)
    N_b = B_b @ noise @ np.swapaxes(B_b, 1, 2)

    gain = N_a @ np.linalg.inv(N_a + N_b)
    rest = np.eye(3) - gain
    estimate, other = se2.compose(poses[a], forward), se2.compose(poses[b], back)
    difference = other - estimate
    difference[:, 2] = se2.wrap(difference[:, 2])
    F = np.concatenate([rest @ A, gain @ A_b,
                        rest @ B @ forward_by_w + gain @ B_b @ ahead_by_w], axis=2)
    all_poses[between] = estimate + np.einsum("nij,nj->ni", gain, difference)
    covariances[between] = F @ joint[a] @ np.swapaxes(F, 1, 2) + rest @ N_a
    return all_poses, (covariances + np.swapaxes(covariances, 1, 2)) / 2
