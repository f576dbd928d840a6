"""Stage 7: a check whether wheels far from the stated ones explain the drive better.

Learned slip explains any path, so a wheel that is far from its stated value appears as slip, while
its estimate hardly changes. A drive with large slip is solved again with wheels that are known to a
few percent only, and the evidence of both solutions is compared.
"""

from dataclasses import replace

import numpy as np

from slamlib.dataset import DatasetError
from slamlib.doubt import Doubt
from slamlib.slam.drive_doubts import MIN_LEAD, far_off, marker_size, wheels_in_words
from slamlib.slam.fit import refine
from slamlib.slam.measurements import measure

SUSPICIOUS_SLIP = 3e-3       # sqrt(m), from which the wheels are checked
WEAK_WHEEL_SIGMA = 0.05      # relative standard deviation of radii and wheelbase
MIN_ACCEPTED = 0.98          # ratio of the accepted measurements, of other to stated wheels
MAX_SLIP_RATIO = 0.7         # ratio of the slips, of other to stated wheels
# Doubts that wheels far from the stated ones explain.
EXPLAINED = {"wheel-parameters", "wheel-slip", "camera-offset", "time-offset"}


def with_checked_wheels(result, fit, refit):
    """The SlamResult of a Fit, with a doubt if other wheel parameters explain the drive better.

    `refit` makes a Fit from Measurements and a SlamResult.
    """
    doubted = {doubt.what for doubt in result.drive_doubts}
    if not fit.problem.measurements.learned[0] or not (
            result.slip > SUSPICIOUS_SLIP or doubted & EXPLAINED):
        return result
    dataset, stated = fit.problem.measurements.dataset, fit.problem.measurements.dataset.vehicle
    uncertain = replace(
        stated, sigma_right_radius=WEAK_WHEEL_SIGMA * stated.right_radius,
        sigma_left_radius=WEAK_WHEEL_SIGMA * stated.left_radius,
        sigma_wheelbase=WEAK_WHEEL_SIGMA * stated.wheelbase)
    try:
        alternative = refit(measure(replace(dataset, vehicle=uncertain)), result)
        wheel = stated.wheel + uncertain.sigma_wheel * alternative.state.w
        if alternative.problem.accepted.weight.sum() \
                < MIN_ACCEPTED * fit.problem.accepted.weight.sum() \
                or alternative.problem.noise.slip > MAX_SLIP_RATIO * result.slip \
                or not far_off(stated, wheel).any():
            return result
        accepted = replace(alternative.problem.accepted, measurements=fit.problem.measurements)
        compared = refine(replace(fit.problem, accepted=accepted), fit.state, accept=None)
    except (DatasetError, np.linalg.LinAlgError):
        return result
    lead = alternative.posterior.log_density - compared.posterior.log_density
    if lead < max(MIN_LEAD, result.camera.time.gain, result.camera.place.gain):
        return result
    doubt = Doubt("wheel-parameters", (
        f"The drive is explained far better if {wheels_in_words(stated, wheel)}: measure the "
        "wheels, and state their values or larger sigmas in vehicle.toml."
        + marker_size(stated, wheel)))
    remaining = (doubt for doubt in result.drive_doubts if doubt.what not in EXPLAINED)
    return replace(result, drive_doubts=(doubt, *remaining))
