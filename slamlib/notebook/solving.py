"""Solves the problems of a chapter, and shows failures and doubts there and on the first page.

Each of these sentences carries its record in the metadata of the notebook's output. The report's
first page collects the records from the executed notebooks by `notices`, so the results folders
hold the files to hand in and nothing else, and a cached notebook keeps its records.
"""

from dataclasses import asdict

from IPython.display import Markdown, display
from tqdm import tqdm

from slamlib import solve
from slamlib.doubt import Doubt
from slamlib.notebook.show import (
    code,
    interactive,
    listed,
    plain,
    results_folder,
    say,
    simulated_drive,
)

KEY = "slamlib"  # of records in the metadata of outputs
# Types of records by their key.
RECORDS = {"doubt": Doubt, "failure": solve.Failure}


def solved(drives, problems, optional=()):
    """The drives on which all `problems` can be solved, and all results.

    Sentences say what could not be solved where, and why. If no drive is left, a simulated short
    drive replaces them, so that the chapter is complete.

    Parameters
    ----------
    drives : list of Drive
    problems : list of str, names of `solve.PROBLEMS` that the chapter needs.
    optional : list of str, problems that are solved first where possible.

    Returns
    -------
    drives : list of Drive
    found : dict by problem of dicts by the name of the drive, what `solve.find` returns; also of
        drives that the chapter leaves out.
    """
    found = {problem: {} for problem in (*optional, *problems)}
    pairs = [(drive, problem) for drive in drives for problem in found]
    for drive, problem in tqdm(pairs, disable=not interactive(), leave=False):
        _solve(drive, problem, found)
    left = [drive for drive in drives if all(drive.name in found[p] for p in problems)]
    if left and len(left) < len(drives):
        without = [plain(drive.name) for drive in drives if drive not in left]
        say(f"*This chapter leaves out {listed(without)}.*")
    if not left:
        say("*No drive is left, so this chapter runs on a simulated drive instead.*")
        left, others = solved([simulated_drive(drives)], problems, optional)
        found = {problem: found[problem] | others[problem] for problem in found}
    return left, found


def _solve(drive, problem, found):
    if not solve.allows(drive.dataset, problem):
        return
    known = {other: by_drive[drive.name] for other, by_drive in found.items()
             if drive.name in by_drive}
    try:
        found[problem][drive.name] = solve.find(problem, drive.dataset, known)
    except solve.UNSOLVABLE as error:
        if drive.made_up:
            raise
        failure = solve.failure(problem, drive.dataset, error)
        _say(drive, f"*The problem “{failure.title}” could not be solved on {plain(drive.name)}: "
                    f"{plain(failure.reason)}.*", failure=failure)


def where_possible(drives, function, what):
    """{name of the drive: function(drive)} of drives on which it can be solved.

    A sentence says on which drives `what` cannot be shown. For comparisons with a chapter's result.
    """
    found = {}
    for drive in drives:
        try:
            found[drive.name] = function(drive)
        except solve.UNSOLVABLE as error:
            say(f"*{what} cannot be shown on {plain(drive.name)}: {plain(str(error))}.*")
    return found


def say_doubts(drive, doubts):
    """Say each Doubt of a list about a Drive."""
    for doubt in doubts:
        _say(drive, f"**{plain(drive.name)}**: {plain(doubt.sentence)}", doubt=doubt)


def _say(drive, markdown, **record):
    (kind, value), = record.items()
    entry = {"dataset": drive.name, kind: asdict(value)}
    display(Markdown(markdown), metadata={} if drive.made_up else {KEY: entry})


def write_results(drives, found):
    """Write the files of all results that `solved` found, and yield what was written.

    Yields (Drive, Solution, names of the files as a str); a simulated drive has no files, and a
    sentence says so if there is no other.
    """
    pairs = [(drive, problem) for drive in drives for problem, by_drive in found.items()
             if drive.name in by_drive and not drive.made_up]
    if not pairs:
        say("A simulated drive has no files to hand in.")
    for drive, problem in pairs:
        solution = solve.problem_solution(problem, drive.dataset, found[problem][drive.name])
        folder = solve.write_solution(results_folder(drive), solution)
        yield drive, solution, listed([code(file.name) for file in sorted(folder.glob("*.mat"))])


def notices(books):
    """Records in executed notebooks, by dataset: {name: list of Doubt and Failure}, each once."""
    found = {}
    for book in books:
        for cell in book.cells:
            for output in cell.get("outputs", ()):
                entry = output.get("metadata", {}).get(KEY, {})
                for kind in RECORDS.keys() & entry.keys():
                    found.setdefault(entry["dataset"], []).append(RECORDS[kind](**entry[kind]))
    return {name: list(dict.fromkeys(records)) for name, records in found.items()}
