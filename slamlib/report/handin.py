"""The zip to hand in: the report, the result files by the assignment's names, and a README.txt."""

import platform
import re
import sys
from dataclasses import replace
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
from jinja2 import Template

from slamlib.io import swap
from slamlib.io.dataset import all_notes, read_dataset, read_truth
from slamlib.io.results import RESULT_FILES
from slamlib.io.tables import datasets_in
from slamlib.notebook import Drive
from slamlib.report.notebooks import PROBLEM2_FOLDERS
from slamlib.report.overview import listed, why_missing
from slamlib.solve import title

LINE_WIDTH = 100  # characters in a line of README.txt
README = Path(__file__).with_name("readme.txt")  # a template of Jinja
LEFT_OUT = ("Explore", "Files")  # titles of sections that are for screens, or on other folders


def selection(data, names=None):
    """Return the datasets of the hand-in, as of `build_report`, and the names of those left out.

    These are simulated, where no `names` are given and `data` (Path) has recorded ones, too.
    """
    if names is not None:
        return names, []
    origins = {name: Drive(name, read_dataset(data / name), read_truth(data / name)).origin
               for name in datasets_in(data)[0]}
    simulated = [name for name, origin in origins.items() if origin == "simulated"]
    if not simulated or len(simulated) == len(origins):
        return None, []
    print(f"hand-in: without {listed(simulated)}, which are simulated (name all datasets to "
          "hand in, if these are to be among them)", file=sys.stderr)
    return [name for name in origins if name not in simulated], simulated


def hand_in_options(options):
    """Return Options by which the hand-in leaves out the appendices, unless they are asked for."""
    return replace(options, appendix=bool(options.appendix),
                   leave_out=dict.fromkeys(LEFT_OUT, "") | options.leave_out)


def write_zip(path, report, results, options, omitted=()):
    """Write the zip of a Report to `path` (Path); equal input gives equal bytes.

    `results` (Path) is the folder of its files, `omitted` (list of str) what `selection` left out.
    """
    contents = {"report.pdf": report.files[-1].read_bytes(),
                "README.txt": readme(report.drives, options, omitted).encode()}
    with swap.staging(results):                         # no build replaces them meanwhile
        for drive in report.drives:
            contents |= {f"{drive.name}/{name}": Path(results, drive.name, file).read_bytes()
                         for name, file in handed_in(drive, options.problem2).items()}
    archive = BytesIO()
    with ZipFile(archive, "w") as file:
        for name, content in sorted(contents.items()):
            entry = ZipInfo(name)  # of 1980, which begins time in a zip: equal bytes on every day
            entry.external_attr = 0o644 << 16
            file.writestr(entry, content, ZIP_DEFLATED)
    swap.write_atomically(path, archive.getvalue())


def handed_in(drive, problem2):
    """Return the files of a SolvedDrive, a dict from names in the hand-in to names in its results.

    Those of `problem2`, a key of PROBLEM2_FOLDERS, have the map by markers alone if none is theirs.
    """
    estimate = PROBLEM2_FOLDERS[problem2]
    files = {f"{problem[:8]}/{name}": f"{problem}/{name}"
             for problem in ("problem1", estimate, "problem3", "problem4") for name in RESULT_FILES
             if f"{problem}/{name}" in drive.files}
    alone = "problem2/ArucoMap.mat"
    if "problem2/vehiclePose.mat" in files and alone in drive.files:
        files.setdefault(alone, alone)
    return files


def readme(drives, options, omitted=()):
    """Return README.txt (str); parameters as of `write_zip`, with a list of SolvedDrive."""
    text = Template(README.read_text(encoding="utf-8"), trim_blocks=True).render(
        cover=options, estimate=PROBLEM2_FOLDERS[options.problem2], omitted=listed(omitted),
        width=LINE_WIDTH, drives=[_told(drive, options.problem2) for drive in drives],
        versions=", ".join([f"Python {platform.python_version()}",
                            *(f"{name} {version(name)}"
                              for name in ("slamlib", "numpy", "scipy", "gtsam"))]))
    return re.sub("\n{3,}", "\n\n", text.strip()) + "\n"


def _told(drive, problem2):
    """Return what README.txt tells of a SolvedDrive, a dict."""
    files, estimate, folders = handed_in(drive, problem2), PROBLEM2_FOLDERS[problem2], {}
    for name, file in files.items():
        solution = drive.solution(file.split("/")[0])
        folders.setdefault(name.split("/")[0], (solution, []))[1].append(name.split("/")[1])
    world = {solution.problem: solution.world + 1 for solution in drive.solutions}
    return {
        "name": drive.name, "doubts": drive.doubts, "world": world.get(estimate, 1),
        "notes": all_notes(drive.dataset, drive.truth),
        "folders": {name: (listed(each), solution.title, np.isfinite(solution.poses[:, 0]).sum(),
                           len(solution.poses)) for name, (solution, each) in folders.items()},
        "map_frame": files.get("problem2/ArucoMap.mat") not in (None, f"{estimate}/ArucoMap.mat")
        and world.get("problem2", 1),
        "missing": [
            f"{problem[:8]} ({title(problem, drive.dataset)}): {why_missing(drive, problem)}."
            for problem in ("problem1", estimate, "problem3", "problem4")
            if f"{problem[:8]}/vehiclePose.mat" not in files]}
