"""Stage 6: on a very long drive, noise is learned from the first frames only."""

from dataclasses import replace

import numpy as np

from slamlib.slam.measurements import measure
from slamlib.slam.normal_equations import NormalEquations

LEARNING_FRAMES = 20_000     # number of first frames from which noise is learned on a long drive
MIN_MEASUREMENTS = 5000      # of a sensor: they determine the factor on its sigmas to 1 %


def equations_of_first_frames(equations):
    """The NormalEquations of the measurements at the first LEARNING_FRAMES.

    The odometry keeps its noise of the whole drive, and every measurement its weight. Returns
    `equations` itself if there are no more frames, or if the first ones have fewer than
    MIN_MEASUREMENTS of the sightings or ranges of the drive.
    """
    problem, state, m = equations.problem, equations.state, equations.problem.measurements
    count = LEARNING_FRAMES
    if len(m.frame) <= count:
        return equations
    part = measure(m.dataset.first(int(m.frame[count - 1]) + 1))
    if len(part.marker_row) < min(MIN_MEASUREMENTS, len(m.marker_row)) \
            or len(part.ranges.row) < min(MIN_MEASUREMENTS, len(m.ranges.row)):
        return equations
    markers = np.searchsorted(m.marker, part.marker)
    antennas = np.searchsorted(m.antenna, part.antenna)
    part = replace(part, oriented=m.oriented[markers], calibrated=m.calibrated)
    accepted = replace(problem.accepted, measurements=part, weight=np.r_[
        problem.accepted.sighting_weight[:len(part.marker_row)],
        problem.accepted.range_weight[:len(part.ranges.row)]])
    odometry = replace(problem.odometry, **{
        name: getattr(problem.odometry, name)[:count - 1]
        for name in ("increment", "J_w", "quantization", "slipping")})
    return NormalEquations(
        replace(problem, odometry=odometry, accepted=accepted),
        replace(state, poses=state.poses[:count], markers=state.markers[markers],
                antennas=state.antennas[antennas]))
