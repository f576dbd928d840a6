"""Comparison of graphs: models of the wheel errors and of the odometry steps in SLAM."""

from dataclasses import dataclass, replace

import numpy as np

from slamlib import odometry, se2
from slamlib.slam.calibration import WHEELS
from slamlib.slam.factors import preintegrate_odometry
from slamlib.slam.fit import refine
from slamlib.slam.graph import optimize
from slamlib.slam.linear import build_problem, log_evidence
from slamlib.slam.measurements import measure
from slamlib.slam.pipeline import fit_from_odometry
from slamlib.slam.result import SlamResult, slam_result


def fixed_wheels(measurements, model, wheel=None):
    """OdometryFactors of wheels without errors; they do not depend on `wheel`."""
    factors = preintegrate_odometry(measurements, model)
    return replace(factors, J_wheel=np.zeros_like(factors.J_wheel))


def independent_chain(measurements, model, wheel=None):
    """OdometryFactors with wheel errors as independent noise, linearised at the nominal wheels."""
    factors = preintegrate_odometry(measurements, model)
    J_w = factors.J_wheel * measurements.dataset.vehicle.sigma_wheel
    noise = se2.rotate_covariance(J_w @ np.swapaxes(J_w, 1, 2), -factors.increment[:, 2])
    return replace(factors, J_wheel=np.zeros_like(factors.J_wheel),
                   quantization=factors.quantization + noise)


WHEEL_MODELS = {"wheels as a variable": preintegrate_odometry,
                "independent chain": independent_chain, "wheels fixed": fixed_wheels}


@dataclass(frozen=True)
class GraphKind:
    """One kind of graph and its solution."""

    wheels: str              # of WHEEL_MODELS
    model: str               # "arc" or "euler"
    result: SlamResult
    log_evidence: float      # on the measurements that variable wheels and arcs accept


def graph_kinds(dataset):
    """Yield the GraphKind of every kind for a Dataset; unknown noise is learned for each.

    All start from the solution of the first kind, variable wheels and arcs. The evidence is that on
    common accepted measurements, because only then it can be compared.
    """
    measurements = measure(dataset)
    first = fit_from_odometry(measurements)
    for wheels, preintegrate in WHEEL_MODELS.items():
        for model in odometry.MODELS:
            problem = build_problem(measurements, model, preintegrate=preintegrate)
            fit = first if (preintegrate, model) == (preintegrate_odometry, "arc") else refine(
                problem, first.state, preintegrate=preintegrate)
            if preintegrate is not preintegrate_odometry:
                fit = replace(fit, problem=_without_wheel_errors(fit.problem))
            common = replace(first.problem, odometry=preintegrate(measurements, model))
            common = refine(common, first.state, accept=None, preintegrate=preintegrate)
            yield GraphKind(wheels, model, slam_result(fit), common.log_evidence)


def _without_wheel_errors(problem):
    """The Problem in which the poses between the frames have no wheel errors either."""
    sigma = problem.sigma.copy()
    sigma[WHEELS] = 0
    return replace(problem, sigma=sigma)


def evidence_curve(fit, slips, model):
    """Log evidence (len(slips),) of slips in sqrt(m), each at its own optimum.

    The measurements are those that the Fit accepts, whatever the model of the odometry steps.
    """
    factors = replace(preintegrate_odometry(
        fit.problem.measurements, model, fit.state.c[WHEELS]), in_counts=True)
    problem, state, curve = replace(fit.problem, odometry=factors), fit.state, []
    for slip in slips:
        problem = replace(problem, noise=replace(problem.noise, slip=slip))
        state = optimize(problem, state).state
        curve.append(log_evidence(problem, state))
    return np.array(curve)
