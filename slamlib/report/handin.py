"""The zip to hand in: the report, the result files by the assignment's names, and a README.txt."""

import platform
import re
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
from jinja2 import Template

from slamlib.io import files
from slamlib.io.dataset import all_notes
from slamlib.io.results import RESULT_FILES, read_summary
from slamlib.report.build import Report
from slamlib.report.notebooks import PROBLEM2_FOLDERS, Options
from slamlib.report.overview import SolvedDrive, listed, why_missing
from slamlib.solve import title

LINE_WIDTH = 100  # characters in a line of README.txt
README = Path(__file__).with_name("readme.txt")  # a template of Jinja
CHAPTERS = ("[0-9]*",)  # notebooks whose names begin with a number, so no appendix
PACKAGES = ("slamlib", "numpy", "scipy", "gtsam")  # whose versions README.txt names
MAP_ALONE = "problem2/ArucoMap.mat"  # the map by markers alone


def hand_in_options(options: Options) -> Options:
    """Return Options of a hand-in: without appendices, unless report.toml names its chapters."""
    return replace(options, chapters=options.chapters or CHAPTERS)


def write_zip(path: Path, report: Report, results: Path, options: Options):
    """Write the zip of a Report to `path`; equal input gives equal bytes.

    `results` is the folder of its files. Raises DatasetError if the results of a drive have no
    summary.json: the run that wrote there did not end.
    """
    contents = {"report.pdf": report.files[-1].read_bytes(),
                "README.txt": readme(report.drives, options, report.omitted).encode()}
    for drive in report.drives:
        folder = results / drive.name
        with files.locked(folder):                      # no other run replaces them meanwhile
            read_summary(folder)
            for name, file in handed_in(drive, options.problem2).items():
                contents[f"{drive.name}/{name}"] = (folder / file).read_bytes()
    archive = BytesIO()
    with ZipFile(archive, "w") as file:
        for name, content in sorted(contents.items()):
            entry = ZipInfo(name)  # of 1980, which begins time in a zip: equal bytes on every day
            entry.external_attr = 0o644 << 16
            file.writestr(entry, content, ZIP_DEFLATED)
    files.write_file(path, archive.getvalue())


def handed_in(drive: SolvedDrive, problem2: str) -> dict[str, str]:
    """Return the names in its results of the files of a drive, by their names in the hand-in.

    Those of `problem2`, a key of PROBLEM2_FOLDERS, have the map by markers alone if none is theirs.
    """
    files = {}
    for folder, problem in _folders(problem2).items():
        for name in RESULT_FILES:
            if f"{problem}/{name}" in drive.files:
                files[f"{folder}/{name}"] = f"{problem}/{name}"
    if "problem2/vehiclePose.mat" in files and MAP_ALONE in drive.files:
        files.setdefault(MAP_ALONE, MAP_ALONE)
    return files


def _folders(problem2):
    """Return the results folders that are handed in (dict of str), by their names there."""
    return {"problem1": "problem1", "problem2": PROBLEM2_FOLDERS[problem2],
            "problem3": "problem3", "problem4": "problem4"}


def readme(drives: list[SolvedDrive], options: Options, omitted: Sequence[str] = ()) -> str:
    """Return README.txt of some drives; `omitted` are the names of datasets that are left out."""
    versions = [f"Python {platform.python_version()}"]
    versions += [f"{name} {version(name)}" for name in PACKAGES]
    template = Template(README.read_text(encoding="utf-8"), trim_blocks=True)
    text = template.render(
        cover=options, estimate=PROBLEM2_FOLDERS[options.problem2], omitted=listed(omitted),
        width=LINE_WIDTH, drives=[_told(drive, options.problem2) for drive in drives],
        versions=", ".join(versions))
    return re.sub("\n{3,}", "\n\n", text.strip()) + "\n"


def _told(drive, problem2):
    """Return what README.txt tells of a SolvedDrive, a dict."""
    files = handed_in(drive, problem2)
    estimate = PROBLEM2_FOLDERS[problem2]
    world = {solution.problem: solution.world + 1 for solution in drive.solutions}
    told = {"name": drive.name, "doubts": drive.doubts, "world": world.get(estimate, 1),
            "notes": all_notes(drive.dataset, drive.truth), "folders": {}, "missing": []}
    if MAP_ALONE in files.values() and estimate != "problem2":
        told["map_frame"] = world.get("problem2", 1)
    for folder, problem in _folders(problem2).items():
        if f"{folder}/vehiclePose.mat" in files:
            names = [name.split("/")[1] for name in files if name.startswith(folder)]
            solution = drive.solution(problem)
            known = np.isfinite(solution.poses[:, 0]).sum()
            told["folders"][folder] = listed(names), solution.title, known, len(solution.poses)
        else:
            reason = why_missing(drive, problem)
            told["missing"].append(f"{folder} ({title(problem, drive.dataset)}): {reason}.")
    return told
