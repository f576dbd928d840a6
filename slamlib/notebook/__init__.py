"""What cells call: drives and their results, tables of data, figures, the map."""

from slamlib.notebook.drives import Drive, attempted, notices, show_doubts, solved, start
from slamlib.notebook.tabular import (
           accuracy,
           antenna_rows,
           calibration_rows,
           dataset_row,
           learned_row,
           table,
           vehicle_row,
)

__all__ = ["Drive", "accuracy", "antenna_rows", "attempted", "calibration_rows", "dataset_row",
           "learned_row", "notices", "show_doubts", "solved", "start", "table", "vehicle_row"]
