"""Problem 2: incremental localization from the markers, alone and fused with odometry."""

from slamlib.localization.fused import Fusion, fuse
from slamlib.localization.hint import fuse_increments
from slamlib.localization.markers import Localization, localize

__all__ = ["Fusion", "Localization", "fuse", "fuse_increments", "localize"]
