"""The summary that opens the report: an abstract, all results, the files to hand in, a figure.

All numbers are computed from the result files and, where it is known, the truth.
"""

import re
from collections import defaultdict
from pathlib import PurePosixPath
from urllib.parse import quote

import numpy as np
from nbformat.v4 import new_markdown_cell, new_notebook

from slamlib import evaluation, odometry
from slamlib.checks import consistency
from slamlib.notebook import code, dash_note, listed, median_sigmas, plain, table_text, with_unit
from slamlib.report.animation import moving
from slamlib.report.chapters import HTML_ONLY
from slamlib.report.drives import order
from slamlib.report.pictures import first_figure
from slamlib.results import RESULT_FILES
from slamlib.solve import PROBLEMS, SENSORS, title, truth_in_world

METHOD_PHRASES = {  # in the order of the problems; the hint is left to chapter 2
    "problem1": "by odometry (problem\u00a01)", "problem2": "by markers alone",
    "problem2_fused": "with odometry fused (problem\u00a02)",
    "problem3": "by SLAM on odometry and markers (problem\u00a03)",
    "problem4": "by SLAM with the UWB ranges (problem\u00a04)"}
MAX_NAMED = 3  # drives that the abstract names one by one


def opening(drives, address="."):
    """Return the opening of the report, an executed NotebookNode, for a list of SolvedDrive.

    `address` (str) is the path of the results folder from that of the report; with None the table
    of the files to hand in is left out.
    """
    solved = [drive for drive in drives if drive.solutions]
    texts = {"what": f"# Overview\n\n{abstract(drives)}",
             "results": _result_table(drives) if solved else "",
             "doubts": _doubts(drives), "notes": _notes(drives),
             "files": "" if address is None else _file_table(drives, PurePosixPath(address))}
    cells = [new_markdown_cell(text, id=name) for name, text in texts.items() if text]
    if solved:
        longest = max(solved, key=lambda drive: len(drive.dataset.ticks))
        cells += [*moving(longest), *first_figure(longest)]
    cells.append(new_markdown_cell(_dataset_table(drives), id="datasets",
                                   metadata={"tags": [HTML_ONLY]}))  # chapter 1 has this table
    return new_notebook(cells=cells)


def index(heading, first_page, chapters):
    """Return the first page, a NotebookNode: `first_page` by `opening` with links to all the rest.

    `heading` (str) is the title of the report, `chapters` are dicts by `chapters.chapter_of`.
    """
    links = "\n\n".join(
        f"### [{chapter['title']}]({chapter['file']})\n\n"
        + re.sub(r"\]\(#", f"]({chapter['file']}#", chapter["lead"]) for chapter in chapters)
    first, *others = first_page.cells
    text = first.source.removeprefix("# Overview")
    return new_notebook(cells=[
        new_markdown_cell(f"# {plain(heading)}{text}\n\n[The whole report as one PDF](report.pdf)",
                          id="what"),
        *others, new_markdown_cell("## Chapters\n\n" + links, id="chapters")])


def abstract(drives):
    """Return what was done and found, in Markdown: at most eight sentences, then data's origin.

    `drives` is a list of SolvedDrive.
    """
    sentences = [
        _what_was_done({name for name in SENSORS for drive in drives
                        if getattr(drive.dataset, name) is not None}),
        *_sigmas(drives), *(_errors(drives) or _returns(drives)), *_landmarks(drives)]
    simulated = [_emphasized(drive) for drive in drives if drive.simulated]
    return " ".join(sentences) + (f"\n\n{_said_of_simulated(simulated)}" if simulated else "")


def _emphasized(drive):
    return f"*{plain(drive.name)}*"


def _what_was_done(sensors):
    """Return the first sentence of the abstract for a set of SENSORS."""
    data = ["wheel encoders", *["ArUco markers on the ceiling"] * ("aruco" in sensors),
            *["UWB ranges"] * ("uwb" in sensors)]
    methods = ["by odometry",
               *["by markers", "by a filter that fuses both"] * ("aruco" in sensors),
               *["by one factor graph in GTSAM"] * bool(sensors)]
    return ("We estimate the trajectory of a differential-drive vehicle"
            + " and map its landmarks" * bool(sensors) + f" from {listed(data)}"
            + (f": {', '.join(methods[:-1])}, and {methods[-1]}." if len(methods) > 2
               else f", {listed(methods)}."))


def _said_of_simulated(names):
    are = "s {} are simulated stand-ins" if len(names) > 1 else " {} is a simulated stand-in"
    return (f"The dataset{are.format(listed(names))} for the course's logs, so the truth is known. "
            "With the course's logs in their place the errors are no longer known; everything else "
            "is computed in the same way.")


