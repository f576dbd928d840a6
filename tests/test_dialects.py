"""Tables as spreadsheets and MATLAB write them: the same numbers with a note, or one sentence."""

import numpy as np
import pytest
from scipy.io import savemat
from test_dataset import FILES, assert_same_but_notes, error_of, folder, write  # noqa: F401

from slamlib.dataset import DatasetError, read_dataset, read_truth
from slamlib.simulation import simulate, write_dataset
from slamlib.textfile import quoted

TABLES = ("encoderReading.txt", "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt")
SENSORS = TABLES[1:]


def rows(separator, decimal=".", end=""):
    return lambda text: "\n".join(
        line.replace(".", decimal).replace(" ", separator) + end for line in text.splitlines())


def quotes(text):
    return "\n".join(",".join(f'"{word}"' for word in line.split()) for line in text.splitlines())


def with_comments(text):
    return "# caf\u00e9 12\n\n \t\n" + "\n\n".join(
        f"{line} # 1 2, \u00b5m" for line in text.splitlines())


DECIMALS = "{} was read with decimal commas."
PLAIN = {  # what all files may have, as a function of their text
    "CRLF": lambda text: text.replace("\n", "\r\n"), "no last line end": str.rstrip,
    "lone CR": lambda text: text.replace("\n", "\r"),
    "tabs": lambda text: text.replace(" ", "\t"),
    "indented": lambda text: "  " + text.replace("\n", " \t \n   "),
    "UTF-8 comments": with_comments,
    "Latin-1 comments": lambda text: with_comments(text).encode("latin-1"),
    "byte-order mark": lambda text: text.encode("utf-8-sig")}
DIALECTS = {  # the dialect of a table as a function of the plain text; the note on each table
    "commas": (rows(","), None), "commas and blanks": (rows(" , "), None),
    "a comma at the end": (rows(",", end=","), None), "quotes": (quotes, None),
    "empty rows of a spreadsheet": (lambda text: rows(",")(text) + "\n,,,\n,,,\n", None),
    "semicolons": (rows(";"), None), "semicolons at the end": (rows(" ", end=" ;"), None),
    "semicolons, decimal commas": (rows(";", ","), DECIMALS),
    "tabs, decimal commas": (rows("\t", ","), DECIMALS),
    "blanks, decimal commas": (rows(" ", ","), DECIMALS),
    "comments of MATLAB": (lambda text: "% c, 1\n" + text.replace("\n", " % 1;2\n"), None),
    "comments of C": (lambda text: "// c, 1\n" + text.replace("\n", " // 1;2\n"), None),
    "header": (lambda text: "\n# c\n id  words\n" + text,
               "{}: the header 'id  words' was left out."),
    "header and commas": (lambda text: "id, no number\n" + rows(",")(text),
                          "{}: the header 'id, no number' was left out."),
    **{codec: (lambda text, codec=codec: text.encode(codec), None)
       for codec in ("UTF-16", "UTF-16-be", "UTF-16-le", "UTF-32", "UTF-32-le")},
    **{name: (function, None) for name, function in PLAIN.items()}}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_table_in_another_dialect_is_the_same_with_a_note(folder, dialect):  # noqa: F811
    clean, truth = read_dataset(folder), read_truth(folder)
    translated, note = DIALECTS[dialect]
    names = SENSORS if "decimal" in dialect else FILES if dialect in PLAIN else (
        *TABLES, "truth/vehiclePose.txt")
    for name in names:
        write(folder / name, translated(FILES[name]))
    found, true = read_dataset(folder), read_truth(folder)
    assert_same_but_notes(found, clean)
    assert_same_but_notes(true, truth)
    assert {note.format(name) for name in TABLES if name in names and note} <= set(found.notes)
    assert bool(found.notes) == (note is not None)
    assert bool(true.notes) == (note is not None and len(names) > 3)


