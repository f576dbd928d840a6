"""Studies that justify choices: Monte Carlo trials, comparisons, a real log; `run` runs a trial."""

from slamlib.studies.runs import run

__all__ = ["run"]
