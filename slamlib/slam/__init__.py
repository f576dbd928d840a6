"""Problems 3 and 4: SLAM with GTSAM on odometry, markers and ranges, as a pipeline.

GTSAM supplies weights and losses of the robust kernels, takes the last steps of every solution, and
detects variables that the measurements do not determine. The steps before, and the evidence of the
noise, solve the same linearised graph by normal equations in numpy, all factors of a kind at once.

Read `pipeline` first: its function `estimate` is the whole way from a dataset to the result. Each
stage makes the record of the next: Measurements, Problem and State, Fit, SlamResult. docs/code.md
lists the modules by their stages.

Symbols in code and docstrings; sizes are f frames, k markers, a antennas, s sightings, r ranges,
n unknowns besides the calibration, three of every variable, and (m, d) are m measurements of a kind
with d errors each:

    X_i      pose of frame i: m, m, rad
    L_j P_j  pose of marker j (m, m, rad), or position (m) if its heading is unknown
    A_k      position of antenna k, m
    c        (p,) calibration; q of its entries are unknowns, in the solver per standard deviation
    z, C     measured pose of a marker in the camera (m, m, rad), and its covariance
    e        errors, expected minus measured; whitened errors are U e, without unit
    U        square root information, upper triangular: U^T U = C^-1 or Q^-1
    Q        covariance of the odometry noise: m^2, m rad, rad^2
    J        derivatives of whitened errors by the unknowns
    H, g     information matrix (n, n), sum J^T J, and gradient (n,), sum J^T e
    B, D     information between the n unknowns and the calibration (n, q), and about it (q, q)
    delta    (n + q,) step of the unknowns

A frame is a keyframe: an encoder pose that is a variable of the graph. docs/code.md has the axes of
all covariances.
"""

from slamlib.slam.graph import as_gtsam
from slamlib.slam.pipeline import estimate
from slamlib.slam.result import SlamResult

__all__ = ["SlamResult", "as_gtsam", "estimate"]
