"""What an installation is made from, and where an installed slamlib finds its notebooks."""

import re
import sys
import tomllib
from importlib.metadata import packages_distributions, requires
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from test_structure import MODULES, outside

from slamlib.report import notebooks

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
import check_python  # noqa: E402


def required(lines):
    """Requirements as {name: the rest of its line}, of lines as `numpy` or `gtsam==4.3.0`."""
    found = (re.fullmatch(r"([\w-]+)(.*)", line) for line in lines)
    return {each[1].lower().replace("_", "-"): each[2].strip() for each in found}


def test_the_environment_of_conda_has_what_the_lock_is_made_from():
    """What pip installs there has the lock's versions, and gtsam the first two numbers of its."""
    *conda, by_pip = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
    conda, by_pip = required(conda), required(by_pip["pip"])
    asked = required(line for line in (ROOT / "requirements.in").read_text().splitlines()
                     if not line.startswith("#"))
    assert conda.keys() | by_pip.keys() == asked.keys() | {"python", "pip"}
    assert not conda.keys() & by_pip.keys()
    assert {name: asked[name] for name in by_pip} == by_pip
    assert asked["gtsam"].startswith(f"=={conda['gtsam'].removesuffix('*')}")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert required(project["dependencies"]).keys() <= asked.keys()
    assert conda["python"] in [f"3.{minor}.*" for minor in range(11, 15)]


def test_what_slamlib_imports_is_a_dependency_or_comes_with_one():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = required(project["dependencies"])
    there = asked.keys() | required(line for each in asked for line in requires(each) or ()
                                    if "extra ==" not in line).keys()
    found = {name for module in MODULES for name in outside(module) - {"importlib"}}
    assert {packages_distributions()[name][0].lower().replace("_", "-") for name in found} <= there


def test_the_version_that_check_python_asks_for_is_the_one_that_is_pinned():
    assert check_python.installed() == check_python.GTSAM
    asked = (ROOT / "requirements.in").read_text()
    assert f"gtsam=={'.'.join(check_python.GTSAM)}." in asked


RIGHT = {"system": "Linux", "machine": "x86_64", "libc": "glibc", "version": (3, 12, 0)}


@pytest.mark.parametrize("wrong, gtsam, said", [
    ({}, None, None), ({"machine": "riscv64"}, None, "riscv64"), ({"libc": ""}, None, "glibc"),
    ({"version": (3, 10, 9)}, None, "Python 3.11 to 3.14"),
    ({"version": (3, 15, 0)}, None, "Python 3.11 to 3.14"),
    ({"system": "Windows"}, None, "environment.yml"), ({"system": "Windows"}, "4.3", None),
    ({"system": "Windows"}, "4.2", "WSL2"),
    ({"system": "Windows", "version": (3, 10, 9)}, "4.3", "WSL2")])
def test_wrong_python_or_platform_is_one_sentence(monkeypatch, wrong, gtsam, said):
    """Unless the gtsam of conda is there."""
    here = SimpleNamespace(**RIGHT | wrong)
    monkeypatch.setattr(check_python, "installed", lambda: gtsam and gtsam.split("."))
    monkeypatch.setattr(check_python, "sys", SimpleNamespace(
        version_info=here.version, executable="python"))
    monkeypatch.setattr(check_python, "platform", SimpleNamespace(
        system=lambda: here.system, machine=lambda: here.machine,
        libc_ver=lambda: (here.libc, ""), python_implementation=lambda: "CPython"))
    found = check_python.problem()
    assert found is None if said is None else said in found and "\n" not in found


def test_notebooks_are_those_of_the_folder_else_those_beside_the_sources(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert notebooks.notebooks_folder() == ROOT / "notebooks"
    (tmp_path / "notebooks").mkdir()
    assert notebooks.notebooks_folder() == Path("notebooks")
