"""Stage 7: mean and covariance of all variables, averaged over the points of the noise posterior.

With probability p_k of point k, x_k its solution and C_k its covariance, the moments are

    x = sum p_k x_k,    C = sum p_k (C_k + (x_k - x) (x_k - x)^T),

in the tangent space at the state that solves the problem of greatest posterior density.
"""

import numpy as np

from slamlib.slam.covariances import Covariances, covariances
from slamlib.slam.evidence import solve
from slamlib.slam.state import moved


def moments(fit):
    """Mean State, Covariances, and root mean square of the slip in sqrt(m), of a Fit."""
    problem, state = fit.problem, fit.state
    if fit.posterior is None:
        return state, covariances(fit.equations, problem.noise), problem.noise.slip
    weights, noises = zip(*fit.posterior.points)
    weights = np.array(weights) / sum(weights)
    slip = np.sqrt(weights @ np.square([noise.slip for noise in noises]))
    each = [covariances(fit.equations, noise) for noise in noises]
    if len(each) == 1:
        return state, each[0], slip
    equations = fit.equations
    x = np.stack([solve(equations, noise)[0] for noise in noises]) \
        - solve(equations, problem.noise)[0]
    mean = weights @ x
    x -= mean
    return moved(problem.measurements, state, mean), _averaged(equations, each, x, weights), slip


def _averaged(equations, each, x, weights):
    """The Covariances averaged over points with solutions x (p, n) about the mean."""
    m = equations.problem.measurements
    frames, markers, antennas, w, z = _variables(equations)

    def mixed(blocks, rows):
        own = x[:, rows]                                               # (p, ..., d)
        spread = own[..., :, None] * own[..., None, :]
        return np.einsum("p,p...->...", weights, np.stack(blocks) + spread)

    w_rows = equations.structure.rows(w, 3)
    pair_rows = np.concatenate([
        equations.structure.rows(frames[:-1], 3), equations.structure.rows(frames[1:], 3),
        np.broadcast_to(w_rows, (len(frames) - 1, 3))], axis=1)
    return Covariances(
        pairs=mixed([c.pairs for c in each], pair_rows),
        markers=[mixed([c.markers[j] for c in each],
                       equations.structure.rows(variable, 2 + m.oriented[j])[0])
                 for j, variable in enumerate(markers)],
        antennas=mixed([c.antennas for c in each], equations.structure.rows(antennas, 2)),
        z=mixed([c.z for c in each], equations.structure.rows(z, 2)[0]) if m.calibrated
        else each[0].z,
        w=mixed([c.w for c in each], w_rows[0]))


def _variables(equations):
    """Numbers of the frames (f,), markers (k, 1), antennas (a,), w (1,) and z (1,)."""
    m = equations.problem.measurements
    f, k, a = len(m.frame), len(m.marker), len(m.antenna)
    numbers = np.arange(f + k + a + 2)
    return (numbers[:f], numbers[f:f + k, None], numbers[f + k:f + k + a],
            numbers[f + k + a:][:1], numbers[f + k + a + 1:])
