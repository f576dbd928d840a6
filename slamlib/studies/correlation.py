"""Problems 2 to 4 where errors have memory, beside a solver that knows their correlation.

The whitened error u_k of a marker's sighting k is a first-order Gauss-Markov process: it correlates
with u_(k-1) by rho_k = correlation^(camera frames between both). Differences to the last sighting
of the same marker are independent (Bryson and Henrikson, J. Spacecraft and Rockets 5(6), 1968):

    v_1 = u_1,    v_k = (u_k - rho_k u_(k-1)) / sqrt(1 - rho_k^2).

With the whitened derivatives J and errors e of all factors, and the bidiagonal matrix W of these
differences, Gauss-Newton solves (W J)^T (W J) delta = -(W J)^T W e.
"""

from dataclasses import replace

import numpy as np
from scipy import sparse

from slamlib import localization, se2, slam
from slamlib.evaluation import anees, ate
from slamlib.marker_increments import common_sightings
from slamlib.simulation import simulate
from slamlib.slam.factors import linearize_odometry
from slamlib.slam.linear import NormalEquations, retract
from slamlib.slam.measurements import measure, with_known_noise
from slamlib.slam.pipeline import fit_from_odometry
from slamlib.slam.result import interpolate

METHODS = ("markers", "fused", "problem 3", "problem 4", "3, known", "4, known")
FIRST_POSES = 1000                # number of the first poses of the short path
FRAME_LAGS = np.arange(1, 11)     # camera frames between sightings whose residuals are compared
MAX_STEPS = 10                    # number of steps of Gauss-Newton
NEGLIGIBLE_STEP = 1e-8            # m, rad, and sigmas of the calibration


def correlated_errors(seed, correlation, poses=FIRST_POSES, slip=1e-3):
    """All methods on the first `poses` of one drive of the short path; options as of `simulate`.

    Returns
    -------
    dict of "nees" and aligned "ate" in m for each of METHODS, as "fused nees"; "known" are those of
    `estimate_correlated`. Also of problem 3 the "residuals", their correlation over FRAME_LAGS,
    and the "share" of its information that a sighting keeps on average.
    """
    dataset, truth = simulate("short", seed, slip=slip, memory=correlation)
    dataset = dataset.first(poses)
    without, markers = dataset.without("uwb"), localization.localize(dataset.aruco)
    problem3, fused = slam.estimate(without), localization.fuse(dataset)
    problem4, numbers = slam.estimate(dataset, previous=problem3), {}
    results = [(each.poses, each.covariances) for each in (markers, fused, problem3, problem4)]
    results += [estimate_correlated(each, slip, correlation) for each in (without, dataset)]
    for name, (found, covariances) in zip(METHODS, results):
        true = truth.poses[markers.frame if name == "markers" else slice(poses)]
        numbers |= {f"{name} nees": anees(found, covariances, true),
                    f"{name} ate": ate(found, true, aligned=True)}
    return numbers | {"residuals": residual_correlation(problem3), "share": problem3.share.mean()}


def residual_correlation(found):
    """Correlations (l,) of a SlamResult's residuals of a marker, FRAME_LAGS camera frames apart."""
    u, s = found.residual, found.sightings
    _, frame = np.unique(s.row, return_inverse=True)
    pairs = (common_sightings(frame, s.marker, lag)[1:] for lag in FRAME_LAGS)
    return np.array([np.mean(u[first] * u[second]) for first, second in pairs]) / np.mean(u**2)


def estimate_correlated(dataset, slip, correlation):
    """Poses (n, 3) and covariances (n, 3, 3) by odometry, markers and any ranges, all noise known.

    `slip` in sqrt(m); the `correlation` is that of the errors of a marker's sightings from one
    camera frame to the next. Steps are arcs; gates and kernels are those of `slam.estimate`.
    """
    fit = fit_from_odometry(measure(with_known_noise(dataset, slip, 1.0, 1.0)), "arc")
    problem, state = fit.problem, fit.state
    problem = replace(problem, accepted=replace(problem.accepted, share=None))
    for _ in range(MAX_STEPS):
        H, gradient = _normal_equations(NormalEquations(problem, state), correlation)
        step = -np.linalg.solve(H, gradient)
        state = retract(problem, state, step)
        if np.abs(step).max() < NEGLIGIBLE_STEP:
            break
    m, q = problem.measurements, problem.active.sum()
    frames = m.structure.rows(slice(len(m.frame)))
    wheels = np.broadcast_to(len(H) - q + np.arange(3), frames[1:].shape)
    pairs = np.concatenate([frames[:-1], frames[1:], wheels], axis=1)
    unit = np.r_[np.ones(len(H) - q), problem.sigma[problem.active]]
    covariance = unit[:, None] * np.linalg.inv(H) * unit
    return interpolate(problem, state, covariance[pairs[:, :, None], pairs[:, None]])


def _normal_equations(equations, correlation):
    """H (n + q, n + q) and gradient (n + q,) of NormalEquations with correlated sightings."""
    problem, structure, priors = equations.problem, equations.structure, equations.priors
    n, q = len(structure.diagonal), problem.active.sum()
    H, gradient = np.diag(np.r_[priors.H, np.ones(q)]), priors.border[:, -1].copy()
    odometry, _ = linearize_odometry(problem, equations.state)(problem.noise.slip)
    for kind, (pairs, f) in enumerate(zip(structure.factors, (odometry, *equations.linearized))):
        own = structure.rows(pairs[f.index].ravel()).reshape(-1, 1, 6)
        shared = np.tile(n + f.columns, (len(own), 1, 1))
        row, column = np.broadcast_arrays(np.arange(f.e.size).reshape(*f.e.shape, 1),
                                          np.concatenate([own, shared], axis=2))
        J, e = sparse.csr_array((np.concatenate([f.J, f.J_c], axis=2).ravel(),
                                 (row.ravel(), column.ravel())), (f.e.size, n + q)), f.e.ravel()
        if kind == 1:
            W = _differences(problem.measurements, f.index, correlation)
            J, e = W @ J, W @ e
        H, gradient = H + (J.T @ J).toarray(), gradient + J.T @ e
    return H, gradient


def _differences(m, used, correlation):
    """The sparse W (3 u, 3 u) for the sightings `used` (u,) of markers with a heading.

    It also turns their errors from the axes of the measured pose to those of the stated covariance.
    """
    s, used = m.sightings, np.flatnonzero(m.as_pose)[used]
    frame, marker = m.frame[s.row[used]], m.marker_row[used]
    order = np.lexsort((frame, marker))
    last, k = np.stack([order[:-1], order[1:]])[:, np.diff(marker[order]) == 0]
    rho = np.zeros(len(used))
    rho[k] = correlation**((frame[k] - frame[last]) / np.diff(np.unique(frame)).min())
    scale, turn = 1 / np.sqrt(1 - rho**2), np.zeros((len(used), 3, 3))
    W = sparse.diags_array(scale) - sparse.csr_array(((scale * rho)[k], (k, last)), 2 * rho.shape)
    turn[:, :2, :2], turn[:, 2, 2] = se2.rotation(s.z[used, 2]), 1
    roots = np.linalg.cholesky(s.C[used])
    turn = np.linalg.inv(roots) @ turn @ np.linalg.inv(m.sighting_roots[0][used])
    return sparse.kron(W, sparse.eye_array(3)) @ sparse.block_diag(turn)
