"""Problems 3 and 4: SLAM with GTSAM on odometry, markers and ranges, as a pipeline.

GTSAM supplies weights and losses of the robust kernels, takes the last steps of every solution, and
detects variables that the measurements do not determine. The steps before, and the evidence of the
noise, solve the same linearised graph by normal equations in numpy, all factors of a kind at once.

Read `pipeline` first: its function `estimate` is the whole way from a dataset to the result. Each
stage makes the record of the next. The modules by stage (4 uses 5 on long drives):

    1  calibration          the table of what measurements share: wheels, places, sizes, delays
       measurements         Dataset -> Measurements: arrays, their weights, noise and structure
       own                  keys and values of GTSAM, and factors of one's own
    2  factors              odometry between the frames; errors and derivatives of all factors
    3  linear               State, the values of all variables; Problem, the factor graph; both ->
                            the linearised graph, and the evidence, for all values of the noise
       graph                the same graph in GTSAM; Problem, State -> Optimum by Gauss-Newton
    4  initialization       Measurements -> State: the start values, antennas by trilateration
    5  fit                  Problem, State -> State by ever narrower robust kernels; -> Fit: wheels,
                            noise, accepted measurements, memory of errors, in turn (stage 6)
    6  noise                Problem, State -> posterior of slip and noise factors
       choices              Fit -> Fit: arcs or Euler's steps, and which statements about wheels and
                            sensors are wrong; SlamResult -> ids of markers that are several places
    7  covariances          Fit -> State and Covariances, averaged over the posterior of the noise
       result               Fit -> SlamResult in world axes, with the poses between the frames

Symbols in code and docstrings; sizes are f frames, k markers, a antennas, s sightings, r ranges,
n unknowns besides the calibration, three of every variable, and (m, d) are m measurements of a kind
with d errors each:

    X_i      pose of frame i: m, m, rad
    L_j P_j  pose of marker j (m, m, rad), or position (m) if its heading is unknown
    A_k      position of antenna k, m
    c        (p,) calibration; q of its entries are unknowns, in the solver per standard deviation
    z, C     measured pose of a marker in the vehicle (m, m, rad), and its covariance
    e        errors, expected minus measured; whitened errors are U e, without unit
    U        square root information, upper triangular: U^T U = C^-1 or Q^-1
    Q        covariance of the odometry noise: m^2, m rad, rad^2
    J        derivatives of whitened errors by the unknowns
    H, g     information matrix (n, n), sum J^T J, and gradient (n,), sum J^T e
    B, D     information between the n unknowns and the calibration (n, q), and about it (q, q)
    delta    (n + q,) step of the unknowns

A frame is a keyframe: an encoder pose that is a variable of the graph. Axes of the covariances:

    sightings in the files               vehicle
    errors of sightings with a heading   measured pose (`Measurements.sighting_roots`)
    `Covariances` of poses and markers   each pose itself, as in GTSAM
    `Covariances` of points, antennas    world
    SlamResult                           world
"""

from slamlib.slam.graph import as_gtsam
from slamlib.slam.pipeline import estimate
from slamlib.slam.result import SlamResult

__all__ = ["SlamResult", "as_gtsam", "estimate"]
