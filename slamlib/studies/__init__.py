"""Studies that justify choices: simulated drives, Monte Carlo trials, comparisons.

`rows` are those of a study that a notebook shows; `run` runs a trial.
"""

from slamlib.studies.runs import rows, run

__all__ = ["rows", "run"]
