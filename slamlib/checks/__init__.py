"""Checks that need no truth: what the measurements of a drive say against each other.

    consistency  poses: returns to the same place, and distances from a better method
    map_checks   maps: residuals by landmark, and both halves of the drive against each other
"""
