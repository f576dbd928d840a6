"""The whole pipeline: from a dataset to the result of problem 3 or 4."""

from slamlib.slam.fit import refine, solved_by_gtsam
from slamlib.slam.initialization import initial_state, state_from_poses
from slamlib.slam.measurements import measure
from slamlib.slam.model_choice import better_model
from slamlib.slam.noise import known_noise
from slamlib.slam.odometry_factors import odometry_factors
from slamlib.slam.problem import build
from slamlib.slam.range_calibration import calibrated
from slamlib.slam.result import result
from slamlib.slam.robust import CAUCHY_SCALES, narrow_kernels
from slamlib.slam.wheel_check import with_checked_wheels

NEAR = 1e-3                  # relative decrease of the error at which a start from a result is near


def estimate(dataset, slip=None, model=None, previous=None):
    """SLAM on odometry and on the markers and ranges that the dataset has.

    Parameters
    ----------
    dataset : Dataset with markers, ranges or both.
    slip : sqrt(m), standard deviation of a wheel's slip after one metre, where it is known, with
        the covariances that the files state; None learns the slip and factors on those.
    model : "arc" or "euler", of an odometry step; None lets the evidence choose, or takes that of
        `previous`.
    previous : SlamResult of the same drive with fewer sensors, from which the solution starts.

    Returns
    -------
    SlamResult

    Raises
    ------
    DatasetError : the measurements do not determine every pose and landmark.
    """
    measurements = measure(dataset)
    if previous is not None:
        fit = fit_from_previous(measurements, previous, slip, model)
    else:
        fit = fit_from_odometry(measurements, slip, model or "arc")
        fit = fit if model else better_model(fit, "euler", slip)
    fit = solved_by_gtsam(calibrated(fit, slip))
    return with_checked_wheels(result(fit), fit, fit_from_previous)


def fit_from_odometry(measurements, slip=None, model="arc", factors=odometry_factors):
    """The Fit of Measurements from odometry on.

    The noise is learned if `slip`, in sqrt(m), is None; `model` and `factors` as of
    `problem.build`.
    """
    state = initial_state(measurements, model, factors)
    problem = build(measurements, model, known_noise(slip), factors=factors)
    state = narrow_kernels(problem, state, learn=slip is None)
    return refine(problem, state, slip, factors=factors)


def fit_from_previous(measurements, previous, slip=None, model=None):
    """The Fit of Measurements from poses, wheels and model of a SlamResult; otherwise as above."""
    vehicle, frame = measurements.dataset.vehicle, measurements.frame
    w = (previous.wheel - vehicle.wheel) / vehicle.sigma_wheel
    state = state_from_poses(measurements, previous.poses[frame], previous.covariances[frame], w)
    problem = build(measurements, model or previous.model, known_noise(slip), relinearize_at=w)
    state = narrow_kernels(problem, state, CAUCHY_SCALES[-1:], slip is None, converged=NEAR)
    return refine(problem, state, slip)
