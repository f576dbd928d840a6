"""Vehicle SLAM from wheel encoders, ceiling markers and UWB ranges: the numerics of the report.

`core` holds what the chapters derive, `robust` what real drives need beyond it, `io` reads and
writes files. docs/code.md lists the modules and says where each equation is. The names below are
the ones that a user needs first; each is imported when it is asked for.
"""

from importlib import import_module

__version__ = "0.1.0"

_MODULES = {
    "read_dataset": "io.dataset",
    "dataset_from_arrays": "io.dataset",
    "read_truth": "io.dataset",
    "dead_reckoning": "core.odometry",
    "localize": "core.markers",
    "Localization": "core.markers",
    "fuse_increments": "core.hint",
    "Fusion": "core.hint",
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
