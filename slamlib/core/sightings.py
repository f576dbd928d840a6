"""Sightings of markers, merged and sorted by frame, and the gates of problems 2 to 4.

A frame is a pose of the vehicle with a measurement. A sighting is the pose z of a marker in the
frame of the camera or, where what is stated of the camera is applied (`Dataset.sightings`), of the
vehicle, with the covariance C of [x, y, heading]. A gate is the 99.9 % quantile of the squared
Mahalanobis distance r^T W^-1 r of a residual r with covariance W; beyond it r is rejected.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.core import se2
from slamlib.core.records import NO_SIGHTINGS, ArucoReadings

GATE = 16.26623619623813         # dimensionless, for residuals of [x, y, heading]
POINT_GATE = 13.815510557964274  # dimensionless, for residuals of [x, y]
MEDIAN_CHI2 = {3: 2.366, 2: 1.386, 1: 0.455}     # medians of chi-squared by degrees of freedom
MIN_MEASUREMENT_SIGMA = 1e-6     # m or rad, of one coordinate given the others
MIN_SIGMA_RATIO = 1e-6           # of the standard deviations of x and y
MAX_HEADING_SIGMA = 0.5          # rad; with a larger standard deviation a heading is unknown


@dataclass(frozen=True)
class Sightings:
    """At most one sighting per frame and marker, sorted by frame, then by marker id."""

    index: np.ndarray        # (s,) row in ArucoReadings
    row: np.ndarray          # (s,) row in `frame`
    marker: np.ndarray       # (s,) marker id
    z: np.ndarray            # (s, 3) marker in vehicle, m and rad
    C: np.ndarray            # (s, 3, 3) covariance of z
    frame: np.ndarray        # (f,) pose index from 0 of every frame, ascending
    contradicting: int = 0   # number of repeated sightings that contradict each other

    def table(self) -> np.ndarray:
        """Row (f, k) of the sighting of each marker, in ascending id, at each frame, or -1."""
        markers, label = np.unique(self.marker, return_inverse=True)
        table = np.full((len(self.frame), len(markers)), -1, np.int32)
        table[self.row, label] = np.arange(len(self.row))
        return table


def sightings_by_frame(aruco: ArucoReadings | None, extra_frames=()) -> Sightings:
    """Sightings of ArucoReadings, or of None if there are no markers, merged by `merge_repeated`.

    `extra_frames` are pose indices from 0 that are frames even if no marker is seen there.
    """
    aruco = aruco or NO_SIGHTINGS
    aruco = replace(aruco, covariance=regularized(aruco.covariance))
    index, z, C, contradicting = merge_repeated(aruco)
    pose = aruco.pose[index]
    frame = np.union1d(pose, extra_frames).astype(int)
    return Sightings(index=index, row=np.searchsorted(frame, pose), marker=aruco.marker[index],
                     z=z, C=C, frame=frame, contradicting=contradicting)


def regularized(covariance: np.ndarray) -> np.ndarray:
    """Covariances (m, 3, 3), increased where float64 could not invert or add their information.

    Where the standard deviation of x, y or heading, given the other two, is below
    MIN_MEASUREMENT_SIGMA, as of nearly fully correlated coordinates, the variance is increased by
    its square. For x and y the bound is at least MIN_SIGMA_RATIO of the larger standard deviation.
    """
    sigma = se2.sigmas(covariance)
    information = np.linalg.inv(se2.correlations(covariance))
    conditional_variance = sigma**2 / np.diagonal(information, axis1=1, axis2=2)
    larger = sigma[:, :2].max(axis=1, keepdims=True)
    bound = np.full_like(sigma, MIN_MEASUREMENT_SIGMA)
    bound[:, :2] = np.maximum(MIN_MEASUREMENT_SIGMA, MIN_SIGMA_RATIO * larger)
    added = np.where(conditional_variance < bound**2, bound**2, 0.0)
    return covariance + added[:, :, None] * np.eye(3)


def merge_repeated(aruco: ArucoReadings) -> tuple:
    """`index`, `z`, `C` and `contradicting` of Sightings, with one row for each pose and marker.

    Repeated sightings in ArucoReadings of a marker at one pose are averaged, weighted by their
    information matrices, if all of them lie within GATE of the mean. Otherwise all are rejected.
    """
    order = np.lexsort((aruco.marker, aruco.pose))
    sorted_by_frame = aruco.select(order)                 # a copy, in which means replace the first
    z = sorted_by_frame.marker_in_vehicle
    C = sorted_by_frame.covariance
    key = np.stack([sorted_by_frame.pose, sorted_by_frame.marker], -1)
    _, begins, count = np.unique(key, axis=0, return_index=True, return_counts=True)
    agrees = np.ones(len(begins), bool)
    for i in np.flatnonzero(count > 1):
        first = begins[i]
        same = slice(first, first + count[i])
        z[first], C[first], agrees[i] = _mean(z[same], C[same])
    kept = begins[agrees]
    return order[kept], z[kept], C[kept], int(count[~agrees].sum())


def _mean(z, C):
    """Weighted mean (3,) of sightings (n, 3), its covariance, and whether all are within GATE."""
    information = np.linalg.inv(C)
    r = se2.difference(z, z[0])
    covariance = np.linalg.inv(information.sum(0))
    mean = covariance @ np.matvec(information, r).sum(0)
    squared = se2.squared_norms(r - mean, C)
    return z[0] + mean, covariance, np.all(squared < GATE)


def consensus(marker: np.ndarray, in_world: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Rows (k,) of one sighting of each marker, in ascending id.

    It is the most certain one, by the determinant of its covariance, of those that agree with the
    median, or the one nearest to it. The median counts as certain as the sighting of median
    determinant. `marker` (s,) are ids, `in_world` (s, 3), m and rad, and `covariance` (s, 3, 3) the
    poses of these markers in world axes by each sighting.
    """
    order = np.argsort(marker, kind="stable")
    begins = np.flatnonzero(np.diff(marker[order])) + 1
    return np.array([same[_central(in_world[same], covariance[same])]
                     for same in np.split(order, begins) if len(same)], int)


def _central(in_world, covariance):
    """Number of the most certain pose (n, 3) of one marker that agrees with the median."""
    x, y, _ = np.median(in_world, axis=0)
    heading = in_world[:, 2]
    theta = np.arctan2(np.median(np.sin(heading)), np.median(np.cos(heading)))
    log_determinant = np.linalg.slogdet(covariance).logabsdet
    typical = covariance[np.argsort(log_determinant)[len(heading) // 2]]
    squared = se2.squared_distances(in_world, np.array([x, y, theta]), covariance + typical)
    agrees = squared <= max(GATE, squared.min())
    return np.where(agrees, log_determinant, np.inf).argmin()
