"""What cells call: drives and their results, tables of data, figures, the map."""

from slamlib.notebook.drives import (
    Drive,
    attempted,
    notices,
    results_folder,
    show_doubts,
    solved,
    start,
)
from slamlib.notebook.tabular import accuracy, antenna_rows, calibration_rows, table

__all__ = ["Drive", "accuracy", "antenna_rows", "attempted", "calibration_rows",
           "notices", "results_folder", "show_doubts", "solved", "start", "table"]
