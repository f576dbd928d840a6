"""Stage 6: the normal equations of the first frames of a long drive, at the same state."""

from dataclasses import replace

import numpy as np

from slamlib.slam.measurements import measure
from slamlib.slam.normal_equations import NormalEquations

ENOUGH = 5000                # measurements of a sensor that show the factor on its sigmas to 1 %

def first_frames(equations, count):
    """The NormalEquations of what was measured at the first `count` frames.

    Odometry keeps its share of the rounding of the whole drive, and every measurement its weight.
    The result is `equations` itself if there are fewer frames, or if the first ones have less than
    ENOUGH of the sightings or ranges that the drive has.
    """
    problem, state, m = equations.problem, equations.state, equations.problem.measurements
    if len(m.frame) <= count:
        return equations
    part = measure(m.dataset.first(int(m.frame[count - 1]) + 1))
    if len(part.label) < min(ENOUGH, len(m.label)) \
            or len(part.ranges.row) < min(ENOUGH, len(m.ranges.row)):
        return equations
    markers, antennas = (np.searchsorted(all_of_them, own) for all_of_them, own in (
        (m.marker, part.marker), (m.antenna, part.antenna)))
    part = replace(part, oriented=m.oriented[markers], calibrated=m.calibrated)
    measured = replace(problem.measured, measurements=part, weight=np.r_[
        problem.measured.sighting_weight[:len(part.label)],
        problem.measured.range_weight[:len(part.ranges.row)]])
    odometry = replace(problem.odometry, **{
        name: getattr(problem.odometry, name)[:count - 1]
        for name in ("increment", "by_w", "rounding", "slipping")})
    return NormalEquations(
        replace(problem, measurements=part, odometry=odometry, measured=measured),
        replace(state, poses=state.poses[:count], markers=state.markers[markers],
                antennas=state.antennas[antennas]))
