"""Robust kernels of GTSAM, by name."""

import gtsam

_kernel = gtsam.noiseModel.mEstimator
# By name, scales in sigmas. Those of Huber, Cauchy and Tukey have 95 % efficiency on Gaussian noise
# (Zhang, Image and Vision Computing 15(1), 1997). Asymmetric kernels need signed errors, which
# GTSAM passes to them with the scheme Scalar.
_scalar = _kernel.Base.ReweightScheme.Scalar
KERNELS = {
    "asymmetric Tukey": _kernel.AsymmetricTukey.Create(4.685, _scalar),
    "asymmetric Cauchy": _kernel.AsymmetricCauchy.Create(2.385, _scalar),
    "quadratic": None,
    "Huber": _kernel.Huber.Create(1.345),
    "Cauchy": _kernel.Cauchy.Create(2.385),
    "Geman-McClure": _kernel.GemanMcClure.Create(3.0),
    "Tukey": _kernel.Tukey.Create(4.685)}
# Location b, in sigmas, for which a one-sided kernel weighs standard normal residuals r to
# E[weight(r - b) (r - b)] = 0: it makes their mean too small. Ranges are compared with it.
ONE_SIDED = {"asymmetric Cauchy": -0.10555, "asymmetric Tukey": -0.07581}
