"""The pipeline of problems 3 and 4, from a Dataset to a SlamResult.

Each stage is a function from one frozen record to the next. Comments number them as docs/code.md
does. Problem 4 starts from the poses of problem 3 (`fit_from_previous`).
"""

import logging
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slamlib.core.errors import if_solvable, require
from slamlib.core.graph import require_rows
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.odometry import MODELS
from slamlib.core.records import Dataset
from slamlib.robust.choices import (
    LARGE_SLIP,
    better_model,
    calibrated,
    memory_or_slip,
    most_consistent,
    spares_sightings,
)
from slamlib.robust.fit import Fit, narrow_kernels, refine_like, settled
from slamlib.robust.initialization import initial_state, state_from_poses
from slamlib.robust.jumps import NO_JUMPS
from slamlib.robust.linear import build_problem
from slamlib.robust.measurements import Measurements, Noise, measure
from slamlib.robust.part_faults import with_counts_mended
from slamlib.robust.result import SlamResult, slam_result

log = logging.getLogger(__name__)


def estimate(dataset: Dataset, slip: float | None = None, model: str | None = None,
             previous: SlamResult | None = None, *, marker_noise_factor: float | None = None,
             range_noise_factor: float | None = None, kernel: str | None = None,
             gate: bool | None = None, poses: Sequence[int] = ()) -> SlamResult:
    """SLAM on odometry and on the markers and ranges that the dataset has.

    Parameters
    ----------
    dataset : Dataset; markers and ranges may be absent.
    slip : sqrt(m), known standard deviation of a wheel's slip after one metre; None takes that of
        the dataset's Vehicle, or learns it if the Vehicle has none.
    model : "arc" or "euler", of an odometry step; None lets the evidence choose, or takes that of
        `previous`.
    previous : SlamResult of the same drive with fewer sensors, from which the solution starts.
    marker_noise_factor, range_noise_factor : known factors on the standard deviations in the files;
        None as for `slip`.
    kernel : name in `core.kernels.KERNELS`, the robust kernel of sightings and ranges; that of the
        ranges only if its name begins with "asymmetric". None takes that of the Vehicle.
    gate : bool, whether measurements that contradict the solution are rejected; None as for
        `kernel`.
    poses : rows of `dataset.ticks`, from 0, that are variables of the graph also where nothing was
        measured, for factors of one's own (`SlamResult.graph`).

    Returns
    -------
    SlamResult

    Raises
    ------
    DatasetError : the measurements do not determine every pose and landmark; an option has no such
        name, or is not within the limits of vehicle.toml; `dataset` is no Dataset, `previous` of
        another drive, or `poses` are not rows.
    numpy.linalg.LinAlgError : a covariance is singular to rounding.

    >>> from slamlib.studies.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> result = estimate(dataset.first(200), slip=1e-3, kernel="Huber")
    >>> result.poses.shape, result.antenna.tolist(), result.noise.slip
    ((200, 3), [5, 13, 36, 46], 0.001)
    """
    started = time.perf_counter()
    require(isinstance(dataset, Dataset), "estimate", "a Dataset", dataset)
    require_rows(dataset, poses, "estimate")
    dataset = with_counts_mended(dataset)
    require_same_drive(dataset, previous)
    require(model in (None, *MODELS), "estimate", f"{' or '.join(MODELS)} for model", model)
    options = {"slip": slip, "marker_noise_factor": marker_noise_factor,
               "range_noise_factor": range_noise_factor, "kernel": kernel, "gate": gate}
    dataset = dataset.stating(options, "estimate")
    log.info("estimate of %s: %d poses", dataset.name, len(dataset.ticks))

    def start(jumps=NO_JUMPS, places=None, like=None):
        aruco = dataset.aruco
        if places is not None:
            aruco = replace(aruco, marker=places[:, 1])
        measurements = measure(replace(dataset, aruco=aruco), poses, jumps)           # 1
        if previous is not None and like is None:
            return fit_from_previous(measurements, previous, model)
        return fit_from_odometry(measurements, model or "arc", like)                  # 2 to 6

    def decide(fit):                                                                  # 6
        if previous is not None or model is not None:
            return calibrated(fit)
        fit = calibrated(better_model(fit))
        # Wrong statements may look like other steps, and these like other statements.
        other = better_model(fit) if fit.problem.prior.groups else fit
        return fit if other is fit else calibrated(other)

    if previous is not None and len(previous.rejected):
        fit = decide(start(previous.jumps, previous.places))
        places = previous.places
    else:
        fit, places = most_consistent(dataset, start, decide)
    fit = settled(fit)
    result = replace(slam_result(fit), places=places)                                 # 7
    solution = result.gtsam
    log.info("GTSAM: slip %.3g mm after 1 m, %d factors, %d variables, %d steps from %s, "
             "differs by up to %.2g sigmas", 1e3 * result.slip, solution.factors,
             solution.variables, solution.steps, solution.start, result.disagreement)
    log.info("estimate of %s: %.1f s", dataset.name, time.perf_counter() - started)
    return result


