"""The zip to hand in: the report, the result files by the assignment's names, and a README.txt."""

import platform
import re
import sys
import textwrap
from dataclasses import replace
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from jinja2 import Template

from slamlib import locks, swap
from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth
from slamlib.notebook import Drive, listed
from slamlib.report.build import BUILD_LOCK
from slamlib.report.options import PROBLEM2_FOLDERS
from slamlib.results import RESULT_FILES
from slamlib.solve import PROBLEMS, SENSORS, title

LINE_WIDTH = 88  # characters in a line of README.txt
README = Path(__file__).with_name("readme.txt")  # a template of Jinja
LEFT_OUT = ("Explore", "Files")  # titles of sections that are for screens, or on other folders
PACKAGES_TOLD = ("slamlib", "numpy", "scipy", "gtsam")  # with versions in README.txt


def selection(data, names=None):
    """Return the datasets of the hand-in, as of `build_report`, and the names of those left out.

    Where none is named, simulated datasets are left out if there are recorded ones in the folder
    `data` (Path), too. DatasetError if a dataset is malformed.
    """
    if names is not None:
        return names, []
    origins = {name: Drive(name, read_dataset(data / name), read_truth(data / name)).origin
               for name in dataset_names(data)}
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

    Parameters
    ----------
    report : Report, whose last file is the PDF.
    results : Path, the folder of the result files of this report.
    options : Options, of which `problem2` says which estimate is handed in as problem 2.
    omitted : list of str, names of simulated datasets that are left out.

    Raises
    ------
    DatasetError : another run began to replace the result files, and did not end well.
    """
    contents = {"report.pdf": report.files[-1].read_bytes(),
                "README.txt": readme(report.drives, options, omitted).encode()}
    for drive in report.drives:
        if drive.name.casefold() in {name.casefold() for name in contents}:
            raise DatasetError(f"{drive.name}: the zip has a file of the name of this dataset: "
                               "rename its folder")
    with locks.locked(results.resolve() / BUILD_LOCK):
        for drive in report.drives:
            try:
                swap.require_finished(results / drive.name)
            except swap.UnfinishedError as error:
                raise DatasetError(str(error)) from None
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

    Those of `problem2`, a key of PROBLEM2_FOLDERS, are in the folder problem2. An estimate without
    a map of the markers has that of the markers alone.
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
    cover, estimate = options.cover, PROBLEM2_FOLDERS[options.problem2]
    named = " ".join(filter(None, [cover.author, cover.student_number]))
    frames = [f"of pose {_world(drive, 'problem2')} in {drive.name}" for drive in drives
              if handed_in(drive, options.problem2).get("problem2/ArucoMap.mat") not in (
                  None, f"{estimate}/ArucoMap.mat")]
    sections = {
        "What is not here": [sentence for drive in drives
                             for sentence in _missing(drive, options.problem2)],
        "Doubts about the data": [f"{drive.name}: {doubt.sentence}"
                                  for drive in drives for doubt in drive.doubts],
        "Notes on the files": [f"{drive.name}: {note}"
                               for drive in drives for note in drive.notes],
        "Notes": [f"The simulated dataset{'s' * (len(omitted) > 1)} {listed(omitted)} "
                  f"{'are' if len(omitted) > 1 else 'is'} left out."] if omitted else []}
    template = Template(README.read_text(encoding="utf-8"), trim_blocks=True)
    text = template.render(
        title_lines=filter(None, [cover.title, named, cover.course]), estimate=estimate,
        file_lines=[line for drive in drives for line in _file_lines(drive, options.problem2)],
        frames=frames and listed(frames), sections=sections,
        worlds={drive.name: _world(drive, estimate) for drive in drives},
        versions=", ".join([f"Python {platform.python_version()}",
                            *(f"{name} {version(name)}" for name in PACKAGES_TOLD)]))
    lines, *paragraphs = re.split("\n{2,}", text.strip())
    return "\n\n".join([lines, *map(_wrapped, paragraphs)]) + "\n"


def _wrapped(paragraph):
    """Return a paragraph in lines of at most LINE_WIDTH characters; headings and lists stay."""
    return paragraph if paragraph.startswith(" ") or paragraph.endswith("--") else textwrap.fill(
        paragraph, LINE_WIDTH, break_long_words=False, break_on_hyphens=False)


def _file_lines(drive, problem2):
    """Yield a line for each folder of a SolvedDrive: its files, problem and number of poses."""
    folders = {}
    for name, file in handed_in(drive, problem2).items():
        folders.setdefault(name.split("/")[0], []).append(file)
    for folder, files in folders.items():
        solution = drive.solution(files[0].split("/")[0])
        count = int((solution.poses[:, 0] == solution.poses[:, 0]).sum())
        yield (f"  {drive.name}/{folder}: {listed([file.split('/')[1] for file in files])}\n"
               f"    {solution.title}; {count} of {len(solution.poses)} poses have an estimate")


def _world(drive, problem):
    """Return the number, from 1, of the pose whose frame is the world frame of a problem."""
    solution = drive.solution(problem)
    return solution.world + 1 if solution else 1


def _missing(drive, problem2):
    """Yield a sentence on each problem that has no files."""
    files = handed_in(drive, problem2)
    for problem in ("problem1", PROBLEM2_FOLDERS[problem2], "problem3", "problem4"):
        if f"{problem[:8]}/vehiclePose.mat" not in files:
            lacks = [SENSORS[sensor] for sensor in PROBLEMS[problem].sensors
                     if getattr(drive.dataset, sensor) is None]
            reasons = [f"could not be solved: {failure.reason}." for failure in drive.failures
                       if failure.problem == problem]
            yield f"{drive.name}/{problem[:8]} ({title(problem, drive.dataset)}): " + (
                f"there are no {listed(lacks)} in this dataset." if lacks
                else [*reasons, "the report has no result of it."][0])
