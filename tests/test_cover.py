"""report.toml, and what is said of one that is not as it must be."""

import pytest
from test_report import make_data, write

from slamlib.__main__ import main
from slamlib.dataset import DatasetError
from slamlib.report.cover import Cover, read_cover


def test_without_a_file_there_are_defaults(tmp_path):
    assert read_cover(tmp_path / "report.toml") == Cover()
    assert Cover().title and not Cover().author


def test_another_encoding_is_told(tmp_path):
    (tmp_path / "report.toml").write_bytes('author = "Löwe"'.encode("latin-1"))
    with pytest.raises(DatasetError, match="report.toml, line 1: expected UTF-8 text for author"):
        read_cover(tmp_path / "report.toml")


def test_lines_are_read_and_numbers_may_stand_without_quotes(tmp_path):
    path = tmp_path / "report.toml"
    path.write_text('# mine\nauthor = "Ada Löwe"\nstudent_number = 123456\n', encoding="utf-8")
    assert read_cover(path) == Cover(author="Ada Löwe", student_number="123456")


@pytest.mark.parametrize("text, place, expected", [
    ('author = "A"\nautor = "B"', ", line 2", "expected keys among title, author, student_number"),
    ("\nauthor = Ada", ", line 2", 'expected TOML such as \'author = "Ada Lovelace"\''),
    ("author = 1.5", ", line 1", "expected a line of text in quotes for author"),
    ('author = """a\nb"""', ", line 1", "expected a line of text in quotes for author"),
    ("[author]\nname = 1", ", line 1", "expected a line of text in quotes for author"),
])
def test_a_mistake_is_told_with_its_line_and_nothing_is_written(tmp_path, monkeypatch, capsys, text,
                                                                place, expected):
    (tmp_path / "report.toml").write_text(text)
    with pytest.raises(DatasetError):
        read_cover(tmp_path / "report.toml")
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
