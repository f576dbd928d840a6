"""Robust kernels of GTSAM, by name."""

from gtsam.noiseModel import mEstimator

# Classes, and scales in sigmas; the first kernel is the default. The scales of Huber, Cauchy and
# Tukey have 95 % efficiency on Gaussian noise (Zhang, Image and Vision Computing 15(1), 1997).
CLASS_AND_SCALE = {
    "asymmetric Tukey": (mEstimator.AsymmetricTukey, 4.685),
    "asymmetric Cauchy": (mEstimator.AsymmetricCauchy, 2.385),
    "quadratic": None,
    "Huber": (mEstimator.Huber, 1.345),
    "Cauchy": (mEstimator.Cauchy, 2.385),
    "Geman-McClure": (mEstimator.GemanMcClure, 3.0),
    "Tukey": (mEstimator.Tukey, 4.685),
}
# Location b, in sigmas, for which a one-sided kernel weighs standard normal residuals r, measured
# minus expected, to E[weight(r - b) (r - b)] = 0. Only r > 0, a late range, loses weight, so the
# weighted mean of r is below 0: b sigmas are subtracted from each range.
ONE_SIDED_BIAS = {"asymmetric Cauchy": -0.10555, "asymmetric Tukey": -0.07581}


def symmetric(name: str) -> str:
    """The name of the kernel of sightings: this one, unless it is one-sided, for ranges only."""
    return "quadratic" if name in ONE_SIDED_BIAS else name


def kernel_of(name: str, width: float = 1.0) -> mEstimator.Base | None:
    """The kernel of this name with its scale times `width`, None for "quadratic".

    Asymmetric kernels need signed errors, which GTSAM passes to them with the scheme Scalar.
    """
    if CLASS_AND_SCALE[name] is None:
        return None
    kind, scale = CLASS_AND_SCALE[name]
    if name in ONE_SIDED_BIAS:
        return kind.Create(scale * width, mEstimator.Base.ReweightScheme.Scalar)
    return kind.Create(scale * width)


KERNELS = {name: kernel_of(name) for name in CLASS_AND_SCALE}
