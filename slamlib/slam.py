"""Problems 3 and 4: SLAM with GTSAM on odometry, markers and ranges, self-calibrating.

`graph.py` has the factors, `initial.py` the values to start from; here they are solved: rounds with
an ever narrower Cauchy kernel find the measurements that agree; on these, without a kernel, the
slip of greatest evidence is looked for, and with it everything is judged anew.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.optimize import minimize_scalar

from slamlib import initial, odometry, se2
from slamlib.between import between_frames
from slamlib.fusion import SLIPS, TYPICAL_SLIP, log_slip_prior
from slamlib.graph import Graph, State

CAUCHY = (100.0, 30.0, 10.0, 3.0)   # scale of the kernel in sigmas, round after round
REPEATS = 4                  # at most, of learning the slip and judging the measurements anew
WHEELS = {"variable": "wheels as a variable", "independent": "independent chain",
          "fixed": "wheels fixed"}
DECISIVE = 3.0               # log evidence by which the data must prefer a slip to TYPICAL_SLIP, or Euler's
                             # steps to arcs, to be believed
UNSURE = 0.025               # largest sigma of an antenna, in distances to it, that is not in doubt
FEWEST = 5                   # ranges below which an antenna's place is not to be relied on

_kernel, _one_sided = gtsam.noiseModel.mEstimator, gtsam.noiseModel.mEstimator.Base.ReweightScheme.Scalar
# Ways to treat ranges: GTSAM's kernel, if any, and how many sigmas too short and too long a range may
# be before it is left out. A one-sided kernel needs the sign of the error, so it weighs components: it
# forgives ranges that are too long and is quadratic for those too short, hence the gate for these.
RANGES = {
    "quadratic": (None, np.inf, np.inf),
    "Huber": (_kernel.Huber.Create(1.345), np.inf, np.inf),
    "Cauchy": (_kernel.Cauchy.Create(2.385), np.inf, np.inf),
    "asymmetric Cauchy": (_kernel.AsymmetricCauchy.Create(2.385, _one_sided), 3.3, np.inf),
    "asymmetric Tukey": (_kernel.AsymmetricTukey.Create(4.685, _one_sided), 3.3, np.inf),
    "GNC": (None, 3.3, 3.3),
    "gate": (None, 3.3, 3.3),
    "asymmetric gate": (None, 3.3, 2.0)}
# Ways to treat sightings: GTSAM's kernel, if any, and whether those beyond the gate are left out.
SIGHTINGS = {
    "quadratic": (None, False),
    "Huber": (_kernel.Huber.Create(1.345), False),
    "Cauchy": (_kernel.Cauchy.Create(2.385), False),
    "Geman-McClure": (_kernel.GemanMcClure.Create(3.0), False),
    "Tukey": (_kernel.Tukey.Create(4.685), False),
    "gate": (None, True)}


@dataclass(frozen=True)
class Slam:
    """What the graph says of every encoder pose, of the landmarks and of the wheels."""

    poses: np.ndarray               # (n, 3) world frame
    covariances: np.ndarray         # (n, 3, 3)
    marker: np.ndarray              # (k,) ids, ascending, of markers that most sightings agree on
    marker_in_world: np.ndarray     # (k, 3)
    marker_covariance: np.ndarray   # (k, 3, 3) of [x, y, heading] in world axes
    antenna: np.ndarray             # (a,) ids, ascending, of antennas with ranges
    antenna_in_world: np.ndarray    # (a, 2)
    antenna_covariance: np.ndarray  # (a, 2, 2)
    doubts: dict                    # antenna id: sentence, for those not to be relied on
    wheel: np.ndarray               # (3,) R_R, R_L, b
    wheel_covariance: np.ndarray    # (3, 3)
    slip: float                     # sqrt(m), as given or learned
    model: str                      # "arc" or "euler", as given or chosen
    log_evidence: float             # Laplace, up to a constant of the dataset and of what is left out
    chi2_per_dof: float             # twice the error over the degrees of freedom
    outlier: np.ndarray             # (s,) bool, gathered sightings beyond the 99.9 % quantile
    residual: np.ndarray            # (s, 3) whitened residuals of the sightings
    range_weight: np.ndarray        # (r,) share of its information that each range keeps, 0 to 1
    range_residual: np.ndarray      # (r,) whitened, positive for a range that is too long


@dataclass(frozen=True)
class Optimum:
    """A solved Graph."""

    graph: Graph
    values: gtsam.Values
    weight: np.ndarray              # (s + r,) of the measurements: 0 where left out
    slip: float
    log_evidence: float
    kernel: object = None           # GTSAM's kernel of sightings, if any
    late: object = None             # and of ranges


def solve(dataset, slip=None, model=None, after=None):
    """SLAM on odometry and on the markers and ranges that the dataset has.

    Parameters
    ----------
    dataset : Dataset with markers, ranges or both.
    slip : sqrt(m), standard deviation of a wheel's slip after one metre; None learns it by maximizing
        the Laplace evidence, with a wide prior where the data say little.
    model : "arc" or "euler"; None takes the arc unless the evidence of Euler's step is DECISIVE.
    after : Slam of the same drive with fewer sensors, whose poses, model and slip to start from.

    Returns
    -------
    Slam
    """
    if after is not None:
        graph = Graph(dataset, model or after.model)
        graph.about((after.wheel - dataset.vehicle.wheel) / dataset.vehicle.sigma_wheel)
        start = initial.at(graph, after.poses[graph.frame], after.covariances[graph.frame], graph.w)
        return result(solve_graph(graph, slip, start=start))
    best = solve_graph(Graph(dataset, model or "arc"), slip)
    decisive = best.log_evidence + DECISIVE
    if model is None and _ceiling(best, "euler", slip) > decisive - 1:    # or the search can be spared
        other = compared(best, "euler", "variable", slip)
        best = other if other.log_evidence > decisive else best
    return result(best)


def _ceiling(optimum, model, slip):
    """About the greatest log evidence of another model of increments, on the same measurements.

    For None as slip it is that of the slip that suits the model best, on the linearised graph.
    """
    graph, native = _explaining(optimum, model)
    U, _ = graph.factors.whitening(optimum.slip)
    values, _, _ = graph.optimize(optimum.values, native, U, most=2)
    log_evidence = _of_slip(graph, values, native)
    return log_evidence(np.log(optimum.slip)) if slip is not None else _highest(log_evidence)[1]


def _explaining(optimum, model):
    """Graph of another model of increments, about the optimum's wheels, and its Native on the same
    measurements.
    """
    graph = Graph(optimum.graph.dataset, model)
    graph.about(graph.state(optimum.values).w)
    return graph, graph.native(optimum.kernel, optimum.late, optimum.weight)


def _of_slip(graph, values, native):
    """The log evidence as a function of the logarithm of the slip, on the graph linearised at `values`."""
    linearized = native.graph.linearize(values)
    return lambda log_slip: graph.log_evidence(values, native, np.exp(log_slip), linearized)


def compared(optimum, model, wheels, slip=None):
    """The Optimum of another model of increments or wheels, on the same measurements."""
    other = Graph(optimum.graph.dataset, model, wheels=wheels)
    return solve_graph(other, slip, start=optimum.values, weight=optimum.weight)


def kinds(dataset, slip=None):
    """Yield (wheels, model, Slam, log evidence) of every kind of graph, to compare them.

    Each is solved on its own; the evidence is that on the sightings which the graph with the wheels
    as a variable and arcs keeps, since evidence compares explanations of the same data only.
    """
    first = solve_graph(Graph(dataset, "arc"), slip)
    for wheels in WHEELS:
        for model in odometry.MODELS:
            own = first if (wheels, model) == ("variable", "arc") else solve_graph(
                Graph(dataset, model, wheels=wheels), slip)
            yield wheels, model, result(own), compared(first, model, wheels, slip).log_evidence


def evidence_curve(optimum, slips, model):
    """Log evidence (len(slips),) of values of the slip, each at its own optimum.

    `optimum` is the Optimum whose measurements are to be explained, whatever the model.
    """
    (graph, native), values, curve = _explaining(optimum, model), optimum.values, []
    for slip in slips:
        values, _, _ = graph.optimize(values, native, graph.factors.whitening(slip)[0])
        curve.append(graph.log_evidence(values, native, slip))
    return np.array(curve)


def solve_graph(graph, slip=None, landmarks="consensus", start=None, weight=None,
                sightings="gate", ranges="asymmetric Tukey", antennas="trilateration"):
    """The Optimum of a Graph.

    Parameters
    ----------
    slip : sqrt(m), or None to learn it.
    landmarks, antennas : one of `initial.LANDMARKS` and one of `initial.ANTENNAS`.
    start : values near the optimum, instead of odometry and `landmarks`: one round is enough.
    weight : (s + r,) of the measurements; by default what agrees has weight 1.
    sightings, ranges : one of SIGHTINGS and one of RANGES.
    """
    (kernel, gated), (late, *gate) = SIGHTINGS[sightings], RANGES[ranges]
    U, _ = graph.factors.whitening(max(TYPICAL_SLIP if slip is None else slip, SLIPS[0]))
    values = _begun(graph, landmarks, sightings, ranges, antennas) if start is None else start
    if weight is None:
        values = _rounds(graph, values, U, sightings, ranges, CAUCHY if start is None else CAUCHY[-1:])

    def judged():
        if ranges == "GNC":
            return graduated(graph, values, U)
        agree = agreeing(graph, values, *gate)
        if not gated:
            agree[:len(graph.label)] = 1
        return agree

    fixed, weight = weight is not None, judged() if weight is None else weight
    learned = TYPICAL_SLIP if slip is None else max(slip, SLIPS[0])
    for _ in range(REPEATS):                # wheels, slip and the measurements that agree, in turn
        graph.about(graph.state(values).w)
        native = graph.native(kernel, late, weight)
        if slip is None:
            values, _, _ = graph.optimize(values, native, graph.factors.whitening(learned)[0], most=2)
            learned = _learned_slip(graph, values, native)
        U, _ = graph.factors.whitening(learned)
        values, _, _ = graph.optimize(values, native, U)
        before, weight = weight, weight if fixed else judged()
        if (weight == before).all():
            break
    return Optimum(graph, values, before, float(learned), graph.log_evidence(values, native, learned),
                   kernel, late)


def _begun(graph, landmarks, sightings, ranges, antennas):
    """Values from odometry, on a long drive part after part."""
    earlier = None
    for count in initial.parts(graph.dataset):
        whole = count == len(graph.dataset.ticks)
        part = graph if whole else Graph(initial.prefix(graph.dataset, count), graph.model,
                                         wheels=graph.wheels)
        values = (initial.from_odometry(part, landmarks, antennas) if earlier is None
                  else initial.grown(part, *earlier))
        if not whole:
            U, _ = part.factors.whitening(TYPICAL_SLIP)
            values = _rounds(part, values, U, sightings, ranges, CAUCHY)
        earlier = part, values
    return values


def _rounds(graph, values, U, sightings, ranges, scales):
    """Values after a round with each scale of the Cauchy kernel, in place of all but convex ones."""
    convex = ("quadratic", "Huber", "GNC")
    for scale in scales:
        cauchy = _kernel.Cauchy.Create(scale)
        native = graph.native(SIGHTINGS[sightings][0] if sightings in convex else cauchy,
                              RANGES[ranges][0] if ranges in convex else cauchy)
        values, _, _ = graph.optimize(values, native, U)
    return values


def _learned_slip(graph, values, native):
    """The slip of greatest evidence, where that decides against TYPICAL_SLIP.

    Otherwise the data say little, or confirm it, and it is the root mean square under the posterior,
    evidence times prior, which is summed about its mode over values of the logarithm half a unit apart:
    slips that are possible beyond the mode count too, as variances do.
    """
    log_evidence = _of_slip(graph, values, native)

    def log_posterior(log_slip):
        return log_evidence(log_slip) + log_slip_prior(log_slip)

    best, most = _highest(log_evidence)
    if most - log_evidence(np.log(TYPICAL_SLIP)) > DECISIVE:
        return float(np.exp(best))
    mode, most = _highest(log_posterior)
    around = mode + np.arange(-4, 5) / 2
    density = np.exp([min(0.0, log_posterior(s) - most) if s != mode else 0.0 for s in around])
    return float(np.clip(np.sqrt(np.sum(density * np.exp(2 * around)) / np.sum(density)), *SLIPS))


def _highest(function):
    """Where a function of the logarithm of the slip is greatest within SLIPS, and how great.

    The search comes near its bounds but never to them, and without slip the lower one is the answer.
    """
    found, least = minimize_scalar(lambda s: -function(s), bounds=np.log(SLIPS), method="bounded",
                                   options={"xatol": 0.05}), np.log(SLIPS[0])
    at_least = function(least)
    return (least, at_least) if at_least > -found.fun else (found.x, -found.fun)


def agreeing(graph, values, early, late):
    """Weight 1 for sightings within the gate and for ranges between -early and late, else 0."""
    of_sightings, of_ranges = graph.residuals(graph.state(values))
    return np.r_[np.sum(of_sightings**2, axis=1) < graph.gate,
                 (of_ranges > -early) & (of_ranges < late)].astype(float)


def graduated(graph, values, U, step=1.4):
    """Weights by graduated non-convexity with truncated least squares (Yang et al., RA-L 2020).

    For comparison: from quadratic to truncated costs of the ranges, a Gauss-Newton step at a time.
    """
    _, *gate = RANGES["GNC"]
    weight, cut, of_ranges = agreeing(graph, values, *gate), gate[0]**2, slice(len(graph.label), None)
    weight[of_ranges], control = 1, None
    while control is None or ((weight > 0) & (weight < 1)).any():
        values, _, _ = graph.optimize(values, graph.native(weight=weight), U,
                                      most=40 if control is None else 1)
        squared = graph.residuals(graph.state(values))[1]**2
        control = step * control if control else cut / max(2 * squared.max() - cut, cut)
        root = np.sqrt(cut * control * (control + 1) / np.maximum(squared, 1e-12)) - control
        weight[of_ranges] = np.clip(root, 0, 1)**2
    return weight


def result(optimum):
    """Every encoder pose, the landmarks and the wheels, with covariances in world axes."""
    graph, values, weight = optimum.graph, optimum.values, optimum.weight
    vehicle = graph.dataset.vehicle
    U, _ = graph.factors.whitening(optimum.slip)
    native = graph.native(optimum.kernel, optimum.late, weight)
    state = graph.state(values)
    joint, blocks = graph.marginals(state, U, native)
    every = between_frames(graph, state, joint, optimum.slip)
    kept, known = weight[:len(graph.label)] > 0, len(graph.marker)
    agree, differ = (np.bincount(graph.label[which], minlength=known) for which in (kept, ~kept))
    held = np.flatnonzero(agree > differ)         # the rest: nobody knows which sighting is right
    spread = np.zeros((known, 3, 3))
    for j, (block, oriented) in enumerate(zip(blocks, graph.oriented)):
        spread[j, :len(block), :len(block)] = block
        if not oriented:                          # of the heading it is known what a sighting says
            spread[j, 2, 2] = graph.sightings.C[graph.label == j, 2, 2].min()
    of_antennas = np.reshape(blocks[known:-1], (-1, 2, 2))
    markers = state.markers[held]
    markers[:, 2] = se2.wrap(markers[:, 2])
    residual, range_residual = graph.residuals(state)
    of_ranges = weight[len(graph.label):]
    if optimum.late is not None:
        of_ranges = of_ranges * [optimum.late.weight(r) for r in range_residual]
    used = np.bincount(graph.label[kept], np.where(graph.as_pose[kept], 3, 2), known)
    freedom = np.sum(np.maximum(used - np.where(graph.oriented, 3, 2), 0)) \
        + np.sum(of_ranges) - 2 * len(graph.antenna)   # odometry, priors: none
    doubts, of_antennas = _doubts(graph, state, every[1][graph.frame], of_antennas, of_ranges)
    scale, calm = vehicle.sigma_wheel, graph.native(weight=np.r_[kept, of_ranges])    # no kernels
    return Slam(*every, graph.marker[held], markers,
                se2.rotate_covariance(spread[held], markers[:, 2] * graph.oriented[held]),
                graph.antenna, state.antennas, of_antennas, doubts,
                vehicle.wheel + scale * state.w, scale[:, None] * blocks[-1] * scale, optimum.slip,
                graph.model, float(optimum.log_evidence),
                2 * graph.error(values, calm, U) / max(1, freedom), ~kept, residual, of_ranges,
                range_residual)


def _doubts(graph, state, of_poses, covariances, weight):
    """Antennas whose place the ranges do not settle.

    Returns
    -------
    doubts : {id: sentence}.
    covariances : (a, 2, 2), for those in doubt of all places that are possible.
    """
    doubts, covariances = {}, covariances.copy()
    each = zip(graph.antenna.tolist(), initial.ranges_of(graph, state.poses, of_poses))
    for k, (antenna, ranges) in enumerate(each):
        count, distance = np.count_nonzero(weight[graph.tag == k] > 0.5), np.median(ranges[1])
        place, cost = initial.places(*ranges, graph.guess[k])
        other = np.hypot(*(place - state.antennas[k]).T) > initial.ONE_PLACE * distance
        possible = place[other & (cost < initial.UNDECIDED)]
        if count < FEWEST:
            doubts[antenna] = f"only {count} of its ranges agree"
        elif len(possible):
            doubts[antenna] = ("its ranges fit as well at " + " and ".join(
                "({:.1f}, {:.1f})".format(*p) for p in possible))
        elif count < len(ranges[1]) / 2:
            doubts[antenna] = f"{len(ranges[1]) - count} of its {len(ranges[1])} ranges disagree"
        elif np.sqrt(np.linalg.eigvalsh(covariances[k])[-1]) > UNSURE * distance:
            doubts[antenna] = "its ranges are too few or come from too few directions"
        if antenna in doubts:
            wide = initial.second_moment(*ranges, graph.guess[k], state.antennas[k])
            covariances[k] = max(covariances[k], wide, key=np.trace)
    return doubts, covariances
