"""report.toml, and what is said of one that is not as it must be."""

import re

import pytest
from conftest import ROOT
from test_report import make_data, write

from slamlib.__main__ import main
from slamlib.report.notebooks import Options, read_options

COURSE = "Robotic Perception and Action"


@pytest.mark.parametrize("text, expected", [
    ('author = "A"\nautor = "B"', "expected an entry such as author, "),
    ("\nauthor = Ada", "Invalid value (at line 2, column 10)"),
    ('author = """a\nb"""', "expected a line of UTF-8 text in quotes for author"),
    ("title = true", "expected a line of UTF-8 text in quotes for title, found 'True'"),
    ('\nproblem2 = "odometry"',
     'expected one of "aruco", "fused", "hint" for problem2, found \'odometry\''),
    ("appendix = 1", "expected one of true, false for appendix, found '1'"),
    ('leave_out = "B"', "numbers and titles in quotes, such as ["),
    ("leave_out = [3.5]", "for leave_out, found '[3.5]'"),
    ('author = "Löwe"'.encode("latin-1"), "expected a line of UTF-8 text")])
def test_a_mistake_is_told_and_nothing_is_written(tmp_path, monkeypatch, capsys, text, expected):
    (tmp_path / "report.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    monkeypatch.chdir(tmp_path)
    assert main(["report"]) == 2
    told = capsys.readouterr().err
    assert "report.toml: " in told and expected in told and told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["report.toml"]


@pytest.mark.parametrize("name, text, left_out, told", [
    *((name, "# 1. Text", [], f"data/{name}: expected letters from a to z, digits")
      for name in ("日本", "a*b", "<b>", "$x")),
    ("short", "# 1. Text", ["7"], "report.toml: expected to leave out "
     "a chapter (1) or a section, found '7'"),
    ("short", "# 1. Text\n\n## First", ["1.1", "1.2"], "report.toml: expected to leave out "
     "a chapter or a section (1.1 First), found '1.2'")])
def test_what_no_report_can_show_is_told_before_a_kernel_starts(
        tmp_path, monkeypatch, capsys, name, text, left_out, told):
    make_data(tmp_path)
    (tmp_path / "data" / "short").rename(tmp_path / "data" / name)
    write(tmp_path / "notebooks", "1_text", text, ("1 / 0",))
    (tmp_path / "report.toml").write_text(f"# mine\nleave_out = {left_out}\n")
    monkeypatch.chdir(tmp_path)
    assert main(["report"]) == 2
    assert f"{told}" in capsys.readouterr().err.splitlines()[-1]


def test_every_entry_is_read_with_the_place_of_what_is_left_out(tmp_path):
    path = tmp_path / "report.toml"
    assert read_options(path) == Options() and Options().title and not Options().author
    path.write_text('author = "Ada Löwe"\nstudent_number = 123456\ncode = "none"\n'
                    'appendix = false\n\nleave_out = ["B", "3.5"]\nproblem2 = "hint"\n', "utf-8")
    place = str(path)
    assert read_options(path) == Options(
        author="Ada Löwe", student_number="123456", leave_out={"B": place, "3.5": place},
        appendix=False, code="none", problem2="hint")


def test_the_committed_file_has_the_defaults_also_where_its_examples_are_read(tmp_path):
    text = (ROOT / "report.toml").read_text(encoding="utf-8")
    assert read_options(ROOT / "report.toml") == Options(course=COURSE)
    examples = re.sub(r"^# (?=\w+ = )", "", text, flags=re.MULTILINE)
    (tmp_path / "report.toml").write_text(examples)
    read = read_options(tmp_path / "report.toml")
    assert (read.code, read.problem2, read.title) == ("method", "aruco", Options().title)
    assert read.appendix is False and [*read.leave_out] == ["B", "3.5", "References"]