def _has_estimates(solution):
    """Return True if a Solution or None has an estimate of any pose."""
    return solution is not None and bool(np.isfinite(solution.poses[:, 0]).any())


def _in_abstract(drives):
    """Return the drives that the abstract names: all, or of many the shortest and the longest."""
    solved = [drive for drive in drives if any(map(_has_estimates, drive.solutions))]
    return solved if len(solved) <= MAX_NAMED else [solved[0], solved[-1]]


def _sigmas(drives):
    """Yield a sentence on each drive, with the median sigma of position by every problem."""
    listed_problems = None
    for drive in _in_abstract(drives):
        found = {problem: with_unit(median_sigmas(drive.solution(problem))[0], "m")
                 for problem in METHOD_PHRASES if _has_estimates(drive.solution(problem))}
        if found.keys() == listed_problems:
            yield f"On {_emphasized(drive)} it is {listed(list(found.values()))}."
        elif listed_problems := found.keys():
            values = [f"{value} {METHOD_PHRASES[problem]}" for problem, value in found.items()]
            yield (f"On {_emphasized(drive)} the median standard deviation of position is "
                   f"{listed(values)}.")


def _compared(drives):
    """Return the named drives that both odometry and SLAM estimate, with these two Solutions."""
    found = [(drive, drive.solution("problem1"),
              drive.solution("problem4") or drive.solution("problem3"))
             for drive in _in_abstract(drives)]
    return [each for each in found if all(map(_has_estimates, each[1:]))]


def _errors(drives):
    """Return a list of a sentence on the errors of odometry and SLAM, or of none without truth."""
    changes = [
        f"from {_ate(drive, by_odometry)} to {_ate(drive, by_slam)} on {_emphasized(drive)}"
        for drive, by_odometry, by_slam in _compared(drives) if drive.truth is not None]
    return ["SLAM in place of odometry changes the root mean square error of position "
            f"{listed(changes)}."] if changes else []


def _returns(drives):
    """Return a list of sentences on odometry and SLAM at returns, which need no truth."""
    texts = []
    for drive, *solutions in _compared(drives):
        found = consistency.returns(drive.dataset)
        if len(found.start):
            texts.append([f"{_rms_discrepancy(found, solution.poses)} on {_emphasized(drive)}"
                          for solution in solutions])
    if not texts:
        return []
    by_odometry, by_slam = (listed([*each]) for each in zip(*texts, strict=True))
    return ["Where the camera sees the same markers again, they measure how far the vehicle has "
            f"moved in between. Odometry differs from this by {by_odometry} (root mean square). "
            f"SLAM, which uses these sightings, agrees with them to {by_slam}."]


def _rms_discrepancy(found, poses):
    off = consistency.discrepancies(found, poses)[:, :2]
    return with_unit(np.sqrt(np.mean(np.sum(off**2, axis=1))), "m")


def _landmarks(drives):
    """Yield a sentence on the maps of the named drives, each of the last problem that has one."""
    maps = []
    for drive in _in_abstract(drives):
        counts = []
        for kind, name in (("aruco_map", "marker"), ("uwb_map", "antenna")):
            known = [landmarks for solution in drive.solutions
                     if (landmarks := getattr(solution, kind)) is not None]
            if known and (count := len(known[-1][0])):
                counts.append(f"{count} {name}{'s' * (count > 1)}")
        if counts:
            maps.append(f"{listed(counts)} on {_emphasized(drive)}")
    if maps:
        yield f"The maps hold {', '.join(maps)}."


def _ate(drive, solution, aligned=False):
    truth = truth_in_world(solution, drive.truth)
    return with_unit(evaluation.ate(solution.poses, truth, aligned), "m")


def _dataset_table(drives):
    rows = []
    for drive in drives:
        dataset = drive.dataset
        path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle)
        counts = ["none" if readings is None else f"{len(readings.pose):,}"
                  for readings in (dataset.aruco, dataset.uwb)]
        rows.append([plain(drive.name), f"{len(dataset.ticks):,}",
                     with_unit(evaluation.path_length(path), "m"), *counts,
                     drive.origin])
    header = ["dataset", "poses", "path", "sightings of markers", "UWB ranges", "origin"]
    return (f"## The datasets\n\n{table_text(header, rows, texts=1)}\n\n"
            "Table 3. Measurements of each drive; the path length is from odometry.")


