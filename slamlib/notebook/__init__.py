"""Code for notebooks: drives and results, sentences and tables, figures, sliders."""

from slamlib.notebook.show import (
    Drive,
    captioned,
    interactive,
    listed,
    results_folder,
    say,
    start,
    table,
    table_text,
    with_sensor,
    with_truth,
)

__all__ = ["Drive", "captioned", "interactive", "listed", "results_folder", "say", "start", "table",
           "table_text", "with_sensor", "with_truth"]
