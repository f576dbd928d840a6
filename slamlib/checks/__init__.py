"""Checks that need no truth: they compare the measurements of a drive with each other.

    files        files against each other, before anything is solved
    solution     the solution of problem 3 or 4 against the files
    consistency  poses: loop closures, and differences from a more informed method
    map_checks   maps: residuals by landmark, and the maps of both halves of a drive
"""
