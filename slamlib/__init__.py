"""Vehicle SLAM from wheel encoders, ceiling markers and UWB ranges: the numerics of the report.

Each module holds one idea and is meant to be read top to bottom; see the README for the map.
"""
