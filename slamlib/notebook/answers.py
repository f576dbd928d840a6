"""Shows the box *Answer* that opens a chapter, and states results in sentences."""

import numpy as np

from slamlib import evaluation
from slamlib.notebook.means import three_digits
from slamlib.notebook.show import plain, say
from slamlib.solve import truth_in_world

# Headings of the paragraphs of the box.
ANSWER_PARTS = ("Question", "Method", "Initial values", "Result", "Files and figure")


def answer(question, method, initial_values, results, files):
    """Show the box *Answer*, a block quote, around which the pages and the PDF draw a frame.

    Parameters
    ----------
    question, method, initial_values, files : str, Markdown of one paragraph each.
    results : list of str, a sentence for each dataset, as by `result_sentence`.
    """
    texts = (question, method, initial_values, " ".join(results), files)
    lines = [f"**{part}.** {text}" for part, text in zip(ANSWER_PARTS, texts) if text]
    say("> **Answer**\n>\n> " + "\n>\n> ".join(lines))


def median_sigmas(solution):
    """Medians over the estimated poses of a Solution: (of position in m, of heading in rad).

    The sigma of position is the larger of those of x and y.
    """
    known = np.isfinite(solution.poses[:, 0])
    covariances = solution.covariances[known]
    return (float(np.median(evaluation.position_sigmas(covariances))),
            float(np.median(evaluation.sigmas(covariances)[:, 2])))


def result_sentence(drive, solution):
    """Sentence (str) on a Solution of a Drive: median sigmas and, where there is truth, errors."""
    position, heading = median_sigmas(solution)
    sentence = (f"*{plain(drive.name)}*: median σ {with_unit(position, 'm')} of position and "
                f"{with_unit(heading, 'rad')} of heading")
    if drive.truth is None:
        return sentence + "."
    truth = truth_in_world(solution, drive.truth)
    ate, aligned = (evaluation.ate(solution.poses, truth, each) for each in (False, True))
    return sentence + f"; ATE {with_unit(ate, 'm')}, {with_unit(aligned, 'm')} aligned."


def slip_in_words(result):
    """Slip of a SlamResult after one metre with its relative σ, or "as given" (str)."""
    number = f"{1e3 * result.slip:.2f} mm"
    return f"{number} ± {100 * result.noise_sigma[0]:.0f}\u00a0%" if result.noise_sigma[0] \
        else f"{number}, as given"


def with_unit(value, unit):
    """A value with three significant digits and its unit (str), below 1 with the prefix milli."""
    value, unit = (value, unit) if abs(value) >= 1 else (1e3 * value, f"m{unit}")
    return f"{three_digits(value)}\u00a0{unit}"
