"""The summary that opens the report: an abstract, all results, the files to hand in, a figure.

All numbers are computed from the result files and, where it is known, the truth.
"""

import re
from pathlib import PurePosixPath
from urllib.parse import quote

import numpy as np
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib import evaluation, odometry
from slamlib.checks import consistency
from slamlib.notebook import code, dash_note, listed, median_sigmas, plain, table_text, with_unit
from slamlib.report.animation import moving
from slamlib.report.chapters import HTML_ONLY
from slamlib.report.drives import order
from slamlib.report.pictures import trajectories
from slamlib.results import FILES
from slamlib.solve import PROBLEMS, SENSORS, title, truth_in_world

METHODS = {  # in the order of the problems; the hint is left to chapter 2
    "problem1": "by odometry (problem\u00a01)", "problem2": "by markers alone",
    "problem2_fused": "with odometry fused (problem\u00a02)",
    "problem3": "by SLAM on odometry and markers (problem\u00a03)",
    "problem4": "by SLAM with the UWB ranges (problem\u00a04)"}
FEW = 3  # drives, at most, that the abstract names one by one


def summary(drives, address="."):
    """Return the opening of the report, an executed NotebookNode, for a list of SolvedDrive.

    `address` (str) is the path of the results folder from that of the report; with None the table
    of the files to hand in is left out.
    """
    cells = [new_markdown_cell("# Overview\n\n" + abstract(drives), id="what")]
    solved = [drive for drive in drives if drive.solutions]
    if solved:
        cells.append(new_markdown_cell("## Results\n\n" + _result_table(drives), id="results"))
    if doubts := _doubts(drives):
        cells.append(new_markdown_cell(f"## Doubts about the data\n\n{doubts}", id="doubts"))
    if notes := _notes(drives):
        cells.append(new_markdown_cell(notes, id="notes"))
    if address is not None and any(drive.files for drive in drives):
        cells.append(new_markdown_cell(
            "## Files to hand in\n\n" + _file_table(drives, PurePosixPath(address)), id="files"))
    if solved:
        longest = max(solved, key=lambda drive: len(drive.dataset.ticks))
        cells += [
            *moving(longest),
            new_code_cell(outputs=[new_output("display_data", trajectories(longest))], id="picture",
                          metadata={"alt": f"The trajectories of {longest.name}, and the standard "
                                           "deviation of position along them"}),
            new_markdown_cell(
                f"Figure 1. *{plain(longest.name)}*, the longest drive. Left: its trajectory by "
                "odometry, by fusion and by the last problem"
                f"{', and the truth (dashed)' if longest.truth else ''}. Right: the standard "
                "deviation of position along the drive, for every problem, on a logarithmic axis"
                f"{'; problem 3 is the wide line' if longest.solution('problem3') else ''}.",
                id="caption")]
    cells.append(new_markdown_cell("## The datasets\n\n" + _dataset_table(drives), id="datasets",
                                   metadata={"tags": [HTML_ONLY]}))  # chapter 1 has this table
    return new_notebook(cells=cells)


def index(heading, opening, chapters):
    """Return the first page, a NotebookNode: the opening by `summary` with links to all the rest.

    `heading` (str) is the title of the report, `chapters` are dicts by `chapters.chapter_of`.
    """
    links = "\n\n".join(
        f"### [{chapter['title']}]({chapter['file']})\n\n"
        + re.sub(r"\]\(#", f"]({chapter['file']}#", chapter["lead"]) for chapter in chapters)
    first, *others = opening.cells
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
        *_sigmas(drives), *(list(_errors(drives)) or _returns(drives)), *_landmarks(drives)]
    simulated = [f"*{plain(drive.name)}*" for drive in drives if drive.simulated]
    return " ".join(sentences) + (f"\n\n{_said_of_simulated(simulated)}" if simulated else "")


def _what_was_done(sensors):
    """Return the first sentence of the abstract for a set of SENSORS."""
    data = ["wheel encoders", *["ArUco markers on the ceiling"] * ("aruco" in sensors),
            *["UWB ranges"] * ("uwb" in sensors)]
    ways = ["by odometry"] + ["by markers", "by a filter that fuses both"] * ("aruco" in sensors) \
        + ["by one factor graph in GTSAM"] * bool(sensors)
    return ("We estimate the trajectory of a differential-drive vehicle"
            + " and map its landmarks" * bool(sensors) + f" from {listed(data)}"
            + (f": {', '.join(ways[:-1])}, and {ways[-1]}." if len(ways) > 2
               else f", {listed(ways)}."))


def _said_of_simulated(names):
    are = "s {} are simulated stand-ins" if len(names) > 1 else " {} is a simulated stand-in"
    return (f"The dataset{are.format(listed(names))} for the course's logs, so the truth is known. "
            "With the course's logs in their place the errors are no longer known; everything else "
            "is computed in the same way.")


def _estimates(solution):
    """Return True if a Solution or None has an estimate of any pose."""
    return solution is not None and bool(np.isfinite(solution.poses[:, 0]).any())


def _named(drives):
    """Return the drives that the abstract names: all, or of many the shortest and the longest."""
    solved = [drive for drive in drives if any(map(_estimates, drive.solutions))]
    return solved if len(solved) <= FEW else [solved[0], solved[-1]]


def _sigmas(drives):
    """Yield a sentence on each drive, with the median sigma of position by every problem."""
    before = None
    for drive in _named(drives):
        found = {problem: with_unit(median_sigmas(drive.solution(problem))[0], "m")
                 for problem in METHODS if _estimates(drive.solution(problem))}
        if found.keys() == before:
            yield f"On *{plain(drive.name)}* it is {listed(list(found.values()))}."
        elif before := found.keys():
            yield (f"On *{plain(drive.name)}* the median standard deviation of position is "
                   + listed([f"{value} {METHODS[problem]}" for problem, value in found.items()])
                   + ".")


