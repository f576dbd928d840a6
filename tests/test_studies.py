"""Rows of studies and stand-ins: files that are read as they were written, and made again."""

import pandas as pd
import pytest
from conftest import ROOT, run_cells
from kills import contents
from numeric import short

from slamlib import studies
from slamlib.core.errors import DatasetError
from slamlib.studies import runs
from slamlib.studies.simulation import simulate, write_dataset

NOTEBOOKS = sorted((ROOT / "notebooks").glob("[1-4A]*.ipynb"))   # as `make studies` has them


def trial(seed, factor=1.0):
    return {"ate": factor * (seed + 1) / 3, "right": seed > 1}


def other_trial(seed, factor=1.0):
    return trial(seed, factor)


@pytest.fixture
def written(tmp_path, monkeypatch):
    """The file of a study of three seeds, beside which a notebook would run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SLAMLIB_STUDIES", "write")
    studies.rows("mine", trial, range(3), factor=2.0)
    monkeypatch.delenv("SLAMLIB_STUDIES")
    return tmp_path / "studies" / "mine.csv"


@pytest.mark.parametrize("name, options", [
    ("short", {"seed": 1}), ("long", {"seed": 2, "late_ranges": 0.05, "mislabelled": 0.005})])
def test_committed_stand_ins_are_regenerated_to_the_byte(name, options, tmp_path):
    committed = ROOT / "data" / name
    if not (committed / "truth").exists():
        pytest.skip(f"data/{name} has no truth: it has been replaced by a real log")
    write_dataset(tmp_path / name, *simulate(name, **options))
    assert contents(tmp_path / name) == contents(committed)


def test_a_study_has_a_row_for_each_seed_in_their_order():
    """By several processes, from three seeds on."""
    rows = studies.run(trial, [3, 1, 2], factor=6.0)
    assert rows.index.tolist() == [3, 1, 2] and rows["ate"].tolist() == [8.0, 4.0, 6.0]


def test_rows_are_read_as_they_were_written_without_computing(written):
    written.write_text(written.read_text().replace("1.333333", "7.5"))
    found = studies.rows("mine", trial, range(3), factor=2.0)
    assert found["ate"].tolist() == [0.6666667, 7.5, 2.0]
    assert found["right"].tolist() == [False, False, True]


@pytest.mark.parametrize("name, other, seeds, factor", [
    ("mine", other_trial, range(3), 2.0), ("mine", trial, range(4), 2.0),
    ("mine", trial, range(3), 2.5), ("absent", trial, range(3), 2.0)])
def test_rows_of_another_study_are_refused_in_a_sentence(written, name, other, seeds, factor):
    with pytest.raises(DatasetError, match=rf"{name}\.csv.*expected rows"):
        studies.rows(name, other, seeds, factor=factor)


@pytest.mark.parametrize("value, same", [("0.667", True), ("0.668", False)])
def test_the_first_seed_computed_again_confirms_the_rows(written, monkeypatch, value, same):
    written.write_text(written.read_text().replace("0.6666667", value))
    monkeypatch.setenv("SLAMLIB_STUDIES", "check")
    if same:
        studies.rows("mine", trial, range(3), factor=2.0)
    else:
        with pytest.raises(AssertionError, match=r"mine\.csv"):
            studies.rows("mine", trial, range(3), factor=2.0)


@pytest.mark.parametrize("package, counts", [
    ("core", True), ("robust", True), ("studies", True), ("io", False), ("notebook", False)])
def test_the_line_of_a_file_changes_with_the_code_that_computes(
        tmp_path, monkeypatch, package, counts):
    monkeypatch.setattr(runs, "SLAMLIB", tmp_path)
    before = runs.made_by()
    (tmp_path / package).mkdir()
    (tmp_path / package / "module.py").write_text("x = 1\n")
    assert (runs.made_by() != before) == counts


def checked(name, *arguments, rows=studies.rows, **options):
    """What `studies.rows` returns; what this code wrote of the long path is not computed again."""
    file = ROOT / "notebooks" / "studies" / f"{name}.csv"
    if options.get("path") == "long" and file.read_text().startswith(runs.made_by()):
        return pd.read_csv(file, comment="#", index_col="seed")
    return rows(name, *arguments, **options)


@pytest.mark.slow
@pytest.mark.usefixtures("look")
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_first_seed_of_every_study_is_what_its_file_says(notebook, tmp_path, monkeypatch):
    """After a change of the numerics that is meant, `make studies` writes the files anew.

    A seed of the long path takes 40 s.
    """
    write_dataset(tmp_path / "data" / "few", *short(1, 300))
    monkeypatch.setattr(studies, "rows", checked)
    monkeypatch.setenv("SLAMLIB_STUDIES", "check")
    run_cells(notebook, tmp_path, monkeypatch)
