"""Monte Carlo studies are recalled only where nothing changed, and equal those that are computed."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_report import make_data, write

from slamlib import montecarlo, studies
from slamlib.report import build_report

PACKAGE = Path(studies.__file__).parent


def study(seeds=range(2), **options):
    return montecarlo.run(montecarlo.markers_alone, seeds, jobs=1, **options)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SLAMLIB_STUDIES", str(tmp_path / "studies"))
    return tmp_path / "studies"


@pytest.fixture
def computed(monkeypatch):
    """A list of the seeds that were computed and not recalled."""
    seeds = []

    def trial(seed, **options):
        seeds.append(seed)
        return {"of options": sum(options.values()), "not known": np.nan, "whole": seed, "nees": seed / 3}

    trial.__module__, trial.__name__ = montecarlo.__name__, "markers_alone"
    monkeypatch.setattr(montecarlo, "markers_alone", trial)
    return seeds


def only(folder, pattern="*"):
    """The only file of this name in a folder."""
    file, = folder.glob(pattern)
    return file


def test_a_recalled_study_is_the_computed_one_to_the_last_bit(folder, computed):
    first = study(slip=0.1)
    again = study(slip=0.1)
    assert computed == [0, 1] and list(first) == list(again)
    for name, values in first.items():
        assert values.dtype == again[name].dtype
        np.testing.assert_array_equal(values, again[name])


def test_without_the_variable_nothing_is_kept(folder, computed, monkeypatch):
    study()
    monkeypatch.delenv("SLAMLIB_STUDIES")
    study(), study()
    assert computed == 3 * [0, 1] and len(list(folder.iterdir())) == 1


def test_trial_seeds_options_and_threads_are_told_apart(folder, computed, monkeypatch):
    study(), study([1, 0]), study([0]), study(slip=0.0), study(slip=0.1), study(mislabelled=0.1)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    study()
    montecarlo.markers_alone.__name__ = "another"
    study()
    assert len(computed) == 15 and len(list(folder.iterdir())) == 8


def test_a_trial_that_is_not_slamlib_s_is_not_kept(folder):
    for _ in range(2):
        assert montecarlo.run(lambda seed: {"seed": seed}, [3], jobs=1)["seed"] == [3]
    assert not folder.exists()


@pytest.mark.parametrize("damage", [
    lambda content: content[:-9], lambda content: b"", lambda content: b"\xff\x00 not this",
    lambda content: content.replace(b"nees", b"seen")])
def test_a_damaged_study_is_computed_again(folder, computed, damage):
    expected = study()
    file = only(folder)
    content = file.read_bytes()
    file.write_bytes(damage(content))
    assert file.read_bytes() != content
    np.testing.assert_array_equal(study()["nees"], expected["nees"])
    assert computed == [0, 1, 0, 1] and only(folder) == file
    study()
    assert len(computed) == 4


def test_code_changes_with_every_module_but_those_that_only_show(tmp_path, monkeypatch):
    for module in PACKAGE.glob("*.py"):
        shutil.copy(module, tmp_path)
    monkeypatch.setattr(studies, "__file__", str(tmp_path / "studies.py"))
    assert studies.code() == studies.CODE
    for module in sorted(tmp_path.iterdir()):
        before = module.read_bytes()
        module.write_bytes(before + b"\n")
        assert (studies.code() == studies.CODE) == (
            module.stem in studies.PRESENTATION + studies.SHOWING), module.name
        module.write_bytes(before)
    (tmp_path / "new.py").touch()
    assert studies.code() != studies.CODE


@pytest.mark.parametrize("package", ["numpy", "scipy", "gtsam"])
def test_code_changes_with_the_packages_that_compute(monkeypatch, package):
    installed = studies.version
    monkeypatch.setattr(studies, "version", lambda name: "0" if name == package else installed(name))
    assert studies.code() != studies.CODE


def test_what_cannot_change_a_study_is_not_imported_by_montecarlo():
    program = "import sys, slamlib.montecarlo; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], text=True, capture_output=True, check=True)
    assert "slamlib.slam" in loaded.stdout.split()
    for name in studies.PRESENTATION + studies.SHOWING:
        assert f"slamlib.{name}" not in loaded.stdout.split()


def test_nothing_is_kept_where_the_code_was_edited_meanwhile(folder, computed, monkeypatch):
    monkeypatch.setattr(studies, "code", lambda: "of another day")
    study()
    assert computed == [0, 1] and not folder.exists()


def test_studies_of_other_code_are_removed_and_nothing_else(folder, computed):
    study(), study(slip=0.1)
    folder.joinpath(f"{'0' * 64}.1.study").touch()
    folder.joinpath("mine.txt").touch()
    study(slip=0.2)
    assert sorted(file.name.split(".")[0] for file in folder.iterdir()) == sorted(
        3 * [studies.CODE] + ["mine"])


CELL = """from slamlib import montecarlo
for share in (0.0, 0.05):
    runs = montecarlo.run(montecarlo.markers_alone, range(2), mislabelled=share)
    print("nees", runs["nees"].tolist())"""


def test_a_report_is_the_same_with_recalled_studies_and_fresh_computes_them(tmp_path, capsys):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "a", "# a", (CELL,))
    kept, moved = tmp_path / "kept", tmp_path / "moved"

    def build(kept, **options):
        return [page.read_bytes() for page in build_report(
            tmp_path / "notebooks", tmp_path / "data", tmp_path / "report", tmp_path / "results",
            kept=kept, **options)]

    def numbers(pages):
        return re.findall(r"nees (\[.*?\])", pages[1].decode())

    computed = build(kept)
    assert len(set(numbers(computed))) == 2
    kept.rename(moved)
    capsys.readouterr()
    assert build(moved) == computed and "nothing changed" in capsys.readouterr().err
    only(moved, "*.executed").unlink()
    assert build(moved) == computed
    first, second = (moved / "studies").iterdir()
    first.write_bytes(second.read_bytes())                # that it was recalled can be seen now
    only(moved, "*.executed").unlink()
    assert len(set(numbers(build(moved)))) == 1
    assert build(moved, fresh=True) == computed
