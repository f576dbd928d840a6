"""Other machines: what Windows and macOS lack, and the files that set up an environment there.

No test here runs on these systems. `tests/unlike/sitecustomize.py` takes from slamlib what they
lack.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from importlib import metadata
from pathlib import Path

import numpy as np
import psutil
import pytest
import yaml
from conftest import is_running
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from test_report import make_data, write

from slamlib import swap
from slamlib.dataset import read_dataset
from slamlib.results import read_vehicle_poses
from slamlib.simulation import simulate, write_dataset
from slamlib.summary import solve_to_folder

ROOT = Path(__file__).parents[1]
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc and /dev/shm of Linux")
NOTEBOOK = """from pathlib import Path
import os
import numpy as np
from ipykernel.connect import get_connection_info
from slamlib import studies
from slamlib.results import write_vehicle_poses
from slamlib.studies import montecarlo
folder = Path(os.environ["SLAMLIB_RESULTS"], os.environ["SLAMLIB_DATASETS"], "problem1")
write_vehicle_poses(folder, np.zeros((2, 3)), np.zeros((2, 3, 3)))
print(sorted(studies.run(montecarlo.problem2_trial, range(2))))
print("transport:", get_connection_info(unpack=True)["transport"])"""


def unlike(system, folder, *arguments, **options):
    """The command of a process (Popen) in a folder, where slamlib finds this system."""
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)], cwd=folder, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, encoding="cp1252", **options, env=os.environ | {
            "PYTHONPATH": os.pathsep.join([str(ROOT / "tests" / "unlike"), str(ROOT)]),
            "UNLIKE": system, "UNLIKE_IN": str(folder.resolve()), "PYTHONIOENCODING": "cp1252"})


@pytest.mark.slow
@on_linux
def test_solve_writes_the_same_where_windows_lacks_what_linux_has(tmp_path):
    """Twice, so that files are replaced; the console cannot show the drive's name."""
    dataset = simulate("short", seed=3)[0].first(60)
    write_dataset(tmp_path / "\u03c3", dataset)
    for _ in range(2):
        process = unlike("win32", tmp_path, "-m", "slamlib", "solve", "\u03c3", "--out", "out")
        told = process.communicate(timeout=300)
        assert process.returncode == 0 and "\\u03c3: encoders: 60 poses" in told[1], told
        assert "Traceback" not in told[1] and "Warning" not in told[1], told
        assert told[0].startswith("\\u03c3: 60 poses")
        assert [path.name for path in tmp_path.rglob(".*") if path.suffix != ".lock"] == [
            swap.FILE_LIST]                             # Windows removes locks when they are closed
    solve_to_folder(read_dataset(tmp_path / "\u03c3"), None, tmp_path / "here")
    poses = [read_vehicle_poses(tmp_path / out / "problem4")[0] for out in ("out", "here")]
    np.testing.assert_array_equal(*poses)


