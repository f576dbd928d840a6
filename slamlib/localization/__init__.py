"""Problem 2: incremental localization from the markers, alone and fused with odometry."""

from slamlib.localization.doubts import drive_doubts
from slamlib.localization.fused import Fusion, fuse
from slamlib.localization.hint import fuse_increments
from slamlib.localization.markers import Localization, localize

__all__ = ["Fusion", "Localization", "drive_doubts", "fuse", "fuse_increments", "localize"]
