"""Checks that need no truth: they compare the measurements of a drive with each other.

    files        files against each other, before anything is solved
    solution     the solution of problem 3 or 4 against the files
    consistency  loop closures, and residuals by landmark
"""
