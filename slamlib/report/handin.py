"""The zip to hand in: the report, the result files by the assignment's names, and a README.txt."""

import platform
import sys
import textwrap
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from slamlib import locks, swap
from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth
from slamlib.notebook import Drive, listed
from slamlib.report.build import BUILDING
from slamlib.report.options import ESTIMATES
from slamlib.results import FILES
from slamlib.solve import PROBLEMS, SENSORS, title

BEGINNING = (1980, 1, 1, 0, 0, 0)  # of time in a zip: equal input gives equal bytes
COLUMNS = 88  # of README.txt
LEFT_OUT = ("Explore", "Files")  # sections that are for screens, or on other folders
PACKAGES = ("slamlib", "numpy", "scipy", "gtsam")
WHICH = {
    "aruco": "The files in problem2 are the incremental localization from the ArUco measurements "
             "alone, because the assignment requires this one and calls the fusion with odometry "
             "facultative. Only poses with a measurement can have an estimate.",
    "fused": "The poses in problem2 are the facultative improvement, because report.toml asks for "
             "it: the localization from the ArUco measurements fused with odometry, in which "
             "errors that both share count once. It estimates every pose.",
    "hint": "The poses in problem2 are the facultative improvement by the assignment's hint, "
            "because report.toml asks for it: equation 2 continues from the fused covariance at "
            "every pose with an ArUco measurement. It estimates every pose."}
FORMAT = (
    "The .mat files are MATLAB files with the assignment's struct arrays. vehiclePose(i).pose is "
    "[x, y, heading] of pose i of encoderReading.txt, and vehiclePose(i).covari its 3x3 "
    "covariance. ArucoMap(k).pose and ArucoMap(k).covari are the same of a marker, and "
    "UwbMap(k).position and UwbMap(k).covariance are [x, y] and the 2x2 covariance of an antenna. "
    "The maps have one more field: ArucoMap(k).id and UwbMap(k).id are the number of the marker "
    "or antenna in the dataset, in ascending order.",
    "Lengths are in metres and headings in radians. Headings of the vehicle are continuous, and "
    "those of markers lie in (-pi, pi]. Covariances are of the same coordinates, in the axes of "
    "the world frame. Where a pose has no estimate, its entries are NaN.")


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


def leave_out(options):
    """Return what the report of the hand-in leaves out: a dict as of `sections.to_execute`."""
    return dict.fromkeys(LEFT_OUT, "") | options.leave_out


def write(path, report, results, options, omitted=()):
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
    with locks.locked(results.resolve() / BUILDING):
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
            entry = ZipInfo(name, BEGINNING)
            entry.compress_type, entry.external_attr = ZIP_DEFLATED, 0o644 << 16
            file.writestr(entry, content)
    swap.write_atomically(path, archive.getvalue())


def handed_in(drive, problem2):
    """Return the files of a SolvedDrive, a dict from names in the hand-in to names in its results.

    Those of `problem2`, one of ESTIMATES, are in the folder problem2. An estimate without a map of
    the markers has that of the markers alone.
    """
    estimate = ESTIMATES[problem2]
    files = {f"{problem[:8]}/{name}": f"{problem}/{name}"
             for problem in ("problem1", estimate, "problem3", "problem4") for name in FILES
             if f"{problem}/{name}" in drive.files}
    alone = "problem2/ArucoMap.mat"
    if "problem2/vehiclePose.mat" in files and alone in drive.files:
        files.setdefault(alone, alone)
    return files


def readme(drives, options, omitted=()):
    """Return README.txt (str); parameters as of `write`, with a list of SolvedDrive."""
    cover = options.cover
    named = " ".join(filter(None, [cover.author, cover.student_number]))
    parts = ["\n".join(filter(None, [cover.title, named, cover.course])), _heading("Files"),
             "report.pdf is the report. Each dataset has a folder, with a folder for each problem:",
             "\n".join(line for drive in drives for line in _file_lines(drive, options.problem2)),
             *FORMAT, "Where the report names a folder such as results/DATASET/problem1, it is the "
             f"folder DATASET/problem1 here. {ESTIMATES[options.problem2]} of the report is "
             "problem2 here, and its other folders of problem 2 are not handed in.",
             _heading("Problem 2"), WHICH[options.problem2]]
    worlds = {drive.name: drive.solution("problem2").world + 1 for drive in drives
              if handed_in(drive, options.problem2).get("problem2/ArucoMap.mat") not in (
                  None, f"{ESTIMATES[options.problem2]}/ArucoMap.mat")}
    if worlds:
        frames = listed([f"of pose {pose} in {name}" for name, pose in worlds.items()])
        parts.append("problem2/ArucoMap.mat is the map by the ArUco measurements alone, because "
                     f"the fusion has no map of its own. Its world frame is the frame {frames}.")
    parts += [_heading("World frame"), "The world frame is the frame of the vehicle at pose 1."]
    parts += [f"In {drive.name}/problem2 it is the frame of the vehicle at pose {pose}, the first "
              "that is estimated." for drive in drives
              if (pose := _world(drive, ESTIMATES[options.problem2])) > 1]
    for heading, sentences in (
            ("What is not here", [sentence for drive in drives
                                  for sentence in _missing(drive, options.problem2)]),
            ("Doubts about the data", [f"{drive.name}: {doubt.sentence}"
                                       for drive in drives for doubt in drive.doubts]),
            ("Notes on the files", [f"{drive.name}: {note}"
                                    for drive in drives for note in drive.notes])):
        if sentences:
            parts += [_heading(heading), *sentences]
    if omitted:
        parts += [_heading("Notes"), f"The simulated datasets {listed(omitted)} are left out."
                  if len(omitted) > 1 else f"The simulated dataset {omitted[0]} is left out."]
    parts += [_heading("Versions"), ", ".join(
        [f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in PACKAGES)])]
    return "\n\n".join(_wrapped(part) for part in parts) + "\n"


def _heading(text):
    return f"{text}\n{'-' * len(text)}"


def _wrapped(text):
    """Return a paragraph in lines of at most COLUMNS characters; other lines stay."""
    return text if "\n" in text or text.startswith(" ") else textwrap.fill(
        text, COLUMNS, break_long_words=False, break_on_hyphens=False)


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
    for problem in ("problem1", ESTIMATES[problem2], "problem3", "problem4"):
        if f"{problem[:8]}/vehiclePose.mat" not in files:
            lacks = [SENSORS[sensor] for sensor in PROBLEMS[problem].sensors
                     if getattr(drive.dataset, sensor) is None]
            reasons = [f"could not be solved: {failure.reason}." for failure in drive.failures
                       if failure.problem == problem]
            yield f"{drive.name}/{problem[:8]} ({title(problem, drive.dataset)}): " + (
                f"there are no {listed(lacks)} in this dataset." if lacks
                else [*reasons, "the report has no result of it."][0])
