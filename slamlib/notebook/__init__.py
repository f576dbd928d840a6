"""Code for notebooks: drives and results, sentences and tables, figures, sliders."""

from slamlib.notebook.answers import answer, median_sigmas, result_sentence, with_unit
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

__all__ = ["Drive", "answer", "captioned", "delivered", "interactive", "listed", "median_sigmas",
           "notices", "plain", "result_sentence",
           "results_folder", "say", "say_doubts", "solved", "start", "table", "table_text",
           "where_possible", "with_sensor", "with_truth", "with_unit"]
