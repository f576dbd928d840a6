"""Vehicle SLAM from wheel encoders, ceiling markers and UWB ranges: the numerics of the report.

`slamlib.core` holds what the chapters derive, `slamlib.robust` what real drives need beyond it,
`slamlib.io` reads and writes files. docs/code.md says where each equation is.

Where to begin:

* read a drive: `slamlib.read_dataset`; take it from arrays: `slamlib.dataset_from_arrays`
* problem 1, odometry: `slamlib.core.odometry.equation2`
* problem 2: `slamlib.localize` by the markers alone, `slamlib.fuse_increments` and `slamlib.fuse`
  with odometry
* problems 3 and 4, SLAM: `slamlib.estimate`, which returns a `slamlib.SlamResult`
* a graph in GTSAM in which nothing is decided: `slamlib.count_everything`, `slamlib.build_graph`,
  `slamlib.initial_values`, `slamlib.solve_graph`
* what contradicts the files: `slamlib.robust.file_doubts.doubts_before_solving`,
  `slamlib.robust.solution_doubts.solution_doubts`
* write what is found: `slamlib.solve.write_results`; solve folders: `slamlib.solve.solve_folders`
* judge by the truth: `slamlib.read_truth`, `slamlib.core.evaluation`
* draw: `slamlib.notebook.plotting`, `slamlib.notebook.maps`
* simulate a drive: `slamlib.studies.simulation.simulate`

The names of `slamlib` itself are imported when they are asked for.
"""

from importlib import import_module

__version__ = "0.1.0"

_MODULES = {
    "read_dataset": "io.dataset",
    "dataset_from_arrays": "io.dataset",
    "read_truth": "io.dataset",
    "dead_reckoning": "core.odometry",
    "localize": "core.markers",
    "fuse_increments": "core.hint",
    "fuse": "robust.fused",
    "estimate": "robust.pipeline",
    "SlamResult": "robust.result",
    "count_everything": "core.graph",
    "build_graph": "core.graph",
    "initial_values": "core.graph",
    "solve_graph": "core.graph_solution",
}
__all__ = [*_MODULES]


def __getattr__(name):
    if name not in _MODULES:
        raise AttributeError(f"module 'slamlib' has no attribute '{name}'")
    globals()[name] = getattr(import_module(f"slamlib.{_MODULES[name]}"), name)
    return globals()[name]
