"""Code for notebooks: drives and results, sentences and tables, figures, sliders."""

from slamlib.notebook.answers import (
    answer,
    median_sigmas,
    result_sentence,
    slip_in_words,
    with_unit,
)
from slamlib.notebook.means import (
    is_significant,
    mean_and_error,
    number,
    share,
    verdict,
    with_error,
)
from slamlib.notebook.show import (
    Drive,
    captioned,
    code,
    dash_note,
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
from slamlib.notebook.solving import notices, say_doubts, solved, where_possible, write_results

__all__ = ["Drive", "answer", "captioned", "code", "dash_note", "interactive", "is_significant",
           "listed", "mean_and_error", "median_sigmas", "notices", "number", "plain",
           "result_sentence", "results_folder", "say", "say_doubts", "share", "slip_in_words",
           "solved", "start", "table", "table_text", "verdict", "where_possible", "with_error",
           "with_sensor", "with_truth", "with_unit", "write_results"]
