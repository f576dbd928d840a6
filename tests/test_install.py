"""What `pip install` gives: a wheel with the command `slamlib` and the notebooks."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from zipfile import ZipFile

import pytest
from test_report import write

from slamlib.report import notebooks as sources

CODE = """from slamlib import solve
from slamlib.notebook import plotting, solved, start
solved(start(), problem1=lambda drive: solve.find("problem1", drive.dataset))
plotting.panels(1);"""

ROOT = Path(__file__).parents[1]
NOTEBOOKS = ["1_chapter.ipynb", "A_appendix.ipynb"]


def run(*command, cwd, code=0):
    """What a program writes, as (stdout, stderr); slamlib is only where it is installed."""
    environment = {name: value for name, value in os.environ.items()
                   if name not in ("PYTHONPATH", "SLAMLIB_STUDIES")}
    templates = Path(sysconfig.get_path("data"), "share", "jupyter")          # nbconvert's
    environment |= {"SLAMLIB_SEEDS": "2", "JUPYTER_PATH": str(templates)}
    ended = subprocess.run([*map(str, command)], cwd=cwd, text=True, capture_output=True,
                           timeout=900, env=environment)
    assert ended.returncode == code, ended.stderr
    return ended.stdout, ended.stderr


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The `bin` of an environment with slamlib's wheel, which finds all else in that of the tests.

    The wheel, and the folder that it is built from: a copy, because building leaves files beside
    the sources. It has a chapter that uses what the wheel has besides modules, and an appendix.
    """
    folder = tmp_path_factory.mktemp("installed")
    tree, environment = folder / "tree", folder / "environment"
    tree.mkdir()
    shutil.copytree(ROOT / "slamlib", tree / "slamlib",
                    ignore=shutil.ignore_patterns("__pycache__"))
    for number, name in enumerate(NOTEBOOKS):
        write(tree / "notebooks", name.removesuffix(".ipynb"), f"# {name[0]}. Chapter\n\nText.",
              *[(CODE,), "Figure 1.1. Empty."] * (number == 0))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, tree)
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index",
        "--quiet", "--wheel-dir", folder, tree, cwd=folder)
    run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=folder)
    place, = environment.glob("lib/python*/site-packages")
    (place / "locked.pth").write_text(sysconfig.get_path("purelib") + "\n")
    wheel, = folder.glob("*.whl")
    run(sys.executable, "-m", "pip", "--python", environment / "bin" / "python", "install",
        "--no-deps", "--no-index", "--quiet", wheel, cwd=folder)
    return environment / "bin", wheel, tree


@pytest.mark.slow
def test_the_wheel_has_all_modules_all_files_beside_them_and_all_notebooks(installed):
    _, wheel, tree = installed
    names = ZipFile(wheel).namelist()
    expected = {file.relative_to(tree).as_posix() for file in (tree / "slamlib").rglob("*.*")}
    assert {name for name in names if name.startswith("slamlib/")} == expected
    assert {Path(name).name for name in names if "/share/slamlib/" in name} == set(NOTEBOOKS)


@pytest.mark.slow
def test_an_installed_slamlib_reports_on_a_drive(installed, tmp_path):
    """In a folder with nothing but `data`; the notebooks are the installed ones."""
    programs, _, _ = installed
    slamlib = programs / "slamlib"
    _, told = run(slamlib, "report", cwd=tmp_path, code=2)
    assert "data: expected this folder, with a sub-folder" in told and told.count("\n") == 1
    assert not any(tmp_path.iterdir())
    (tmp_path / "data" / "drive").mkdir(parents=True)
    (tmp_path / "data" / "drive" / "encoderReading.txt").write_text("1 0 0\n2 10 9\n")
    (tmp_path / "report.toml").write_text("appendix = false\n")
    run(slamlib, "report", cwd=tmp_path)
    assert (tmp_path / "report" / "report.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "results" / "drive" / "problem1" / "vehiclePose.mat").is_file()


def test_notebooks_are_those_of_the_folder_else_those_beside_the_sources(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sources.notebooks_folder() == ROOT / "notebooks"
    (tmp_path / "notebooks").mkdir()
    assert sources.notebooks_folder() == Path("notebooks")
