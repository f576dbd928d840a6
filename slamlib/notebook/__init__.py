"""Code for notebooks: drives and results, sentences and tables, figures, sliders."""

from slamlib.notebook.show import (
    Drive,
    captioned,
    interactive,
    listed,
    plain,
    results_folder,
    say,
    start,
    table,
    table_text,
    with_sensor,
    with_truth,
)
from slamlib.notebook.solving import delivered, notices, say_doubts, solved, where_possible

__all__ = ["Drive", "captioned", "delivered", "interactive", "listed", "notices", "plain",
           "results_folder", "say", "say_doubts", "solved", "start", "table", "table_text",
           "where_possible", "with_sensor", "with_truth"]
