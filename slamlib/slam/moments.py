"""Stage 7: mean and covariances of all variables, averaged over the points of the noise posterior.

With probability p_k of point k, x_k its solution and C_k its covariance, the moments are

    x = sum p_k x_k,    C = sum p_k (C_k + (x_k - x) (x_k - x)^T),

in the tangent space at the state that solves the problem of greatest posterior density.
"""

import numpy as np

from slamlib.slam.covariances import Covariances, marginal_covariances
from slamlib.slam.evidence import laplace_approximation
from slamlib.slam.state import retract


def posterior_moments(fit):
    """Mean State, Covariances, and root mean square of the slip in sqrt(m), of a Fit.

    Raises DatasetError and LinAlgError as `marginal_covariances`.
    """
    noise, equations = fit.problem.noise, fit.equations
    if fit.posterior is None:
        return fit.state, marginal_covariances(equations, noise), noise.slip
    weights, noises = zip(*fit.posterior.points)
    weights = np.array(weights) / sum(weights)
    slip = np.sqrt(weights @ np.square([point.slip for point in noises]))
    conditional = [marginal_covariances(equations, point) for point in noises]
    if len(noises) == 1:
        return fit.state, conditional[0], slip
    x = np.stack([laplace_approximation(equations, point)[0] for point in noises]) \
        - laplace_approximation(equations, noise)[0]
    mean = weights @ x
    return (retract(fit.problem.measurements, fit.state, mean),
            _averaged(equations, conditional, x - mean, weights), slip)


def _averaged(equations, conditional, x, weights):
    """The Covariances averaged over points, with solutions x (p, n) about the mean."""
    m, v, structure = (equations.problem.measurements, equations.problem.measurements.variables,
                       equations.structure)
    _, pairs = m.factor_places[0]

    def averaged(blocks, rows):
        """sum p_k (C_k + x_k x_k^T) of blocks p of (..., d, d) with rows (..., d)."""
        x_k = x[:, rows]
        return np.einsum("p,p...->...", weights,
                         np.stack(blocks) + x_k[..., :, None] * x_k[..., None, :])

    return Covariances(
        pairs=averaged([C.pairs for C in conditional], pairs),
        markers=[averaged([C.markers[j] for C in conditional], rows)
                 for j, rows in enumerate(structure.rows_of_each(v.markers))],
        antennas=averaged([C.antennas for C in conditional], structure.rows(v.antennas, 2)),
        w=averaged([C.w for C in conditional], structure.rows(v.w, 3)[0]),
        c=averaged([C.c for C in conditional], structure.rows(v.c, 2)[0]) if m.calibrated
        else conditional[0].c)
