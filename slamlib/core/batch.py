"""Custom factors of one kind, linearised all at once in numpy.

Each is a gtsam.CustomFactor like any other, and may stand in any graph. Asked for its error, it
looks whether its variables have the values at which all factors of the kind were linearised last.
If they have not, all are linearised at the new values: one call of numpy in place of thousands.
Of FixedValues it needs not look at each variable.
"""

from collections.abc import Callable

import gtsam
import numpy as np

POSES = {ord("x"), ord("l")}     # symbols of variables that are gtsam.Pose2; others are vectors


class FixedValues(gtsam.Values):
    """Values that nobody changes."""


class Batch:
    """Custom factors of one kind.

    `keys` has a list of m keys for each variable of the m factors. The function `linearised` takes
    an array (m, d) of each variable's values, a pose as [x, y, heading], and returns the errors
    (m, e) and their derivatives (m, e, d), by the tangent vector of each variable. A variable that
    is not in the graph yet is NaN.
    """

    def __init__(self, keys: list[list[int]], linearised: Callable):
        self.keys = keys
        self.linearised = linearised
        self.values = None       # where all were linearised last
        self.place = {}          # numbers of each variable there
        self.errors = None
        self.derivatives = None

    def factor(self, k: int, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
        """The factor k with a noise model."""
        keys = [column[k] for column in self.keys]

        def error(factor, values, jacobians):
            if not self.is_linearised(values, keys):
                self.linearise(values, keys)
            if jacobians is not None:
                for number, derivative in enumerate(self.derivatives):
                    jacobians[number] = derivative[k]
            return self.errors[k]

        return gtsam.CustomFactor(noise, keys, error)

    def is_linearised(self, values: gtsam.Values, keys: list[int]) -> bool:
        """Whether the factor on `keys` is linearised at GTSAM's values."""
        if isinstance(values, FixedValues) and values is self.values:
            return True
        return all(numbers(values, key) == self.place.get(key) for key in keys)

    def linearise(self, values: gtsam.Values, keys: list[int]):
        """Linearise all factors at GTSAM's values, which have those of `keys`, of one factor."""
        there = {key: numbers(values, key)
                 for key in set().union(*self.keys) if values.exists(key)}
        places = []
        for key, column in zip(keys, self.keys):
            absent = [np.nan] * len(there[key])
            places.append(np.array([there.get(other, absent) for other in column]))
        self.errors, self.derivatives = self.linearised(*places)
        self.values = values
        self.place = there


def numbers(values: gtsam.Values, key: int) -> list[float]:
    """A pose as [x, y, heading], or a vector, at GTSAM's values."""
    if gtsam.symbolChr(key) not in POSES:
        return values.atVector(key).tolist()
    pose = values.atPose2(key)
    return [pose.x(), pose.y(), pose.theta()]
