"""Kept Monte Carlo studies: recalled only if nothing changed, and equal to computed ones."""

import os
import re
import shutil

import numpy as np
import pandas as pd
import pytest
from joblib import cpu_count
from test_report import make_data, write

from slamlib import studies
from slamlib.report import build_report
from slamlib.studies import montecarlo
from slamlib.studies import runs as memory


def study(seeds=range(2), **options):
    return studies.run(montecarlo.problem2_trial, seeds, **options)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SLAMLIB_STUDIES", str(tmp_path / "studies"))
    monkeypatch.setenv("SLAMLIB_RESULTS", str(tmp_path))              # one process, as in a build
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


@pytest.mark.parametrize("damage", [lambda content: content[:-9], lambda content: b""])
def test_a_study_is_recalled_exactly_and_computed_again_if_damaged(folder, computed, damage):
    first, again = study([3, 1], slip=0.1), study([3, 1], slip=0.1)
    assert computed == [3, 1] and list(first.index) == [3, 1]
    pd.testing.assert_frame_equal(first, again, check_exact=True)
    file, = kept(folder)
    file.write_bytes(damage(file.read_bytes()))
    for _ in range(2):
        pd.testing.assert_frame_equal(study([3, 1], slip=0.1), first, check_exact=True)
    assert computed == [3, 1, 3, 1]


def test_no_study_is_kept_without_the_environment_variable_or_of_a_trial_outside_slamlib(
        folder, computed, monkeypatch):
    for _ in range(2):
        assert list(studies.run(lambda seed: {"seed": seed}, [3])["seed"]) == [3]
    assert not folder.exists()
    monkeypatch.delenv("SLAMLIB_STUDIES")
    study(), study()
    assert computed == 2 * [0, 1]


def test_studies_differ_by_trial_seeds_options_and_code(folder, computed, monkeypatch):
    study(), study([1, 0]), study([0]), study(slip=0.0), study(slip=0.1), study(mislabelled=0.1)
    montecarlo.problem2_trial.__name__ = "another"
    study()
    monkeypatch.setattr(memory, "CODE_DIGEST", "other code")
    monkeypatch.setattr(memory, "code_digest", lambda: "other code")
    study()
    assert len(computed) == 15 and len(kept(folder)) == 8
    monkeypatch.setattr(memory, "KEPT", 3)
    study()
    assert len(computed) == 15 and len(kept(folder)) == 3


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
    installed = memory.version
    monkeypatch.setattr(memory, "version", lambda name: installed(name) + (name == "gtsam") * "1")
    assert memory.code_digest() != memory.CODE_DIGEST


def test_a_study_of_several_processes_equals_that_of_one(monkeypatch, tmp_path):
    """With a trial that no module has; in a build all run in the process of the notebook."""
    def trial(seed, factor):
        import os
        return {"seed": factor * seed, "process": os.getpid()}

    many = studies.run(trial, [3, 1, 2], factor=7)
    monkeypatch.setenv("SLAMLIB_RESULTS", str(tmp_path))
    one = studies.run(trial, [3, 1, 2], factor=7)
    assert one["seed"].tolist() == many["seed"].tolist() == [21, 7, 14]
    assert set(one["process"]) == {os.getpid()}
    assert (cpu_count() == 1) == (os.getpid() in set(many["process"]))


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