@pytest.mark.slow
@on_linux
def test_a_report_is_built_where_windows_lacks_what_unix_has(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_first", "# First", (NOTEBOOK,))
    process = unlike("win32", tmp_path, "-m", "slamlib", "report", "short")
    told = process.communicate(timeout=300)[1]
    assert process.returncode == 0, told
    assert re.search(r"^built in [\d.]+ s$", told, re.MULTILINE)
    assert "transport: tcp" in (tmp_path / "report" / "1_first.html").read_text(encoding="utf-8")
    assert (tmp_path / "results" / "short" / "problem1" / "vehiclePose.mat").is_file()
    assert {path.name for path in tmp_path.rglob(".slamlib*")} == {swap.FILE_LIST}


SLOW_STUDY = """import time
from slamlib import studies
def trial(seed):
    while time.process_time() < 1000:
        pass
studies.run(trial, range(2))"""
BUSY = 6.0                   # s of a kernel's processor time, by when its imports are done


def kernel_of(parent):
    """The psutil.Process of the kernel below a Popen, once it runs a study."""
    until = time.monotonic() + 300
    while parent.poll() is None and time.monotonic() < until:
        for each in psutil.Process(parent.pid).children(recursive=True):
            if "ipykernel_launcher" in command(each) and each.cpu_times().user > BUSY:
                return each
        time.sleep(0.05)
    parent.kill()
    raise AssertionError(parent.communicate())


def command(process):
    """Arguments (list of str) of a psutil.Process, none once it is gone or waits to be buried."""
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


def require_gone(processes):
    """No process is left, and nothing of any in shared memory, where names have its number.

    Older things are of other processes that had this number.
    """
    until = time.monotonic() + 300
    while left := [each for each in processes if is_running(each.pid)]:
        assert time.monotonic() < until, left
        time.sleep(0.05)
    numbers = {str(process.pid) for process in processes}
    begun = min(process.create_time() for process in processes)
    assert not [file.name for file in Path("/dev/shm").iterdir()
                if numbers & {*re.split(r"[-_]", file.name)} and file.stat().st_mtime > begun]


@pytest.mark.slow
@on_linux
@pytest.mark.parametrize("killed", ["build", "kernel"])
def test_a_report_that_is_killed_leaves_no_process_and_no_shared_memory(killed, tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_slow", "# Slow", (SLOW_STUDY,))
    build = subprocess.Popen(
        [sys.executable, "-m", "slamlib", "report", "short"], cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": str(ROOT)})
    kernel = kernel_of(build)
    below = psutil.Process(build.pid).children(recursive=True)
    os.kill(build.pid if killed == "build" else kernel.pid, signal.SIGKILL)
    told = build.communicate(timeout=300)[1]
    require_gone(below)
    if killed == "kernel":
        assert build.returncode == 1 and "1_slow.ipynb, cell 1:" in told


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


def test_the_lock_names_the_extras_that_its_packages_ask_for():
    """Else pip asks for the hash of the newest version, which the lock has for a while only."""
    lines = re.findall(r"^([\w.-]+)(?:\[(.*)\])?==", (ROOT / "requirements.txt").read_text(), re.M)
    locked = {canonicalize_name(name): {*filter(None, extras.split(","))} for name, extras in lines}
    installed = {canonicalize_name(each.name) for each in metadata.distributions()}
    asked = [(each.name, each.extras) for name in installed & locked.keys()
             for each in map(Requirement, metadata.requires(name) or ())
             if each.extras and (not each.marker or any(
                 each.marker.evaluate({"extra": extra}) for extra in ("", *locked[name])))]
    assert asked
    for name, extras in asked:
        assert extras <= locked[canonicalize_name(name)], name


def test_the_version_that_check_python_asks_for_is_the_one_that_is_pinned(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    import check_python
    assert check_python.installed() == check_python.GTSAM
    asked = (ROOT / "requirements.in").read_text()
    assert f"gtsam=={'.'.join(check_python.GTSAM)}." in asked


def targets_in(text):
    """Targets of make (set of str) in lines of a shell."""
    return set(re.findall(r"\bmake ([\w-]+)", text))


def test_container_and_ci_call_targets_that_there_are():
    rules = re.findall(r"^([a-z][\w -]*):(?!=)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    targets = {target for rule in rules for target in rule.split()}
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    assert targets_in(container["postCreateCommand"]) == {"setup"} <= targets
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    called = {name: targets_in(" ".join(step.get("run", "") for step in job["steps"]))
              for name, job in jobs.items()}
    assert called == {"test-and-report": {"report"}, "macos": {"quick", "report"}, "windows": set()}
    assert set.union(*called.values()) <= targets
    assert {name for name, job in jobs.items() if job.get("continue-on-error")} == {
        "macos", "windows"}
    used, = (step["with"]["environment-file"] for step in jobs["windows"]["steps"]
             if "environment-file" in step.get("with", {}))
    assert (ROOT / used).is_file()