ROW = "1;40;0;0;0;1;0;0;1;0;1"
IN_ORDER = "expected the columns in the order ("
FOUR = "expected 4 numbers (pose id, antenna id, range, sigma), "
REFUSED = [
    ("encoderReading.txt", "1 0 0\n2 990 1,020", 2, "left ticks, a whole number from -1e+15 to "
     "1e+15, found '1.02'"),
    *[("UwbReading.txt", text, line, FOUR + f"found '{text.split(chr(10))[line - 1]}'")
      for text, line in (("1,3,1,5,0,1", 1), ("1;3;1,5;0.1", 1), ("1,3,1.5,0.1\n2 3 1.6 0.1", 2),
                         ("1,3,1.5,0.1\n2,3 1.6,0.1", 2), ("1,3,1.5,0.1\n2,3 4,1.6,0.1", 2),
                         ("1;3;1.5;0.1\n2;3;1.6;0.1,2", 2), ("1a 3b 1.5c 0.1d\n1 3 1.5 0.1", 1))],
    ("encoderReading.txt", "pose;right;left\n1;0;0\n2;;12", 3, "right ticks, a whole number from "
     "-1e+15 to 1e+15, found 'nan'"),
    ("encoderReading.txt", "pose right left\nid ticks ticks\n1 0 0", 2, "found 'id ticks ticks'"),
    ("UwbAntennaGuess.txt", "900 1 2\n3 nan 5.5\n", 2, "x, a finite number from -1e+06 to 1e+06 m, "
     "found 'nan'"),
    ("UwbAntennaGuess.txt", "3 1 2 0.5\n900 1 2", 1, "expected 3 numbers (antenna id, x, y"),
    ("encoderReading.txt", "pose, left ticks, right ticks\n1, 0, 0", 1, IN_ORDER + "pose id, right "
     "ticks, left ticks), found the header 'pose, left ticks, right ticks'"),
    ("UwbReading.txt", "id_beacon id_pose\n1 3 1 1", 1, IN_ORDER),
    *[("encoderReading.txt", f"{header}\n1;0;0", 1, IN_ORDER)
      for header in ("pose;tick_sx;tick_dx", "pose,nL,nR", "ticksLeft;ticksRight")],
    *[("ArucoReading.txt", f"{header}\n" + ROW, 1, IN_ORDER)
      for header in ("marker pose x y theta", "id_aruco,id_pose,x,y,d", "LandmarkId;PoseId")]]


@pytest.mark.parametrize("name, text, line, said", REFUSED)
def test_what_has_two_readings_or_none_is_refused(folder, name, text, line, said):  # noqa: F811
    write(folder / name, text)
    message = error_of(read_dataset, folder)
    assert message.startswith(f"{folder / name}, line {line}: expected ") and said in message


def test_a_header_alone_is_a_table_without_rows(folder):  # noqa: F811
    write(folder / "UwbReading.txt", "pose id;antenna id;range;sigma\n;;;\n")
    dataset = read_dataset(folder)
    assert dataset.uwb is None and dataset.antenna_guess is not None


@pytest.mark.parametrize("header", [
    "pose_id,marker_id,x,y,theta,s_xx,s_xy,s_xtheta,s_yy,s_ytheta,s_thetatheta",
    "Pose Marker x y heading cov_xx cov_xy cov_xt cov_yy cov_yt cov_tt", "id tag", "k j dx dy",
    "id_pose;id_aruco;dx;dy", "pose_id marker_id pose_x pose_y", "n landmark l r"])
def test_headers_in_the_order_of_the_format_are_left_out(folder, header):  # noqa: F811
    clean = read_dataset(folder)
    write(folder / "ArucoReading.txt", header + "\n" + FILES["ArucoReading.txt"])
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert found.notes == (f"ArucoReading.txt: the header {quoted(header)} was left out.",)


@pytest.mark.parametrize("nan", ["nan", "NaN", "-nan"])
def test_rows_of_measurements_with_nan_or_without_reception_are_left_out(folder, nan):  # noqa: F811
    clean = read_dataset(folder)
    write(folder / "ArucoReading.txt", f"1 40 {nan} 0 0 1 0 0 1 0 1\n" + FILES["ArucoReading.txt"]
          + f"{nan} 40 0 0 0 1 0 0 1 0 1\n")
    write(folder / "UwbReading.txt", "# c\n" + rows(",")(FILES["UwbReading.txt"])
          + "\n1,3,,1\n1,3,0,0")
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert found.notes == (
        "ArucoReading.txt: 2 of 5 rows left out, the first in line 1: expected x, a number, found "
        "'nan'.", "UwbReading.txt: 1 of 4 rows left out, the first in line 4: expected range, a "
        "number, found 'nan'.", "UwbReading.txt: 1 of 3 rows left out, the first in line 5: "
        "expected a range, which 0 (no reception) is not, found '1 3 0 0'.")
    write(folder / "UwbReading.txt", f"1 3 {nan} 1\n2 3 0 0\n")
    assert read_dataset(folder).uwb is None


BAD_ROWS = {  # a row that cannot be, and what is said of it
    "ArucoReading.txt": [
        ("1 40 0 0 0 1 1 0 1 0 1", "a positive definite covariance"),
        ("2001 40 0 0 0 1 0 0 1 0 1", "pose id, a whole number from 1 to 2000"),
        ("1 40 0 inf 0 1 0 0 1 0 1", "y, a finite number from -10000 to 10000 m, found 'inf'"),
        ("1 4.5 0 0 0 1 0 0 1 0 1", "marker id, a whole number")],
    "UwbReading.txt": [
        ("1 5 -5.1 1", "a range that is not below -5 sigma"),
        ("1 5 1 0", "sigma, a finite number from 1e-09 to 10000 m, found '0'"),
        ("0 5 1 1", "pose id, a whole number from 1 to 2000")]}