def _errors(drives):
    """Yield a sentence on the errors of odometry and of SLAM, where the truth is known."""
    falls = []
    for drive in _named(drives):
        ends = drive.solution("problem1"), drive.solution("problem4") or drive.solution("problem3")
        if drive.truth is not None and all(map(_estimates, ends)):
            first, last = (with_unit(_ate(drive, solution), "m") for solution in ends)
            falls.append(f"from {first} to {last} on *{plain(drive.name)}*")
    if falls:
        yield ("SLAM in place of odometry changes the root mean square error of position "
               f"{listed(falls)}.")


def _returns(drives):
    """Yield sentences on odometry and SLAM at returns, which need no truth."""
    by_odometry, by_slam = [], []
    for drive in _named(drives):
        ends = drive.solution("problem1"), drive.solution("problem4") or drive.solution("problem3")
        found = consistency.returns(drive.dataset)
        if len(found.start) and all(map(_estimates, ends)):
            for said, solution in zip((by_odometry, by_slam), ends):
                apart = with_unit(_apart(found, solution.poses), "m")
                said.append(f"{apart} on *{plain(drive.name)}*")
    if by_odometry:
        yield ("Where the camera sees the same markers again, they measure how far the vehicle has "
               f"moved in between. Odometry differs from this by {listed(by_odometry)} (root mean "
               f"square). SLAM, which uses these sightings, agrees with them to {listed(by_slam)}.")


def _apart(found, poses):
    off = consistency.discrepancies(found, poses)[:, :2]
    return np.sqrt(np.mean(np.sum(off**2, axis=1)))


def _landmarks(drives):
    """Yield a sentence on the maps of the named drives, each of the last problem that has one."""
    maps = []
    for drive in _named(drives):
        found = []
        for kind, name in (("aruco_map", "marker"), ("uwb_map", "antenna")):
            known = [getattr(solution, kind) for solution in drive.solutions
                     if getattr(solution, kind) is not None]
            if known and (count := len(known[-1][0])):
                found.append(f"{count} {name}{'s' * (count > 1)}")
        if found:
            maps.append(f"{listed(found)} on *{plain(drive.name)}*")
    if maps:
        yield f"The maps hold {', '.join(maps)}."


def _ate(drive, solution, aligned=False):
    return evaluation.ate(solution.poses, truth_in_world(solution, drive.truth), aligned)


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
    return (table_text(header, rows, texts=1)
            + "\n\nTable 3. Measurements of each drive; the path length is from odometry.")


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
    return "\n\n".join(parts)


def _notes(drives):
    """Return what was mended or left out when files were read, in Markdown; "" if nothing."""
    return "\n\n".join(
        f"Notes on the files of *{plain(drive.name)}*: " + " ".join(map(plain, drive.notes))
        for drive in drives if drive.notes)


def _result_table(drives):
    problems = sorted(dict.fromkeys(
        told.problem for drive in drives for told in (*drive.solutions, *drive.failures)),
        key=order)
    known = any(drive.truth is not None for drive in drives)
    rows = [result_row(drive, problem, known) for drive in drives for problem in problems]
    errors = ["ATE", "ATE, aligned"] if known else []
    header = ["dataset", "problem", *errors, "σ of position", "σ of heading", "poses"]
    text = table_text(header, rows, texts=2) + (
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
    solution, errors = drive.solution(problem), 2 * known
    if solution is None:
        needed = PROBLEMS[problem].sensors if problem in PROBLEMS else ()
        missing = [SENSORS[sensor] for sensor in needed if getattr(drive.dataset, sensor) is None]
        failed = any(failure.problem == problem for failure in drive.failures)
        return [*row, f"left out: no {' and no '.join(missing)}" if missing
                else "could not be solved" if failed else "no result", *["–"] * (errors + 2)]
    if not _estimates(solution):
        return [*row, *["–"] * (errors + 2), "0"]
    row += ["–"] * errors if drive.truth is None else [
        with_unit(_ate(drive, solution, aligned), "m") for aligned in (False, True)[:errors]]
    position, heading = median_sigmas(solution)
    count = np.isfinite(solution.poses[:, 0]).sum()
    return [*row, with_unit(position, "m"), with_unit(heading, "rad"), f"{count:,}"]


def _file_table(drives, address):
    """Return the table of the files to hand in, with links, by problem and dataset."""
    paths = [PurePosixPath(file) for drive in drives for file in drive.files]
    folders = sorted({path.parent for path in paths}, key=lambda path: (order(path.name), path))
    kinds = sorted({path.name for path in paths}, key=lambda name: (
        FILES.index(name) if name in FILES else len(FILES), name))
    rows = []
    for folder in folders:
        links = [", ".join(
            f"[{plain(drive.name)}]({quote(str(address / drive.name / folder / kind))})"
            for drive in drives if str(folder / kind) in drive.files) or "–" for kind in kinds]
        at = next(drive for drive in drives
                  if folder in (PurePosixPath(file).parent for file in drive.files))
        rows.append([named(folder.name, at.dataset), code(str(folder)), *links])
    text = table_text(["problem", "folder", *map(code, kinds)], rows,
                      texts=2 + len(kinds))
    which = "" if PurePosixPath("problem2_hint") not in folders else (
        " Of problem 2, `problem2` is markers alone, `problem2_fused` the fusion with odometry, "
        "and `problem2_hint` the fusion by the assignment's hint, for comparison.")
    return (f"{text}\n\nTable 2. The files to hand in, MATLAB files with struct arrays, and the "
            "datasets that have them. The path of a file is `results/dataset/folder/file`." + which)
