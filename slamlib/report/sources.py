"""The notebooks that a report executes: those of the current folder, or of the installation."""

import shutil
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

from slamlib.dataset import DatasetError

FOLDER = "notebooks"  # name of the notebooks' folder


def notebooks_folder():
    """Path of the notebooks: `notebooks` in the current folder if it is there, else installed ones.

    Raises DatasetError where neither is there.
    """
    root = Path(__file__).parents[2]
    if Path(FOLDER).is_dir():
        return Path(FOLDER)
    if (root / "pyproject.toml").is_file():                # slamlib runs from its repository
        return root / FOLDER
    try:
        installed = [file.locate() for file in files("slamlib") or () if file.suffix == ".ipynb"]
    except PackageNotFoundError:
        installed = []
    if not installed:
        raise DatasetError(f"{FOLDER}: expected this folder, because slamlib was installed without "
                           "its notebooks; found none")
    return Path(installed[0]).resolve().parent


def copy_notebooks(source, folder):
    """Copy the notebooks in a folder (Path) to another one (Path), and return that.

    Raises DatasetError if it exists and is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DatasetError(f"{folder}: expected a new or empty folder to copy the notebooks to")
    folder.mkdir(parents=True, exist_ok=True)
    for file in sorted(source.glob("*.ipynb")):
        shutil.copyfile(file, folder / file.name)
    return folder
