"""The zip to hand in: the report, the result files by the assignment's names, and a README.txt."""

import platform
import re
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from jinja2 import Template

from slamlib.io import files
from slamlib.io.results import RESULT_FILES, read_summary
from slamlib.report.build import Report
from slamlib.report.notebooks import PROBLEM2_FOLDERS, Options
from slamlib.solve import PROBLEMS, SENSORS

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
    contents = {"report.pdf": report.files[-1].read_bytes()}
    drives = []
    for summary in report.summaries:
        name = summary["dataset"]
        folder = results / name
        with files.locked(folder):                      # no other run replaces them meanwhile
            read_summary(folder)
            handed = handed_in(files.file_names(folder), options.problem2)
            drives.append((summary, handed))
            for own, file in handed.items():
                contents[f"{name}/{own}"] = (folder / file).read_bytes()
    contents["README.txt"] = readme(drives, options).encode()
    archive = BytesIO()
    with ZipFile(archive, "w") as file:
        for name, content in sorted(contents.items()):
            entry = ZipInfo(name)  # of 1980, which begins time in a zip: equal bytes on every day
            entry.external_attr = 0o644 << 16
            file.writestr(entry, content, ZIP_DEFLATED)
    files.write_file(path, archive.getvalue())


def handed_in(names: Sequence[str], problem2: str) -> dict[str, str]:
    """Return which of the files `names` of results are handed in, by their names in the hand-in.

    Those of `problem2`, a key of PROBLEM2_FOLDERS, have the map by markers alone if none is theirs.
    """
    handed = {}
    for folder, problem in _folders(problem2).items():
        for name in RESULT_FILES:
            if f"{problem}/{name}" in names:
                handed[f"{folder}/{name}"] = f"{problem}/{name}"
    if "problem2/vehiclePose.mat" in handed and MAP_ALONE in names:
        handed.setdefault(MAP_ALONE, MAP_ALONE)
    return handed


def _folders(problem2):
    """Return the results folders that are handed in (dict of str), by their names there."""
    return {"problem1": "problem1", "problem2": PROBLEM2_FOLDERS[problem2],
            "problem3": "problem3", "problem4": "problem4"}


def readme(drives: Sequence[tuple[dict, dict]], options: Options) -> str:
    """Return README.txt of drives, each with its summary and what `handed_in` says of it."""
    versions = [f"Python {platform.python_version()}"]
    versions += [f"{name} {version(name)}" for name in PACKAGES]
    template = Template(README.read_text(encoding="utf-8"), trim_blocks=True)
    text = template.render(
        cover=options, estimate=PROBLEM2_FOLDERS[options.problem2], width=LINE_WIDTH,
        drives=[_told(*drive, options.problem2) for drive in drives],
        versions=", ".join(versions))
    return re.sub("\n{3,}", "\n\n", text.strip()) + "\n"


def _told(summary, handed, problem2):
    """Return what README.txt tells of a drive, a dict."""
    rows = summary["problems"]
    estimate = PROBLEM2_FOLDERS[problem2]
    world = {problem: row.get("world_is_pose") for problem, row in rows.items()}
    told = summary | {"world": world.get(estimate), "folders": {}, "missing": []}
    if MAP_ALONE in handed.values() and estimate != "problem2":
        told["map_frame"] = world.get("problem2")
    for folder, problem in _folders(problem2).items():
        if f"{folder}/vehiclePose.mat" in handed:
            names = [name.split("/")[1] for name in handed if name.startswith(folder)]
            told["folders"][folder] = ", ".join(names), rows[problem]
        else:
            needed = " and ".join(SENSORS[sensor] for sensor in PROBLEMS[problem].sensors)
            reason = f"left out: it needs {needed}"
            if problem in rows:
                reason = f"could not be solved: {rows[problem]['failed']}"
            told["missing"].append(f"{folder} ({PROBLEMS[problem].title}): {reason}.")
    return told
