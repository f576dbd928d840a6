"""Gauss-Newton on a factor graph of GTSAM, and the marginal covariances of its solution.

A step linearises all factors, eliminates the variables, which gives the Bayes tree, and moves every
variable by its solution. The steps are driven from here, because inside GTSAM's own optimizers each
call of a custom factor copies all values. Any graph with the keys of `core.graph` is solved, also
with factors and variables of one's own.
"""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import gtsam
import numpy as np

from slamlib.core import se2
from slamlib.core.batch import FixedValues, numbers
from slamlib.core.errors import DatasetError
from slamlib.core.graph import id_of

MAX_VARIANCE = 1e12          # m^2 and rad^2, above which a variable is not determined
CONVERGED = 1e-6             # decrease of the error, over 1 + error, at which steps end
STUCK = 1e-3                 # the same, promised by a step that brings none: steps are stuck
ROUNDING = 1e-12             # relative increase of the error that is due to float rounding
MAX_STEPS = 30               # number of steps of Gauss-Newton
MAX_LENGTHS = 8              # number of lengths of one step, each half of the last
TOGETHER = 64                # number of variables or pairs whose covariance is asked for at once
MAX_CONTRADICTION = 10.0     # sigmas, of a factor at the solution that is consistent

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Marginals:
    """Covariances of variables by the Bayes tree of a linear graph, in GTSAM's axes.

    For one variable QR decomposition finds them. For many Cholesky's is faster, and where it fails
    QR takes its place. Raises DatasetError where the factors do not determine a variable.
    """

    tree: gtsam.GaussianBayesTree

    def covariance(self, key: int) -> np.ndarray:
        """The covariance (d, d) of a variable."""
        root = self.tree.marginalFactor(key, gtsam.EliminateQR).jacobian()[0]
        return covariance_of_root(root, key)

    def pair(self, first: int, second: int) -> np.ndarray:
        """The covariance (d + e, d + e) of two variables."""
        return self._of_groups([[first, second]])[0]

    def neighbours(self, keys: list[int]) -> np.ndarray:
        """The covariances (n - 1, 6, 6) of each of n poses and the next one."""
        pairs = list(pairwise(keys))
        return np.reshape(self._of_groups(pairs), (-1, 6, 6))

    def covariances(self, keys: list[int]) -> list[np.ndarray]:
        """The covariance (d, d) of each variable."""
        return self._of_groups([[key] for key in keys])

    def _of_groups(self, groups):
        """The covariance of each group of one or two variables."""
        covariances = []
        for start in range(0, len(groups), TOGETHER):
            covariances += self._of_few(groups[start:start + TOGETHER])
        return covariances

    def _of_few(self, groups):
        """The same by the covariance of all of them.

        GTSAM walks the tree from them to the root once, in place of once for each group.
        """
        keys = list(dict.fromkeys(chain(*groups)))
        try:
            joint = self.tree.jointMarginalCovariance(keys)
        except RuntimeError:
            return [self._by_qr(*group) for group in groups]
        covariances = []
        for group in groups:
            blocks = [[joint.at(row, column) for column in group] for row in group]
            covariances.append(determined(np.block(blocks), group[0]))
        return covariances

    def _by_qr(self, first, second=None):
        """The covariance of one or two variables."""
        if second is None:
            return self.covariance(first)
        ordering = gtsam.Ordering()
        ordering.push_back(first)
        ordering.push_back(second)
        root = self.tree.joint(first, second, gtsam.EliminateQR).jacobian(ordering)[0]
        return covariance_of_root(np.linalg.qr(root, mode="r"), first)


def determined(covariance: np.ndarray, near: int) -> np.ndarray:
    """The covariance, unless rounding alone determines a variable: then raises DatasetError."""
    if covariance.max() > MAX_VARIANCE:
        raise undetermined(gtsam.DefaultKeyFormatter(near))
    return covariance


def covariance_of_root(root: np.ndarray, key: int) -> np.ndarray:
    """The covariance (d, d) of a variable by the upper triangular root (d, d) of its information.

    Raises DatasetError where it is singular, also but for rounding.
    """
    try:
        inverse = np.linalg.inv(root)
    except np.linalg.LinAlgError:
        raise undetermined(gtsam.DefaultKeyFormatter(key)) from None
    return determined(inverse @ inverse.T, key)