def _doubts(drives):
    """Return by drive what could not be solved and what is doubted, in Markdown; "" if nothing."""
    parts = []
    for drive in drives:
        sentences = [f"The problem “{failure.title}” could not be solved: {failure.reason}."
                     for failure in drive.failures]
        sentences += [doubt.sentence for doubt in drive.doubts]
        if sentences:
            lines = "\n".join(f"- {plain(sentence)}" for sentence in sentences)
            parts.append(f"{plain(drive.name)}:\n\n{lines}")
    return "\n\n".join(["## Doubts about the data", *parts]) if parts else ""


def _notes(drives):
    """Return what was mended or left out when files were read, in Markdown; "" if nothing."""
    return "\n\n".join(
        f"Notes on the files of {_emphasized(drive)}: " + " ".join(map(plain, drive.notes))
        for drive in drives if drive.notes)


def _result_table(drives):
    problems = sorted(dict.fromkeys(
        told.problem for drive in drives for told in (*drive.solutions, *drive.failures)),
        key=order)
    known = any(drive.truth is not None for drive in drives)
    rows = [result_row(drive, problem, known) for drive in drives for problem in problems]
    errors = ["ATE", "ATE, aligned"] if known else []
    header = ["dataset", "problem", *errors, "σ of position", "σ of heading", "poses"]
    text = f"## Results\n\n{table_text(header, rows, texts=2)}" + (
        "\n\nTable 1. Every problem on every dataset: "
        + ("the root mean square error of all positions (ATE), as they stand and moved as a whole "
           "nearest to the truth (aligned); " if known else "")
        + "the medians over all estimated poses of the standard deviation σ that a method claims, "
        "of position (the larger of $x$ and $y$) and of heading; how many poses are estimated."
        + (dash_note(drives) if known else "")
        + (" *Hint*: as the assignment suggests, overconfident (chapter 2)."
           if "problem2_hint" in problems else ""))
    for sensor, name in SENSORS.items():
        if without := [plain(d.name) for d in drives if getattr(d.dataset, sensor) is None]:
            text += (f"\n\nThere are no {name} in {listed(without)}: the problems that need them "
                     "are left out there.")
    return text


def named(problem, dataset):
    """Return number and title of a problem on a dataset (str), as "3. SLAM: odometry + ArUco"."""
    number = re.match(r"problem(\d+)", problem)
    return (f"{number[1]}. " if number else "") + plain(title(problem, dataset))


def result_row(drive, problem, known=True):
    """Return a row of the table of results (list of str); `known`: it has columns of errors."""
    row = [plain(drive.name), named(problem, drive.dataset)]
    solution, errors = drive.solution(problem), ["–", "–"] * known
    if solution is None:
        needed = PROBLEMS[problem].sensors if problem in PROBLEMS else ()
        missing = [SENSORS[sensor] for sensor in needed if getattr(drive.dataset, sensor) is None]
        failed = any(failure.problem == problem for failure in drive.failures)
        return [*row, f"left out: no {' and no '.join(missing)}" if missing
                else "could not be solved" if failed else "no result", *errors, "–", "–"]
    if not _has_estimates(solution):
        return [*row, *errors, "–", "–", "0"]
    if known and drive.truth is not None:
        errors = [_ate(drive, solution), _ate(drive, solution, aligned=True)]
    position, heading = median_sigmas(solution)
    count = np.isfinite(solution.poses[:, 0]).sum()
    return [*row, *errors, with_unit(position, "m"), with_unit(heading, "rad"), f"{count:,}"]


def _file_table(drives, address):
    """Return the table of the files to hand in, by problem, with links; "" if there are none."""
    links, titles = defaultdict(list), {}
    for drive in drives:
        for path in map(PurePosixPath, drive.files):
            titles.setdefault(path.parent, named(path.parent.name, drive.dataset))
            links[path.parent, path.name].append(
                f"[{plain(drive.name)}]({quote(str(address / drive.name / path))})")
    if not links:
        return ""
    names = {name for _, name in links}
    names = [name for name in RESULT_FILES if name in names] + sorted(names - {*RESULT_FILES})
    rows = [[titles[folder], code(str(folder)),
             *(", ".join(links[folder, name]) or "–" for name in names)]
            for folder in sorted(titles, key=lambda path: (order(path.name), path))]
    text = table_text(["problem", "folder", *map(code, names)], rows, texts=2 + len(names))
    which = "" if PurePosixPath("problem2_hint") not in titles else (
        " Of problem 2, `problem2` is markers alone, `problem2_fused` the fusion with odometry, "
        "and `problem2_hint` the fusion by the assignment's hint, for comparison.")
    return (f"## Files to hand in\n\n{text}\n\nTable 2. The files to hand in, MATLAB files with "
            "struct arrays, and the datasets that have them. The path of a file is "
            f"`results/dataset/folder/file`.{which}")
