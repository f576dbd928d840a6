"""Stage 1: GTSAM's keys and values of all variables, and factors of one's own between them.

Keys are X(pose) of a pose by its row of `Dataset.ticks`, L(id) of a marker's pose, P(id) of a
marker's position where no sighting has a heading, A(id) of an antenna, and C(0) of the calibration,
in standard deviations from what is stated. Poses are gtsam.Pose2, positions gtsam.Point2.

Each linearisation asks GTSAM for that of factors of one's own, so that start values, gates, noise
and covariances heed them. The covariances need a chain of poses, given the landmarks: a factor has
one variable, or a pose and a landmark, or neighbouring poses.
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, C, L, P, X

from slamlib.core.errors import DatasetError, require

INDICES = 2**56              # number of indices of GTSAM's symbols; ids below 0 count from the end


def variable_keys(measurements):
    """List of GTSAM's keys of poses, markers and antennas, in the order of their numbers."""
    m = measurements
    markers = zip((m.marker % INDICES).tolist(), m.oriented)
    return [*map(X, m.frame.tolist()), *((L if oriented else P)(j) for j, oriented in markers),
            *map(A, (m.antenna % INDICES).tolist())]


def gtsam_values(problem, state):
    """The gtsam.Values of a State."""
    m, active, values = problem.measurements, problem.active, gtsam.Values()
    variables = [*(gtsam.Pose2(*pose) for pose in state.poses.tolist()), *(
        gtsam.Pose2(*marker) if oriented else gtsam.Point2(*marker[:2])
        for marker, oriented in zip(state.markers, m.oriented)), *state.antennas]
    for key, variable in zip(variable_keys(m), variables):
        values.insert(key, variable)
    if active.any():
        values.insert(C(0), (state.c - m.calibration.stated)[active] / problem.sigma[active])
    return values


def connected(measurements):
    """Numbers (m, 2) of the variables of each factor of one's own; of one variable, twice its own.

    Raises DatasetError for factors between other variables.
    """
    m, pairs = measurements, np.zeros((measurements.own.size(), 2), int)
    number = {key: i for i, key in enumerate(variable_keys(m))} if len(pairs) else {}
    for k in range(len(pairs)):
        keys = m.own.at(k).keys()
        rows = [number.get(key, -1) for key in keys]
        if len(rows) > 2 or min(rows) < 0 or max(rows) < len(m.frame) and np.ptp(rows) > 1:
            raise DatasetError(
                f"factors: expected in factor {k} one variable, a pose and a landmark, or "
                "neighbouring poses, with keys X(row of ticks, from 0), L(marker id), A(antenna "
                "id), or P(id) of a marker without headings, found "
                + ", ".join(map(gtsam.DefaultKeyFormatter, keys)))
        pairs[k] = rows[0], rows[-1]
    return pairs


def linearized_own(problem, state):
    """Whitened errors (m, d) of factors of one's own at a State, and derivatives (m, d, 6).

    Padded by zeros. Also half the sum of the squared errors, or the loss of their kernels. Raises
    DatasetError for factors of other types of variables, or with numbers that are not finite.
    """
    m, pairs = problem.measurements, problem.measurements.structure.factors[-1]
    values = gtsam_values(problem, state) if len(pairs) else gtsam.Values()
    jacobians = []
    for k in range(len(pairs)):
        try:
            jacobians.append(m.own.at(k).linearize(values).jacobian())
        except RuntimeError:                              # GTSAM's, on types of C++
            raise DatasetError(
                f"factors: expected in factor {k} one of gtsam.Pose2 for poses and markers, and "
                f"gtsam.Point2 for antennas, found {type(m.own.at(k)).__name__}") from None
        require(np.isfinite(np.c_[jacobians[k]]).all(), "factors", f"finite numbers in factor {k}")
    size = max((len(b) for _, b in jacobians), default=1)
    e, J = np.zeros((len(pairs), size)), np.zeros((len(pairs), size, 6))
    for k, (by_variables, b) in enumerate(jacobians):
        width = 2 + m.structure.is_pose[pairs[k, 0]]
        e[k, :len(b)], J[k, :len(b), :width] = -b, by_variables[:, :width]
        J[k, :len(b), 3:3 + by_variables.shape[1] - width] = by_variables[:, width:]
    return e, J, m.own.error(values)
