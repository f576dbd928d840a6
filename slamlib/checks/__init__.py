"""Checks that need no truth: they compare the measurements of a drive with each other."""
