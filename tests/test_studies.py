"""Kept Monte Carlo studies: recalled only if nothing changed, and equal to computed ones."""

import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from test_report import make_data, write

from slamlib import studies
from slamlib.report import build_report
from slamlib.studies import memory, montecarlo


def study(seeds=range(2), **options):
    return studies.run(montecarlo.problem2_trial, seeds, jobs=1, **options)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SLAMLIB_STUDIES", str(tmp_path / "studies"))
    return tmp_path / "studies"


def kept(folder):
    """Paths of the studies kept in a folder."""
    return sorted(folder.rglob("output.pkl"))


@pytest.fixture
def computed(monkeypatch):
    """The list of seeds that are computed, not recalled, by a trial in place of problem2_trial."""
    seeds = []

    def trial(seed, **options):
        seeds.append(seed)
        return {"of options": sum(options.values()), "not known": np.nan, "whole": seed,
                "nees": seed / 3}

    trial.__module__, trial.__name__ = montecarlo.__name__, "problem2_trial"
    monkeypatch.setattr(montecarlo, "problem2_trial", trial)
    return seeds


def test_a_recalled_study_equals_the_computed_one_exactly(folder, computed):
    first = study(slip=0.1)
    again = study(slip=0.1)
    assert computed == [0, 1] and list(first) == list(again)
    for name, values in first.items():
        assert values.dtype == again[name].dtype
        np.testing.assert_array_equal(values, again[name])


def test_no_study_is_kept_without_the_environment_variable(folder, computed, monkeypatch):
    study()
    monkeypatch.delenv("SLAMLIB_STUDIES")
    study(), study()
    assert computed == 3 * [0, 1] and len(kept(folder)) == 1


def test_studies_differ_by_trial_seeds_options_and_threads(folder, computed, monkeypatch):
    study(), study([1, 0]), study([0]), study(slip=0.0), study(slip=0.1), study(mislabelled=0.1)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    study()
    montecarlo.problem2_trial.__name__ = "another"
    study()
    assert len(computed) == 15 and len(kept(folder)) == 8


def test_a_trial_outside_slamlib_is_not_kept(folder):
    for _ in range(2):
        assert studies.run(lambda seed: {"seed": seed}, [3], jobs=1)["seed"] == [3]
    assert not folder.exists()


@pytest.mark.parametrize("damage", [
    lambda content: content[:-9], lambda content: b"", lambda content: b"\xff\x00 not this",
    lambda content: content[:60] + bytes([content[60] ^ 1]) + content[61:]])
def test_a_damaged_study_is_computed_again(folder, computed, damage):
    expected = study()
    file, = kept(folder)
    file.write_bytes(damage(file.read_bytes()))
    np.testing.assert_array_equal(study()["nees"], expected["nees"])
    assert computed == [0, 1, 0, 1]
    study()
    assert len(computed) == 4


def test_the_digest_of_the_code_changes_with_every_module_that_computes(tmp_path, monkeypatch):
    shutil.copytree(memory.SLAMLIB, tmp_path / "slamlib",
                    ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(memory, "SLAMLIB", tmp_path / "slamlib")
    assert memory.code_digest() == memory.CODE_DIGEST
    for module in sorted((tmp_path / "slamlib").rglob("*.py")):
        before = module.read_bytes()
        module.write_bytes(before + b"\n")
        shows = module.parent.name in ("notebook", "report") or module.name == "__main__.py"
        assert (memory.code_digest() == memory.CODE_DIGEST) == shows, module.name
        module.write_bytes(before)
    (tmp_path / "slamlib" / "slam" / "new.py").touch()
    assert memory.code_digest() != memory.CODE_DIGEST


@pytest.mark.parametrize("package", ["numpy", "scipy", "gtsam"])
def test_the_digest_of_the_code_changes_with_the_packages_that_compute(monkeypatch, package):
    installed = memory.version
    monkeypatch.setattr(memory, "version",
                        lambda name: "0" if name == package else installed(name))
    assert memory.code_digest() != memory.CODE_DIGEST


def test_montecarlo_imports_no_module_that_the_digest_leaves_out():
    program = "import sys, slamlib.studies.montecarlo; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], text=True, capture_output=True,
                            check=True)
    assert "slamlib.slam" in loaded.stdout.split()
    assert not re.search(r"slamlib\.(notebook|report|__main__)", loaded.stdout)


def test_no_study_is_kept_if_the_code_was_edited_meanwhile(folder, computed, monkeypatch):
    monkeypatch.setattr(memory, "code_digest", lambda: "edited")
    study()
    assert computed == [0, 1] and not folder.exists()


def test_only_studies_of_other_code_are_removed(folder, computed):
    study(), study(slip=0.1)
    folder.joinpath("0" * 64).mkdir()
    folder.joinpath("mine.txt").touch()
    study(slip=0.2)
    assert {path.name for path in folder.iterdir()} == {memory.CODE_DIGEST, "mine.txt"}
    assert len(kept(folder)) == 3


@pytest.mark.parametrize("kernel, told, shown", [
    (True, False, True), (True, True, False), (False, False, False)])
def test_a_study_shows_a_bar_in_a_kernel_of_jupyterlab_and_not_in_the_build(
        monkeypatch, tmp_path, capsys, computed, kernel, told, shown):
    monkeypatch.setattr(memory, "BAR_AFTER", 0.0)
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    if kernel:
        monkeypatch.setitem(sys.modules, "ipykernel", studies)
    if told:
        monkeypatch.setenv("SLAMLIB_RESULTS", str(tmp_path))
    study()
    assert ("problem2_trial" in capsys.readouterr().err) == shown


CELL = """from slamlib import studies
from slamlib.studies import montecarlo
for share in (0.0, 0.05):
    runs = studies.run(montecarlo.problem2_trial, range(2), methods=("ArUco",), mislabelled=share)
    print("nees", runs["ArUco nees"].tolist())"""


@pytest.mark.slow
def test_a_report_with_recalled_studies_equals_a_computed_one(tmp_path, capsys):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "a", "# a", (CELL,))
    first, moved = tmp_path / "first", tmp_path / "moved"

    def build(folder, **options):
        return [page.read_bytes() for page in build_report(
            tmp_path / "notebooks", tmp_path / "data", tmp_path / "report", tmp_path / "results",
            kept=folder, **options).files]

    def numbers(pages):
        return re.findall(r"nees (\[.*?\])", pages[1].decode())

    computed = build(first)
    assert len(set(numbers(computed))) == 2
    first.rename(moved)
    capsys.readouterr()
    assert build(moved) == computed and "nothing changed" in capsys.readouterr().err
    one, other = kept(moved / "studies")
    one.write_bytes(other.read_bytes())                # shows that it is recalled
    next(moved.glob("*.executed")).unlink()
    assert len(set(numbers(build(moved)))) == 1
    assert build(moved, fresh=True) == computed
