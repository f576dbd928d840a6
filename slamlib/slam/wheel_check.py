"""Stage 7: whether wheels far from the stated ones explain a drive that the stated ones do not.

Slip that is learned explains any path, so a wheel that is far from its stated value appears as
slip and strains everything else, while its estimate hardly moves. Such a drive is solved again with
wheels that are known to a few percent only, and the evidence of both is compared.
"""

from dataclasses import replace

import numpy as np

from slamlib.dataset import DatasetError
from slamlib.doubt import Doubt
from slamlib.slam.drive_doubts import NEARLY, far_off, marker_size, wheels_in_words
from slamlib.slam.fit import refine
from slamlib.slam.measurements import measure

SUSPICIOUS_SLIP = 3e-3       # sqrt(m), from which the wheels are checked
GENEROUS = 0.05              # relative standard deviation of radii and wheelbase
MOST = 0.98                  # of the measurements, that the other wheels must accept as well
LESS_SLIP = 0.7              # of the slip with the stated wheels, that may remain
EXPLAINED = {"wheel-parameters", "wheel-slip", "camera-offset", "time-offset"}


def with_checked_wheels(found, fit, solve):
    """The SlamResult of a Fit, with the doubt that its wheels are not as stated if they explain it.

    `solve` makes a Fit from Measurements and this SlamResult.
    """
    doubted = {doubt.what for doubt in found.drive_doubts}
    if not fit.problem.measurements.learned[0] or not (
            found.slip > SUSPICIOUS_SLIP or doubted & EXPLAINED):
        return found
    dataset = fit.problem.measurements.dataset
    stated = dataset.vehicle
    generous = replace(
        stated, sigma_right_radius=GENEROUS * stated.right_radius,
        sigma_left_radius=GENEROUS * stated.left_radius,
        sigma_wheelbase=GENEROUS * stated.wheelbase)
    try:
        other = solve(measure(replace(dataset, vehicle=generous)), found)
        own = refine(_on_measurements_of(other, fit), fit.state, accept=None)
    except (DatasetError, np.linalg.LinAlgError):
        return found
    wheel = stated.wheel + generous.sigma_wheel * other.state.w
    lead = other.posterior.density - own.posterior.density
    if other.problem.measured.weight.sum() < MOST * fit.problem.measured.weight.sum() \
            or other.problem.noise.slip > LESS_SLIP * found.slip:
        return found
    if lead < max(NEARLY, found.camera.time.gain, found.camera.place.gain) \
            or not far_off(stated, wheel).any():
        return found
    doubt = Doubt("wheel-parameters", (
        f"The drive is explained far better if {wheels_in_words(stated, wheel)}: measure the "
        "wheels, and state their values or larger sigmas in vehicle.toml."
        + marker_size(stated, wheel)))
    rest = (doubt for doubt in found.drive_doubts if doubt.what not in EXPLAINED)
    return replace(found, drive_doubts=(doubt, *rest))


def _on_measurements_of(other, fit):
    """The Problem of a Fit with what another Fit of the same drive accepts."""
    measured = replace(other.problem.measured, measurements=fit.problem.measurements)
    return replace(fit.problem, measured=measured)
