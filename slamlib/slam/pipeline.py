"""The pipeline of problems 3 and 4, from a Dataset to a SlamResult.

Each stage is a function from one frozen record to the next; stages have the numbers of the list in
`slamlib.slam`:

    1   measure           Dataset -> Measurements
    2   build_problem     Measurements, Noise -> Problem, the factor graph
    3   optimize          Problem, State -> Optimum by Gauss-Newton, in all later stages
    4   initial_state     Measurements -> State, the start values
    5   narrow_kernels    Problem, State -> State, by robust kernels
    6   refine            Problem, State -> Fit: wheels, noise and accepted measurements in turn
        better_model      Fit -> Fit: arcs or Euler's steps
        calibrated        Fit -> Fit: groups of the calibration leave wrong stated values
        solved_by_gtsam   Fit -> Fit: the last steps by GTSAM
    7   slam_result       Fit -> SlamResult: mean and covariances over the possible noise, poses
                          between the frames, doubts

With a SlamResult of fewer sensors, stage 4 takes its poses (`fit_from_previous`), and the model of
odometry is that of the result: problem 4 starts from problem 3.
"""

from dataclasses import replace
from functools import partial
from numbers import Real

from slamlib.limits import LIMITS
from slamlib.odometry import MODELS
from slamlib.slam.choices import better_model, calibrated
from slamlib.slam.fit import (
    CAUCHY_SCALES,
    acceptance_rule,
    accepted_measurements,
    narrow_kernels,
    refine,
    solved_by_gtsam,
)
from slamlib.slam.initialization import initial_state, state_from_poses
from slamlib.slam.measurements import NOISE_KEYS, Noise, measure, with_known, with_known_noise
from slamlib.slam.problem import build_problem, preintegrate_odometry
from slamlib.slam.result import slam_result

WARM_START_CONVERGED = 1e-3  # decrease, over 1 + error, at which the start from a result ends


def estimate(dataset, slip=None, model=None, previous=None, *, marker_noise_factor=None,
             range_noise_factor=None, kernel="asymmetric Tukey", gate=True):
    """SLAM on odometry and on the markers and ranges that the dataset has.

    Parameters
    ----------
    dataset : Dataset with markers, ranges or both.
    slip : sqrt(m), known standard deviation of a wheel's slip after one metre; None takes that of
        the dataset's Vehicle, or learns it if the Vehicle has none.
    model : "arc" or "euler", of an odometry step; None lets the evidence choose, or takes that of
        `previous`.
    previous : SlamResult of the same drive with fewer sensors, from which the solution starts.
    marker_noise_factor, range_noise_factor : known factors on the standard deviations in the files;
        None as for `slip`.
    kernel : name in `fit.KERNELS`, the robust kernel of sightings and ranges; that of the
        ranges only if its name begins with "asymmetric".
    gate : bool, whether measurements that contradict the solution are rejected.

    Returns
    -------
    SlamResult

    Raises
    ------
    DatasetError : the measurements do not determine every pose and landmark.
    numpy.linalg.LinAlgError : a covariance is singular to rounding.
    ValueError : an option has no such name, or is not within the limits of vehicle.toml.

    >>> from slamlib.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> result = estimate(dataset.first(200), slip=1e-3, kernel="Huber")
    >>> result.poses.shape, result.antenna.tolist(), result.noise.slip
    ((200, 3), [5, 13, 36, 46], 0.001)
    >>> estimate(dataset, kernel="L2")
    Traceback (most recent call last):
    ValueError: kernel must be one of quadratic, Huber, Cauchy, Geman-McClure, Tukey, \
asymmetric Cauchy, asymmetric Tukey, not 'L2'
    """
    _check_options(model, slip, marker_noise_factor, range_noise_factor)
    dataset = with_known_noise(dataset, slip, marker_noise_factor, range_noise_factor)
    accept = partial(accepted_measurements, rule=acceptance_rule(kernel, gate))

    measurements = measure(dataset)                                                   # 1
    if previous is not None:
        fit = fit_from_previous(measurements, previous, model, accept)                # 2, 5, 6
    else:
        fit = fit_from_odometry(measurements, model or "arc", accept=accept)          # 2 to 6
        fit = fit if model else better_model(fit)
    fit = calibrated(fit, accept)
    if fit.problem.released and not (model or previous):     # wrong ones may look like other steps
        fit = better_model(fit)
    return slam_result(solved_by_gtsam(fit))                                          # 7


def fit_from_odometry(measurements, model="arc", preintegrate=preintegrate_odometry,
                      accept=accepted_measurements):
    """The Fit of Measurements with start values by odometry.

    `model` and `preintegrate` as in `build_problem`, `accept` as in `refine`. Raises DatasetError
    as `estimate`.
    """
    problem = build_problem(measurements, model, _initial_noise(measurements),        # 2
                            preintegrate=preintegrate)
    state = initial_state(measurements, model, preintegrate)                          # 4
    state = narrow_kernels(problem, state)                                            # 5
    return refine(problem, state, accept, preintegrate)                               # 6


def fit_from_previous(measurements, previous, model=None, accept=accepted_measurements):
    """The Fit of Measurements from poses, wheels and model of the SlamResult `previous`.

    `model`, if not None, replaces that of `previous`. `accept` and errors raised as in `refine`.
    """
    frame, calibration = measurements.frame, measurements.calibration
    problem = build_problem(measurements, model or previous.model, _initial_noise(measurements),
                            previous.wheel)
    sigma = calibration.taken_from(previous.calibration, previous.sigma, calibration.sigma)
    c = calibration.taken_from(previous.calibration, previous.c, calibration.stated)
    problem = replace(problem, sigma=sigma, released=previous.released)
    state = state_from_poses(measurements, previous.poses[frame], previous.covariances[frame], c)
    state = narrow_kernels(problem, state, CAUCHY_SCALES[-1:], converged=WARM_START_CONVERGED)
    return replace(refine(problem, state, accept), explanations=previous.explanations)


def _initial_noise(measurements):
    """The Noise to start from: typical values for the parameters that are not known."""
    return with_known(Noise(), measurements.dataset.vehicle)


def _check_options(model, *noise):
    """Raise ValueError for an unknown model, or for `noise` (NOISE_KEYS) beyond its limits."""
    if model not in (None, *MODELS):
        raise ValueError(f"model must be one of {', '.join(MODELS)}, or None, not {model!r}")
    for name, value in zip(NOISE_KEYS, noise):
        limit = LIMITS["vehicle.toml"][name]
        number = isinstance(value, Real) and not isinstance(value, bool)
        if value is not None and not (number and limit.minimum <= value <= limit.maximum):
            raise ValueError(f"expected {limit.expected(name)}, not {value!r}")
