"""Vehicle SLAM from wheel encoders, ceiling markers and UWB ranges: the numerics of the report.

Each module holds one idea and is meant to be read top to bottom; docs/code.md lists them and says
where each equation is.
"""

__version__ = "0.1.0"
