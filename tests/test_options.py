"""report.toml, and what is said of one that is not as it must be."""

import re

import pytest
from conftest import ROOT
from test_report import make_data, write

from slamlib.__main__ import main
from slamlib.dataset import DatasetError
from slamlib.report.options import Cover, Options, read_options

COURSE = "Robotic Perception and Action"


def test_without_a_file_there_are_defaults(tmp_path):
    assert read_options(tmp_path / "report.toml") == Options()
    assert Cover().title and not Cover().author


def test_another_encoding_is_told(tmp_path):
    (tmp_path / "report.toml").write_bytes('author = "Löwe"'.encode("latin-1"))
    with pytest.raises(DatasetError, match="report.toml, line 1: expected UTF-8 text for author"):
        read_options(tmp_path / "report.toml")


def test_lines_are_read_and_numbers_may_stand_without_quotes(tmp_path):
    path = tmp_path / "report.toml"
    path.write_text('# mine\nauthor = "Ada Löwe"\nstudent_number = 123456\n', encoding="utf-8")
    assert read_options(path) == Options(Cover(author="Ada Löwe", student_number="123456"))


@pytest.mark.parametrize("text, place, expected", [
    ('author = "A"\nautor = "B"', ", line 2", "expected keys among title, author, student_number"),
    ("\nauthor = Ada", ", line 2", 'expected TOML such as \'author = "Ada Lovelace"\''),
    ("author = 1.5", ", line 1", "expected a line of text in quotes for author"),
    ('author = """a\nb"""', ", line 1", "expected a line of text in quotes for author"),
    ("title = true", ", line 1", "expected a line of text in quotes for title, found 'True'"),
    ('\nproblem2 = "odometry"', ", line 2",
     "expected one of 'aruco', 'fused', 'hint' for problem2, found 'odometry'"),
    ("problem2 = [1]", ", line 1", "expected one of 'aruco', 'fused', 'hint' for problem2"),
    ('code = "some"', ", line 1", "expected one of 'none', 'method', 'all' for code, found 'some'"),
    ('appendix = "no"', ", line 1", "expected true or false for appendix, found 'no'"),
    ('leave_out = "B"', ", line 1", "numbers and titles in quotes, such as ["),
    ("leave_out = [3.5]", ", line 1", "for leave_out, found '[3.5]'"),
    ("[author]\nname = 1", ", line 1", "expected a line of text in quotes for author"),
])
def test_a_mistake_is_told_with_its_line_and_nothing_is_written(tmp_path, monkeypatch, capsys, text,
                                                                place, expected):
    (tmp_path / "report.toml").write_text(text)
    with pytest.raises(DatasetError):
        read_options(tmp_path / "report.toml")
    monkeypatch.chdir(tmp_path)
    assert main(["report"]) == 2
    told = capsys.readouterr().err
    assert f"report.toml{place}: " in told and expected in told and told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["report.toml"]


def test_a_name_that_the_fonts_cannot_write_is_told(tmp_path, monkeypatch, capsys):
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "notebooks" / "1.ipynb").write_text("never read")
    monkeypatch.chdir(tmp_path)
    assert main(["report", "--author", "陳大文"]) == 2
    told = capsys.readouterr().err
    assert "no glyph for 大 in author '陳大文'" in told and told.count("\n") == 1


def test_a_dataset_s_name_that_the_fonts_cannot_write_is_told_before_a_kernel_starts(
        tmp_path, monkeypatch, capsys):
    make_data(tmp_path)
    (tmp_path / "data" / "short").rename(tmp_path / "data" / "日本")
    write(tmp_path / "notebooks", "1_text", "# 1. Text", ("1 / 0",))
    monkeypatch.chdir(tmp_path)
    assert main(["report"]) == 2
    told = capsys.readouterr().err
    assert "data/日本: the PDF's fonts have no glyph for 日 in the name of this dataset" in told
    assert told.count("\n") == 1


def test_what_the_report_shows_is_read_with_the_place_of_what_is_left_out(tmp_path):
    path = tmp_path / "report.toml"
    path.write_text('code = "none"\nappendix = false\n\nleave_out = ["B", "3.5"]\n'
                    'problem2 = "hint"\n')
    place = f"{path}, line 4"
    assert read_options(path) == Options(
        leave_out={"B": place, "3.5": place}, appendix=False, code="none", problem2="hint")


def test_the_committed_file_has_the_defaults_also_where_its_examples_are_read(tmp_path):
    text = (ROOT / "report.toml").read_text(encoding="utf-8")
    assert read_options(ROOT / "report.toml") == Options(Cover(course=COURSE))
    examples = re.sub(r"^# (?=\w+ = )", "", text, flags=re.MULTILINE)
    (tmp_path / "report.toml").write_text(examples)
    read = read_options(tmp_path / "report.toml")
    assert (read.code, read.problem2, read.cover.title) == ("method", "aruco", Cover().title)
    assert read.appendix is False and [*read.leave_out] == ["B", "3.5", "Explore"]


@pytest.mark.slow
def test_the_command_line_comes_before_the_file(tmp_path, monkeypatch):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text", "# 1. Text\n\n## First",
          ("print('told' * 2)",), "## Second")
    write(tmp_path / "notebooks", "A_more", "# A. More")
    (tmp_path / "report.toml").write_text(
        'code = "none"\nappendix = false\nleave_out = ["second"]\n')
    monkeypatch.chdir(tmp_path)
    assert main(["report", "short", "--jobs", "1"]) == 0
    page = (tmp_path / "report" / "1_text.html").read_text()
    assert ">First<" in page and "Second" not in page and "toldtold" not in page
    assert not (tmp_path / "report" / "A_more.html").exists()
    assert main(["report", "short", "--all-code", "--appendix"]) == 0
    assert "toldtold" in (tmp_path / "report" / "1_text.html").read_text()
    assert (tmp_path / "report" / "A_more.html").exists()


def test_an_unknown_section_is_told_with_its_line_before_a_kernel_starts(
        tmp_path, monkeypatch, capsys):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text", "# 1. Text\n\n## First", ("1 / 0",))
    (tmp_path / "report.toml").write_text('# mine\nleave_out = ["1.1", "1.2"]\n')
    monkeypatch.chdir(tmp_path)
    assert main(["report"]) == 2
    assert capsys.readouterr().err == (
        "slamlib: report.toml, line 2: expected to leave out a chapter (1) or a section "
        "(1.1 First), found '1.2'\n")