def undetermined(near: str = "") -> DatasetError:
    """The DatasetError for factors that do not determine every variable, `near` one of them."""
    where = f", near {near}" if near else ""
    return DatasetError("expected measurements that determine every pose and landmark, found some "
                        f"that do not{where}")


@dataclass(frozen=True)
class GaussNewton:
    """The end of Gauss-Newton."""

    values: gtsam.Values
    error: float             # half the sum of squared whitened errors, or kernels' losses
    steps: int               # number of steps
    converged: bool          # whether the error had stopped falling, at a minimum
    marginals: Marginals     # of all variables in GTSAM's axes, where the last step was linearised


@dataclass(frozen=True)
class GraphSolution(GaussNewton):
    """Poses and maps at the solution of a graph, covariances in world axes: m, m, rad.

    A marker without heading has a NaN heading. It is `converged` if no factor contradicts it.
    """

    graph: gtsam.NonlinearFactorGraph
    pose: np.ndarray                # (f,) rows of the encoder file, from 0, ascending
    poses: np.ndarray               # (f, 3)
    covariances: np.ndarray         # (f, 3, 3)
    marker: np.ndarray              # (k,) ids, ascending
    marker_in_world: np.ndarray     # (k, 3)
    marker_covariance: np.ndarray   # (k, 3, 3)
    antenna: np.ndarray             # (a,) ids, ascending
    antenna_in_world: np.ndarray    # (a, 2)
    antenna_covariance: np.ndarray  # (a, 2, 2)
    contradiction: str              # a sentence on the factor that contradicts most, or ""


