"""What an installation is made from, and where an installed slamlib finds its notebooks."""

import re
import tomllib
from pathlib import Path

import yaml

from slamlib.report import notebooks

ROOT = Path(__file__).parents[1]


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


def test_the_version_that_check_python_asks_for_is_the_one_that_is_pinned(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    import check_python
    assert check_python.installed() == check_python.GTSAM
    asked = (ROOT / "requirements.in").read_text()
    assert f"gtsam=={'.'.join(check_python.GTSAM)}." in asked


def test_notebooks_are_those_of_the_folder_else_those_beside_the_sources(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert notebooks.notebooks_folder() == ROOT / "notebooks"
    (tmp_path / "notebooks").mkdir()
    assert notebooks.notebooks_folder() == Path("notebooks")
