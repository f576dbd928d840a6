"""Custom factors of one kind, linearised all at once in numpy.

Each is a gtsam.CustomFactor like any other, and may stand in any graph. Asked for its error, it
looks whether its variables have the values at which all factors of the kind were linearised last.
If they have not, all are linearised at the new values: one call of numpy in place of thousands.
Of FixedValues it needs not look at each variable.
"""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

POSES = {ord("x"), ord("l")}     # symbols of variables that are gtsam.Pose2; others are vectors


class FixedValues(gtsam.Values):
    """Values that nobody changes."""


@dataclass(frozen=True)
class Linearization:
    """The m factors of a kind, linearised at one place."""

    values: gtsam.Values             # there
    place: dict                      # numbers of each variable there, by its key
    errors: np.ndarray               # (m, e)
    derivatives: list[np.ndarray]    # (m, e, d) by the tangent vector of each variable

    def is_at(self, values: gtsam.Values, keys: list[int]) -> bool:
        """Whether the variables with these keys have the same values."""
        if isinstance(values, FixedValues) and values is self.values:
            return True
        return all(numbers(values, key) == self.place.get(key) for key in keys)


class Batch:
    """Custom factors of one kind, and where they were linearised last.

    `keys` has a list of m keys for each variable of the m factors. The function `errors_at` takes
    an array (m, d) of each variable's values, a pose as [x, y, heading], and returns the errors
    (m, e) and their derivatives (m, e, d), by the tangent vector of each variable. A variable that
    is not in the graph yet is NaN.
    """

    def __init__(self, keys: list[list[int]], errors_at: Callable):
        self.keys = keys
        self.errors_at = errors_at
        self.last: Linearization | None = None

    def factor(self, k: int, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
        """The factor k with a noise model."""
        keys = [column[k] for column in self.keys]

        def error(factor, values, jacobians):
            if self.last is None or not self.last.is_at(values, keys):
                self.last = self.linearise(values, keys)
            if jacobians is not None:
                for number, derivative in enumerate(self.last.derivatives):
                    jacobians[number] = derivative[k]
            return self.last.errors[k]

        return gtsam.CustomFactor(noise, keys, error)

    def linearise(self, values: gtsam.Values, keys: list[int]) -> Linearization:
        """All factors linearised at GTSAM's values.

        `keys` are those of one factor, which tell the sizes of variables that are not there yet.
        """
        place = {key: numbers(values, key)
                 for key in set().union(*self.keys) if values.exists(key)}
        columns = []
        for key, column in zip(keys, self.keys):
            absent = [np.nan] * len(place[key])
            columns.append(np.array([place.get(other, absent) for other in column]))
        errors, derivatives = self.errors_at(*columns)
        return Linearization(values, place, errors, derivatives)


def numbers(values: gtsam.Values, key: int) -> list[float]:
    """A pose as [x, y, heading], or a vector, at GTSAM's values."""
    if gtsam.symbolChr(key) not in POSES:
        return values.atVector(key).tolist()
    pose = values.atPose2(key)
    return [pose.x(), pose.y(), pose.theta()]
