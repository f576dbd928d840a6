"""The zip to hand in: the report, the result files by the assignment's names, and a README.txt."""

import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from slamlib.io import files
from slamlib.io.results import RESULT_FILES, read_summary
from slamlib.report.build import Report
from slamlib.report.notebooks import Options, rendered
from slamlib.solve import PROBLEMS, SENSORS

CHAPTERS = ("[0-9A]*",)  # the problems, and the appendix on which they rely


def hand_in_options(options: Options) -> Options:
    """Return Options of a hand-in: CHAPTERS, unless report.toml names its own."""
    return replace(options, chapters=options.chapters or CHAPTERS)


def write_zip(path: Path, report: Report, results: Path, options: Options):
    """Write the zip of a Report to `path`; equal input gives equal bytes.

    `results` is the folder of its files. Raises DatasetError if the results of a drive have no
    summary.json: the run that wrote there did not end.
    """
    contents = {"report.pdf": report.files[-1].read_bytes()}
    for summary in report.summaries:
        folder = results / summary["dataset"]
        read_summary(folder)
        for problem in PROBLEMS:
            for file in RESULT_FILES:
                own = folder / problem / file
                if own.exists():
                    contents[f"{summary['dataset']}/{problem}/{file}"] = own.read_bytes()
    contents["README.txt"] = readme(report.summaries, options).encode()
    archive = BytesIO()
    with ZipFile(archive, "w") as file:
        for name, content in sorted(contents.items()):
            entry = ZipInfo(name)  # of 1980, which begins time in a zip: equal bytes on every day
            entry.external_attr = 0o644 << 16
            file.writestr(entry, content, ZIP_DEFLATED)
    files.write_file(path, archive.getvalue())


def readme(summaries: list[dict], options: Options) -> str:
    """Return README.txt of drives with these summaries."""
    text = rendered("readme.txt", cover=options, drives=summaries, problems=PROBLEMS,
                    sensors=SENSORS)
    return re.sub("\n{3,}", "\n\n", text.strip()) + "\n"