@pytest.mark.parametrize("name, row, said", [
    (name, row, said) for name, bad in BAD_ROWS.items() for row, said in bad])
def test_a_bad_row_costs_a_row_up_to_a_tenth_of_the_file(tmp_path, name, row, said):
    write_dataset(tmp_path, simulate("short", 1)[0])
    clean, lines = read_dataset(tmp_path), (tmp_path / name).read_text().splitlines()
    most = len(lines) // 9                            # rows that are a tenth of the file
    lines[2:2] = [row, "# comment"]
    lines += [row] * (most - 1)
    write(tmp_path / name, "\n".join(lines))
    found = read_dataset(tmp_path)
    assert_same_but_notes(found, clean)
    note, = found.notes
    assert note.startswith(f"{name}: {most} of {len(lines) - 1} rows left out, the first in line 3:"
                           f" expected {said}")
    write(tmp_path / name, "\n".join(lines + [row] * 2))
    message = error_of(read_dataset, tmp_path)
    assert message.startswith(f"{tmp_path / name}, line 3: expected {said}")


def test_lines_are_counted_as_in_the_file_where_rows_were_left_out(folder):  # noqa: F811
    write(folder / "UwbReading.txt", "pose;antenna\n\n1;3;nan;1\n1;3;2,5;1\n9;3;1,5;1\n")
    assert "UwbReading.txt, line 5: expected pose id, a whole number from 1 to 4" in error_of(
        read_dataset, folder)


# Files of MATLAB.


def matrix(name):
    return np.array([line.split() for line in FILES[name].splitlines()], float)


def test_tables_in_one_mat_file(folder):  # noqa: F811
    clean = read_dataset(folder)
    for name in TABLES:
        (folder / name).unlink()
    values = {"ENCODERreading": matrix("encoderReading.txt").astype("int32"), "x": 1.0,
              **{name.removesuffix(".txt"): matrix(name) for name in SENSORS}}
    savemat(folder / "drive.mat", values)
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert "Variable ENCODERreading of drive.mat was read as encoderReading.txt." in found.notes
    savemat(folder / "other.mat", values)
    with pytest.raises(DatasetError, match="other.mat: expected one variable ENCODERreading, found "
                       "another in .*drive.mat, variable ENCODERreading$"):
        read_dataset(folder)


def test_rows_of_a_matrix_are_left_out_too(folder):  # noqa: F811
    clean = read_dataset(folder)
    table = np.vstack([matrix("UwbReading.txt"), [1, 3, np.nan, 1]])
    savemat(folder / "logs.mat", {"UwbReading": table}, do_compression=True)
    assert read_dataset(folder).notes == ("Not read: 'logs.mat'.",)
    (folder / "UwbReading.txt").unlink()
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert found.notes == (
        "Variable UwbReading of logs.mat was read as UwbReading.txt.",
        "logs.mat, variable UwbReading: 1 of 3 rows left out, the first in row 3: expected range, "
        "a number, found 'nan'.")


@pytest.mark.parametrize("value, said", [
    (np.array([[1, 3, 1.5, 0.1], [9, 3, 1.5, 0.1]]), ", row 2: expected pose id, a whole "
     "number from 1 to 4"),
    (np.ones((2, 3)), ": expected a matrix of real numbers with 4 columns (pose id, antenna id, "
     "range, sigma), found float64 of shape (2, 3)"),
    (np.array([[1, "a"]], dtype=object), ": expected a matrix of real numbers"),
    ("1 3 1 1", ": expected a matrix of real numbers")])
def test_faults_in_a_mat_file_are_named_by_variable_and_row(folder, value, said):  # noqa: F811
    (folder / "UwbReading.txt").unlink()
    savemat(folder / "logs.mat", {"UwbReading": value})
    message = error_of(read_dataset, folder)
    assert message.startswith(f"{folder / 'logs.mat'}, variable UwbReading{said}")


@pytest.mark.parametrize("content", [
    b"", b"nonsense", b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\0" * 99])
def test_a_mat_file_that_cannot_be_read_is_listed(folder, content):  # noqa: F811
    write(folder / "UwbReading.mat", content)
    (folder / "UwbReading.txt").unlink()
    assert read_dataset(folder).notes == ("Not read: 'UwbReading.mat'.",)
    (folder / "encoderReading.txt").unlink()
    assert error_of(read_dataset, folder).endswith("found none. Not read: 'UwbReading.mat'")