def solve_graph(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> GraphSolution:
    """The GraphSolution of a graph from initial values.

    Raises DatasetError if graph and values do not fit each other, or, with a variable, if the
    factors do not determine every one.
    """
    require_values(graph, values)
    try:
        found = gauss_newton(graph, values)
        covariance_of = found.marginals.covariance
        pose, poses, covariances = in_world(found.values, "x", covariance_of)
        marker, marker_in_world, marker_covariance = in_world(found.values, "lp", covariance_of)
        antenna, antennas, antenna_covariance = in_world(found.values, "a", covariance_of)
        worst = contradiction(graph, found.values)
    except RuntimeError as failure:                      # GTSAM's, on types and numbers
        reason = str(failure).strip().partition("\n")[0]
        raise DatasetError("solve_graph: expected finite numbers, and values of the types that the "
                           f"factors have: gtsam.Pose2 or Point2, found: {reason}") from None
    if worst:
        LOG.warning(worst)
    if not found.converged:
        LOG.warning("the error still falls after %d steps, to %.4g, or no step lowers it",
                    found.steps, found.error)
    end = replace(found, converged=found.converged and not worst)
    return GraphSolution(
        **vars(end), graph=graph,
        pose=pose, poses=poses, covariances=covariances,
        marker=marker, marker_in_world=marker_in_world, marker_covariance=marker_covariance,
        antenna=antenna, antenna_in_world=antennas[:, :2],
        antenna_covariance=antenna_covariance[:, :2, :2], contradiction=worst)


def require_values(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values):
    """Raise DatasetError unless the values are those of the variables of the graph."""
    if not isinstance(graph, gtsam.NonlinearFactorGraph) or not isinstance(values, gtsam.Values):
        raise DatasetError("solve_graph: expected a gtsam.NonlinearFactorGraph and gtsam.Values")
    variables = set(graph.keyVector())
    given = set(values.keys())
    if not variables:
        raise DatasetError("solve_graph: expected factors, found none")
    for key in sorted(variables ^ given):
        name = gtsam.DefaultKeyFormatter(key)
        missing = "an initial value" if key in variables else "a factor"
        raise DatasetError(f"solve_graph: expected {missing} of every variable, found none of "
                           f"{name}")


def gauss_newton(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values,
                 max_steps: int = MAX_STEPS, max_lengths: int = MAX_LENGTHS) -> GaussNewton:
    """The end of Gauss-Newton on a graph from initial values.

    At most `max_lengths` of each step are tried, each half of the last. Raises DatasetError, which
    names a variable, if the factors do not determine every one.
    """
    values = FixedValues(values)
    error = graph.error(values)
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    for steps in range(1, max_steps + 1):
        linear = graph.linearize(values)
        tree, step = eliminated(linear, ordering)
        there, new_error = after_step(graph, values, step, error, max_lengths)
        LOG.debug("Gauss-Newton step %d: error %.6g", steps, new_error)
        if error - new_error <= CONVERGED * (1 + error):
            promised = linear.error(values.zeroVectors()) - linear.error(step)
            stuck = new_error >= error and promised > STUCK * (1 + error)
            return GaussNewton(gtsam.Values(there), new_error, steps, not stuck, Marginals(tree))
        values = there
        error = new_error
    return GaussNewton(gtsam.Values(values), error, max_steps, False, Marginals(tree))


def after_step(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, step: gtsam.VectorValues,
               error: float, max_lengths: int) -> tuple[gtsam.Values, float]:
    """Values after a step, halved until the error of the graph does not grow, and their error."""
    def moved(fraction):
        there = FixedValues(values.retract(step.scale(fraction)))
        return there, graph.error(there)

    return descended(moved, values, error, max_lengths)


def descended(moved: Callable[[float], tuple], start: object, error: float,
              max_lengths: int = MAX_LENGTHS) -> tuple[object, float]:
    """The point after a step, halved until the error does not grow, and its error.

    The function `moved` returns both for a fraction of the step from the point `start`.
    """
    for halving in range(max_lengths):
        point, new = moved(0.5**halving)
        if new <= (1 + ROUNDING) * error:
            return point, new
    return start, error


def eliminated(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> tuple[
        gtsam.GaussianBayesTree, gtsam.VectorValues]:
    """The Bayes tree of a linear graph by an ordering of its variables, and its solution.

    Cholesky decomposition is fast, but fails where the information is ill-conditioned. There QR
    decomposition decides whether the factors determine every variable. Raises DatasetError if they
    do not.
    """
    try:
        tree = linear.eliminateMultifrontal(ordering)
        return tree, tree.optimize()
    except RuntimeError:
        pass
    try:
        tree = linear.eliminateMultifrontal(ordering, gtsam.EliminateQR)
        return tree, tree.optimize()
    except RuntimeError as failure:                      # GTSAM's, with much advice
        symbol = re.search(r"Symbol: ([a-z]\d+)", str(failure))
        raise undetermined(symbol[1] if symbol else "") from None


def contradiction(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> str:
    """A sentence on the factor of largest error if this exceeds MAX_CONTRADICTION, or "".

    Factors with a robust noise model may contradict the rest, and so may a guess of an antenna.
    """
    largest = 0.0
    worst = None
    for k in range(graph.size()):
        factor = graph.at(k)
        if factor is None or is_robust(factor) or is_guess(factor):
            continue
        size = np.sqrt(2 * factor.error(values))
        if size > largest:
            largest = size
            worst = k
    if largest <= MAX_CONTRADICTION:
        return ""
    keys = ", ".join(gtsam.DefaultKeyFormatter(key) for key in graph.at(worst).keys())
    return (f"factor {worst}, on {keys}, contradicts the rest by {largest:.0f} standard "
            "deviations, and the solution bends to it: look whether it is in the frame of pose 1, "
            "correct it, or give it a robust noise model")


def is_robust(factor: gtsam.NonlinearFactor) -> bool:
    """Whether the noise model of a factor has a robust kernel."""
    return isinstance(factor, gtsam.NoiseModelFactor) and isinstance(
        factor.noiseModel(), gtsam.noiseModel.Robust)


def is_guess(factor: gtsam.NonlinearFactor) -> bool:
    """Whether a factor is a prior of an antenna's position, as that about its guess."""
    return isinstance(factor, gtsam.PriorFactorPoint2) and gtsam.symbolChr(
        factor.keys()[0]) == ord("a")


def in_world(values: gtsam.Values, symbols: str, covariance_of: Callable[[int], np.ndarray]):
    """Ids (n,), ascending, places (n, 3) and covariances (n, 3, 3) in world axes.

    Of all variables with one of these symbols; the heading of a position is NaN. `covariance_of`
    gives the covariance of a key in GTSAM's axes.
    """
    keys = [key for key in values.keys() if chr(gtsam.symbolChr(key)) in symbols]
    keys.sort(key=id_of)
    places = np.full((len(keys), 3), np.nan)
    covariances = np.full((len(keys), 3, 3), np.nan)
    for k, key in enumerate(keys):
        place = numbers(values, key)
        size = len(place)
        places[k, :size] = place
        covariances[k, :size, :size] = covariance_of(key)
    is_pose = np.isfinite(places[:, 2])
    covariances[is_pose] = se2.rotate_covariance(covariances[is_pose], places[is_pose, 2])
    return np.array([id_of(key) for key in keys], int), places, covariances