def require_same_drive(dataset: Dataset, previous: SlamResult | None):
    """Raise DatasetError unless `previous` is None or a SlamResult of the drive of a Dataset."""
    if previous is None:
        return
    require(isinstance(previous, SlamResult), "estimate", "a SlamResult for previous", previous)
    ticks = previous.fit.problem.measurements.dataset.ticks
    require(np.array_equal(ticks, dataset.ticks), "estimate",
            f"a result of the same drive for previous, of {len(dataset.ticks)} poses with the same "
            f"counts, found one of {len(ticks)} poses")


def fit_from_odometry(measurements: Measurements, model: str = "arc",
                      like: Fit | None = None) -> Fit:
    """The Fit of Measurements with start values by odometry; raises DatasetError as `estimate`.

    `like` is a Fit whose decisions it takes over: the model of the steps, groups of the calibration
    with their explanations, and the order of memory.
    """
    if like is not None:
        model = like.problem.odometry.model

    def solved_with(slip):
        state, noise = initial_state(measurements, model, slip)                       # 4
        return narrow_kernels(build_problem(measurements, model, noise), state).state       # 5

    problem = build_problem(measurements, model)                                      # 2
    if like is not None:
        problem = _with_decisions(problem, like.problem)
        state = solved_with(like.problem.noise.slip)
        return refine_like(problem, replace(state, c=like.state.c), like)
    fit = memory_or_slip(problem, solved_with(TYPICAL_SLIP))                          # 6
    slip = fit.problem.noise.slip
    all_accepted = fit.problem.accepted.sightings.weight.all()
    if slip < LARGE_SLIP or not measurements.learned[0] or all_accepted:
        return fit
    again = if_solvable(lambda: memory_or_slip(problem, solved_with(slip)))
    return again if spares_sightings(again, fit, "a start with this slip", 1) else fit


def _with_decisions(problem, decided):
    """The Problem with the released groups, and what is sought of memory and slip, of another."""
    prior = problem.measurements.calibration.prior(decided.prior.groups, decided.prior.width)
    return replace(problem, prior=prior, memory_first=decided.memory_first,
                   max_slip=decided.max_slip)


def fit_from_previous(measurements: Measurements, previous: SlamResult,
                      model: str | None = None) -> Fit:
    """The Fit of Measurements from a SlamResult, with another `model` if not None."""
    m = measurements
    problem = build_problem(m, model or previous.model, Noise(previous.slip), previous.wheel)
    problem = _with_decisions(problem, previous.fit.problem)
    c = m.calibration.taken_from(previous.calibration, previous.c)
    state = state_from_poses(m, previous.poses[m.frame], previous.covariances[m.frame], c)
    return refine_like(problem, state, previous.fit)
