"""Vehicle SLAM from wheel encoders, ceiling markers and UWB ranges: the numerics of the report.

Each module holds one idea and is meant to be read top to bottom; docs/code.md lists them and says
where each equation is.

>>> from slamlib import evaluation, slam
>>> from slamlib.simulation import simulate
>>> dataset, truth = simulate("short", seed=1)                  # or dataset.read_dataset(folder)
>>> found = slam.estimate(dataset.first(400), kernel="Huber")
>>> found.poses.shape, found.marker_covariance.shape[1:]
((400, 3), (3, 3))
>>> bool(evaluation.ate(found.poses, truth.poses[:400]) < 0.01)                            # m
True
"""

__version__ = "0.1.0"
