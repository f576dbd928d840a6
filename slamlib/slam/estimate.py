"""The whole pipeline: from a dataset to the result of problem 3 or 4."""

from functools import partial
from numbers import Real

from slamlib.limits import LIMITS
from slamlib.odometry import MODELS
from slamlib.slam.fit import refine, solved_by_gtsam
from slamlib.slam.initialization import initial_state, state_from_poses
from slamlib.slam.measurements import measure
from slamlib.slam.model_choice import better_model
from slamlib.slam.noise import GIVEN, Noise, given, with_known
from slamlib.slam.odometry_factors import odometry_factors
from slamlib.slam.problem import build
from slamlib.slam.range_calibration import calibrated
from slamlib.slam.result import result
from slamlib.slam.robust import CAUCHY_SCALES, acceptance, accepted, narrow_kernels
from slamlib.slam.wheel_check import with_checked_wheels

NEAR = 1e-3                  # relative decrease of the error at which a start from a result is near


def estimate(dataset, slip=None, model=None, previous=None, *, marker_noise_factor=None,
             range_noise_factor=None, kernel="asymmetric Tukey", gate=True):
    """SLAM on odometry and on the markers and ranges that the dataset has.

    Parameters
    ----------
    dataset : Dataset with markers, ranges or both.
    slip : sqrt(m), standard deviation of a wheel's slip after one metre, where it is known; None
        takes that of the dataset's Vehicle, and learns it if there is none.
    model : "arc" or "euler", of an odometry step; None lets the evidence choose, or takes that of
        `previous`.
    previous : SlamResult of the same drive with fewer sensors, from which the solution starts.
    marker_noise_factor, range_noise_factor : what the standard deviations in the files are to be
        multiplied by, where it is known; None as for `slip`.
    kernel : name in `robust.KERNELS`, the robust kernel of sightings and ranges; that of the
        ranges only if its name begins with "asymmetric".
    gate : bool, whether measurements that contradict the solution are rejected.

    Returns
    -------
    SlamResult

    Raises
    ------
    DatasetError : the measurements do not determine every pose and landmark.
    ValueError : an option has no such name, or is not within the limits of vehicle.toml.

    >>> from slamlib.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> found = estimate(dataset.first(200), slip=1e-3, kernel="Huber")
    >>> found.poses.shape, found.antenna.tolist(), found.noise.slip
    ((200, 3), [5, 13, 36, 46], 0.001)
    >>> estimate(dataset, kernel="L2")
    Traceback (most recent call last):
    ValueError: kernel must be one of quadratic, Huber, Cauchy, Geman-McClure, Tukey, \
asymmetric Cauchy, asymmetric Tukey, not 'L2'
    """
    if model not in (None, *MODELS):
        raise ValueError(f"model must be one of {', '.join(MODELS)}, or None, not {model!r}")
    for name, value in zip(GIVEN, (slip, marker_noise_factor, range_noise_factor)):
        limit = LIMITS["vehicle.toml"][name]
        number = isinstance(value, Real) and not isinstance(value, bool)
        if value is not None and not (number and limit.minimum <= value <= limit.maximum):
            raise ValueError(f"expected {limit.expected(name)}, not {value!r}")
    accept = partial(accepted, way=acceptance(kernel, gate))
    measurements = measure(given(dataset, slip, marker_noise_factor, range_noise_factor))
    if previous is not None:
        fit = fit_from_previous(measurements, previous, model, accept)
    else:
        fit = fit_from_odometry(measurements, model or "arc", accept=accept)
        fit = fit if model else better_model(fit, "euler")
    fit = solved_by_gtsam(calibrated(fit, accept))
    return with_checked_wheels(result(fit), fit, partial(fit_from_previous, accept=accept))


def fit_from_odometry(measurements, model="arc", factors=odometry_factors, accept=accepted):
    """The Fit of Measurements from odometry on.

    `model` and `factors` as of `problem.build`, `accept` as of `fit.refine`.
    """
    state = initial_state(measurements, model, factors)
    problem = build(measurements, model, _typical(measurements), factors=factors)
    return refine(problem, narrow_kernels(problem, state), accept, factors)


def fit_from_previous(measurements, previous, model=None, accept=accepted):
    """The Fit of Measurements from poses, wheels and model of a SlamResult; otherwise as above."""
    vehicle, frame = measurements.dataset.vehicle, measurements.frame
    w = (previous.wheel - vehicle.wheel) / vehicle.sigma_wheel
    state = state_from_poses(measurements, previous.poses[frame], previous.covariances[frame], w)
    problem = build(measurements, model or previous.model, _typical(measurements), relinearize_at=w)
    state = narrow_kernels(problem, state, CAUCHY_SCALES[-1:], converged=NEAR)
    return refine(problem, state, accept)


def _typical(measurements):
    """The Noise to start from: what is known, else typical."""
    return with_known(Noise(), measurements.dataset.vehicle)
