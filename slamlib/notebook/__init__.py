"""What cells call: drives and their results, tables of data, figures, the map."""

from slamlib.notebook.drives import Drive, attempt, show_doubts, start, write_results
from slamlib.notebook.tabular import (
    accuracy,
    antenna_rows,
    calibration_rows,
    map_accuracy,
    table,
)

__all__ = ["Drive", "accuracy", "antenna_rows", "attempt", "calibration_rows", "map_accuracy",
           "show_doubts", "start", "table", "write_results"]
