"""Problems 3 and 4: SLAM with GTSAM on odometry, markers and ranges, as a pipeline.

GTSAM keeps the robust kernels, orders the elimination, takes the last steps of every solution, and
says what the measurements do not determine. The steps before, and the evidence of the noise, solve
the same graph by normal equations in numpy, all factors of a kind at once.

Each stage makes the record of the next. The modules, in the order in which they can be read
(stage 5 runs before stage 4, and uses it for the parts of a long drive):

    1  structure            which unknowns a factor touches, and where in the sparse matrix
       measurements         Dataset -> Measurements: arrays, numbered once
    2  errors               errors of the factors and their derivatives, in numpy
       odometry_factors     odometry between frames, which depends on the wheels
       measurement_factors  which sightings and ranges are accepted, and their kernels
       linear_factors       sightings and ranges linearised in numpy
       noise                slip, and factors on the sigmas of sightings and ranges
    3  state                values of all variables: State
       problem              Measurements, factors and noise -> Problem, the factor graph
       normal_equations     Problem, State -> the linearised graph, for all values of the noise
       gtsam_graph          the same graph in GTSAM
       optimizer            Problem, State -> Optimum by Gauss-Newton
    4  robust               Problem, State -> State past outliers; the accepted measurements
    5  trilateration        places of an antenna from its ranges
       initialization       Measurements -> State: the start values
    6  evidence             Problem, State -> evidence of every value of the noise
       first_frames         of a drive of a million rows, what the noise is learned from
       noise_posterior      Problem, State -> the noise, and how well it is known
       fit                  Problem, State -> Fit: wheels, noise, accepted measurements, in turn
       model_choice         Fit -> Fit: arcs or Euler's steps
       range_calibration    Fit -> Fit: with an offset and a scale of the ranges, if there are any
    7  covariances, moments, interpolation, result
                            Fit -> SlamResult in world axes
       doubts, camera_offsets, drive_doubts, wheel_check
                            what the solution says against the files

`estimate` is all of it. With the result of a problem with fewer sensors at hand, it starts there
and skips stage 5 and the choice of the model.
"""

from slamlib.slam.drive_doubts import confirmation
from slamlib.slam.estimate import estimate
from slamlib.slam.result import SlamResult

__all__ = ["SlamResult", "confirmation", "estimate"]
