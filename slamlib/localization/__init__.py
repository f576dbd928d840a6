"""Problem 2: incremental localization from the markers, alone and fused with odometry."""

from slamlib.localization.doubts import doubts_before_solving
from slamlib.localization.fused import Fusion, fuse
from slamlib.localization.hint import fuse_increments
from slamlib.localization.markers import Localization, localize

__all__ = ["Fusion", "Localization", "doubts_before_solving", "fuse", "fuse_increments", "localize"]
