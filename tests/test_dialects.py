"""Tables as spreadsheets and MATLAB write them: the same numbers with a note, or one sentence."""

import warnings

import numpy as np
import pytest
from scipy.io import savemat
from test_dataset import FILES, assert_same, error_of, folder, write  # noqa: F401

from slamlib.dataset import read_dataset, read_truth

# The same dataset; the note on each of the tables; the dialect as a function of the plain text.
TABLES = ("encoderReading.txt", "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt")


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def rows(separator, decimal=".", end=""):
    return lambda text: "\n".join(
        line.replace(".", decimal).replace(" ", separator) + end for line in text.splitlines())


def quotes(text):
    return "\n".join(",".join(f'"{word}"' for word in line.split()) for line in text.splitlines())


def headed(text):
    return "id, no number\n" + rows(",")(text)


DIALECTS = {
    "commas": (rows(","), "{} was read with columns separated by commas."),
    "commas and blanks": (rows(" , "), "{} was read with columns separated by commas."),
    "a comma at the end": (rows(",", end=","), "{} was read with columns separated by commas."),
    "semicolons": (rows(";"), "{} was read with columns separated by semicolons."),
    "semicolons at the end": (rows(" ", end=" ;"), None),
    "quotes": (quotes, "{} was read with columns separated by commas."),
    "comments of MATLAB": (lambda text: "% c, 1\n" + text.replace("\n", " % 1;2\n"), None),
    "comments of C": (lambda text: "// c, 1\n" + text.replace("\n", " // 1;2\n"), None),
    "header": (lambda text: "\n# c\n id  words\n" + text,
               "{}: the header 'id  words' was left out."),
    "header and commas": (headed, "{}: the header 'id, no number' was left out."),
    "UTF-16": (lambda text: text.encode("utf-16"), "{} was read as UTF-16 text."),
    "UTF-16 big": (lambda text: text.encode("utf-16-be"), "{} was read as UTF-16 text."),
    "UTF-16 little": (lambda text: text.encode("utf-16-le"), "{} was read as UTF-16 text."),
}


def assert_same_but_notes(dataset, clean):
    assert_same(type(clean)(**{**vars(dataset), "notes": ()}), clean)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_table_in_another_dialect_is_the_same_with_a_note(folder, dialect):  # noqa: F811
    clean, truth = read_dataset(folder), read_truth(folder)
    translated, note = DIALECTS[dialect]
    for name in (*TABLES, "truth/vehiclePose.txt"):
        write(folder / name, translated(FILES[name]))
    found, true = read_dataset(folder), read_truth(folder)
    assert_same_but_notes(found, clean)
    assert_same_but_notes(true, truth)
    for name in TABLES:
        assert note is None or note.format(name) in found.notes
    assert bool(found.notes) == bool(true.notes) == (note is not None)


@pytest.mark.parametrize("separator, said", [
    (";", "semicolons, with decimal commas"), ("\t", "blanks or tabs, with decimal commas"),
    (" ", "blanks or tabs, with decimal commas")])
def test_decimal_commas(folder, separator, said):  # noqa: F811
    clean = read_dataset(folder)
    for name in ("ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt"):
        write(folder / name, rows(separator, ",")(FILES[name]))
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert found.notes == tuple(f"{name} was read with columns separated by {said}." for name in (
        "ArucoReading.txt", "UwbAntennaGuess.txt", "UwbReading.txt"))


ROW = "1;40;0;0;0;1;0;0;1;0;1"
REFUSED = [
    ("UwbReading.txt", "1;3;1,500;12,250\n1;3;2,500;10,125", 1,
     "expected decimal points, found '1,500', which is 1.500 or 1500"),
    ("encoderReading.txt", "1 0 0\n2 1,000 1,000", 2,
     "expected decimal points, found '1,000', which is 1.000 or 1000"),
    ("UwbReading.txt", "1,3,1,5,0,1", 1, "expected 4 columns (pose id, antenna id, range, sigma), "
     "found 6"),
    ("UwbReading.txt", "1;3;1,5;0.1", 1, "expected finite numbers (below 1e+15 in size), "
     "found '1,5'"),
    ("UwbReading.txt", "1,3,1.5,0.1\n2 3 1.6 0.1", 2, "expected 4 columns (pose id, antenna id, "
     "range, sigma), found 1"),
    ("UwbReading.txt", "1,3,1.5,0.1\n2,3 1.6,0.1", 2, "expected 4 columns (pose id, antenna id, "
     "range, sigma), found 3"),
    ("UwbReading.txt", "1,3,1.5,0.1\n2,3 4,1.6,0.1", 2, "expected finite numbers (below 1e+15 in "
     "size), found '3 4'"),
    ("UwbReading.txt", "1;3;1,5;0,1\n2;3;1,6;0,1,2", 2, "found '0,1,2'"),
    ("encoderReading.txt", "pose;right;left\n1;0;0\n2;;12", 3, "found ''"),
    ("encoderReading.txt", "1 0 0\n2 nan 12", 2, "found 'nan'"),
    ("UwbAntennaGuess.txt", "3 1 nan", 1, "found 'nan'"),
    ("encoderReading.txt", "pose right left\nid ticks ticks\n1 0 0", 2, "found 'id'"),
    ("encoderReading.txt", "pose, left ticks, right ticks\n1, 0, 0", 1, "expected the columns in "
     "the order (pose id, right ticks, left ticks), found the header 'pose, left ticks, right "),
    ("ArucoReading.txt", "# c\nmarker pose x y theta\n" + ROW, 2, "expected the columns in"),
    ("UwbReading.txt", '"pose","antenna","sigma","range"\n1,3,1,1', 1, "expected the columns in"),
    ("ArucoReading.txt", "pose x y marker theta\n" + ROW, 1, "expected the columns in the order"),
    ("ArucoReading.txt", "p m x y theta s_yy s_xy\n" + ROW, 1, "expected the columns in the order"),
    *[("encoderReading.txt", f"{header}\n1;0;0", 1, "expected the columns in the order")
      for header in ("pose;tick_sx;tick_dx", "pose,nL,nR", "id L R", "k left_wheel right_wheel",
                     "k,encoder_l,encoder_r", "n conteggi sinistra destra", "Left Right pose",
                     "ticksLeft;ticksRight", "right left pose")],
    *[("ArucoReading.txt", f"{header}\n" + ROW, 1, "expected the columns in the order")
      for header in ("id_aruco,id_pose,x,y,d", "tag pose", "LandmarkId;PoseId", "aruco_id,pose_id",
                     "ArucoMarkerID PoseNumber x")],
    ("UwbReading.txt", "id_beacon id_pose\n1 3 1 1", 1, "expected the columns in the order"),
    ("UwbReading.txt", "hello", 1, "expected 4 columns"),
    ("UwbReading.txt", "1a 3b 1.5c 0,1d\n1 3 1.5 0.1", 1, "expected finite numbers"),
    ("UwbReading.txt", "; \n;", 1, "expected 4 columns"),
    ("UwbReading.txt", "hello you there now", 1, "expected finite numbers"),
    ("UwbAntennaGuess.txt", "3 1 2 0.5\n900 1 2", 1, "expected 3 columns"),
]


@pytest.mark.parametrize("name, text, line, said", REFUSED)
def test_what_has_two_readings_or_none_is_refused(folder, name, text, line, said):  # noqa: F811
    write(folder / name, text)
    message = error_of(read_dataset, folder)
    assert message.startswith(f"{folder / name}, line {line}: expected ") and said in message


def test_a_header_alone_is_a_table_without_rows(folder):  # noqa: F811
    write(folder / "UwbReading.txt", "pose id;antenna id;range;sigma\n")
    dataset = read_dataset(folder)
    assert dataset.uwb is None
    assert dataset.notes[-1] == "UwbReading.txt holds no rows."


@pytest.mark.parametrize("header", [
    "pose_id,marker_id,x,y,theta,s_xx,s_xy,s_xtheta,s_yy,s_ytheta,s_thetatheta",
    "Pose Marker x y heading cov_xx cov_xy cov_xt cov_yy cov_yt cov_tt", "id tag", "k j dx dy",
    "id_pose;id_aruco;dx;dy", "pose_id marker_id pose_x pose_y", "n landmark l r"])
def test_headers_in_the_order_of_the_format_are_left_out(folder, header):  # noqa: F811
    clean = read_dataset(folder)
    write(folder / "ArucoReading.txt", header + "\n" + FILES["ArucoReading.txt"])
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert found.notes == (f"ArucoReading.txt: the header {header[:60]!r} was left out.",)


@pytest.mark.parametrize("nan", ["nan", "NaN", "-nan", "nan(ind)", "-NAN(snan)"])
def test_rows_of_measurements_with_nan_are_left_out_and_counted(folder, nan):  # noqa: F811
    clean = read_dataset(folder)
    write(folder / "ArucoReading.txt", f"1 40 {nan} 0 0 1 0 0 1 0 1\n" + FILES["ArucoReading.txt"]
          + f"{nan} 40 0 0 0 1 0 0 1 0 1\n")
    write(folder / "UwbReading.txt", "# c\n" + rows(",")(FILES["UwbReading.txt"]) + "\n1,3,,1\n")
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert "ArucoReading.txt: 2 of 5 rows hold NaN and were left out, the first in line 1." \
        in found.notes
    assert "UwbReading.txt: 1 of 3 rows hold NaN and were left out, the first in line 4." \
        in found.notes


def test_lines_are_counted_as_in_the_file_where_rows_were_left_out(folder):  # noqa: F811
    write(folder / "UwbReading.txt", "pose;antenna\n\n1;3;nan;1\n1;3;2,5;1\n9;3;1,5;1\n")
    assert "UwbReading.txt, line 5: expected a pose id from 1 to 4" in error_of(
        read_dataset, folder)


def test_a_sensor_of_which_all_rows_hold_nan_is_none(folder):  # noqa: F811
    write(folder / "UwbReading.txt", "1 3 nan 1\n2 3 nan 1\n")
    dataset = read_dataset(folder)
    assert dataset.uwb is None and dataset.notes == (
        "UwbReading.txt: 2 of 2 rows hold NaN and were left out, the first in line 1.",
        "UwbReading.txt holds no rows.")


@pytest.mark.parametrize("separator, decimal", [(" ", "."), (",", "."), (";", ",")])
def test_guesses_with_a_height(folder, separator, decimal):  # noqa: F811
    clean = read_dataset(folder)
    write(folder / "UwbAntennaGuess.txt", rows(separator, decimal)("900 1.0 2 1.8\n3 -4 5.5 2.25"))
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert found.notes[-1] == ("UwbAntennaGuess.txt: the last of 4 columns was taken as z and left "
                               "out; positions and ranges are taken in the plane.")


@pytest.mark.parametrize("height", ["nan", "NaN", "-nan(ind)", "1.5"])
def test_a_height_may_be_nan_and_nothing_else(folder, height):  # noqa: F811
    clean = read_dataset(folder)
    for separator in (" ", ";"):
        text = rows(separator)(f"900 1.0 2 {height}\n3 -4 5.5 nan")
        write(folder / "UwbAntennaGuess.txt", text)
        found = read_dataset(folder)
        assert_same_but_notes(found, clean)
        assert found.notes[-1].startswith("UwbAntennaGuess.txt: the last of 4 columns was taken as")
    write(folder / "UwbAntennaGuess.txt", "900 1 2 1\n3 nan 5.5 1\n")
    assert "expected 3 columns" in error_of(read_dataset, folder)


def matrix(name):
    return np.array([line.split() for line in FILES[name].splitlines()], float)


def test_tables_in_one_mat_file(folder):  # noqa: F811
    clean = read_dataset(folder)
    for name in TABLES:
        (folder / name).unlink()
    savemat(folder / "drive.mat", {
        "ENCODERreading": matrix("encoderReading.txt").astype("int32"), "x": 1.0,
        **{name.removesuffix(".txt"): matrix(name) for name in TABLES[1:]}})
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert found.notes[0] == "Variable ENCODERreading of drive.mat was read as encoderReading.txt."
    assert "Not read: variables x of drive.mat." in found.notes


def test_a_table_in_a_mat_file_of_its_own(folder):  # noqa: F811
    clean = read_dataset(folder)
    (folder / "UwbReading.txt").unlink()
    table = np.vstack([matrix("UwbReading.txt"), [1, 3, np.nan, 1]])
    savemat(folder / "UwbReading.mat", {"ans": table}, do_compression=True)
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert found.notes == (
        "Variable ans of UwbReading.mat was read as UwbReading.txt.",
        "UwbReading.mat, variable ans: 1 of 3 rows hold NaN and were left out, the first in row 3.")


@pytest.mark.parametrize("value, said", [
    (np.array([[1, 3, 1.5, 0.1], [9, 3, 1.5, 0.1]]), ", row 2: expected a pose id from 1 to 4"),
    (np.ones((2, 3)), ", row 1: expected 4 columns (pose id, antenna id, range, sigma), found 3"),
    (np.array([[1, 3, 1e16, 0.1]]), ", row 1: expected finite numbers"),
    ({"pose": 1}, ": expected a matrix of real numbers, found a struct"),
    (np.array([[1, "a"]], dtype=object), ": expected a matrix of real numbers, found a cell array"),
    (np.ones((2, 4)) * 1j, ": expected a matrix of real numbers, found something else"),
    ("1 3 1 1", ": expected a matrix of real numbers, found something else")])
def test_faults_in_a_mat_file_are_named_by_variable_and_row(folder, value, said):  # noqa: F811
    (folder / "UwbReading.txt").unlink()
    savemat(folder / "logs.mat", {"UwbReading": value})
    message = error_of(read_dataset, folder)
    assert message.startswith(f"{folder / 'logs.mat'}, variable UwbReading{said}")


@pytest.mark.parametrize("content, said", [
    (b"", "that can be read"), (b"nonsense", "that can be read"),
    (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\0" * 99, "of version 7 or older")])
def test_a_mat_file_that_cannot_be_read(folder, content, said):  # noqa: F811
    write(folder / "logs.mat", content)
    assert read_dataset(folder).notes == ("Not read: logs.mat.",)
    (folder / "UwbReading.txt").unlink()
    note, = read_dataset(folder).notes
    assert note.startswith(f"logs.mat is not read: expected a .mat file {said}")
    (folder / "logs.mat").rename(folder / "UwbReading.mat")
    assert f"UwbReading.mat: expected a .mat file {said}" in error_of(read_dataset, folder)


def test_tables_in_one_struct(folder):  # noqa: F811
    clean = read_dataset(folder)
    for name in TABLES:
        (folder / name).unlink()
    savemat(folder / "drive.mat", {"logs": {
        "t": 1.0, **{name.removesuffix(".txt"): matrix(name) for name in TABLES}}})
    found = read_dataset(folder)
    assert_same_but_notes(found, clean)
    assert "Variable logs.UwbReading of drive.mat was read as UwbReading.txt." in found.notes
    assert "Not read: variables logs.t of drive.mat." in found.notes
    savemat(folder / "drive.mat", {
        name: {"encoderReading": matrix("encoderReading.txt")} for name in "ab"})
    assert error_of(read_dataset, folder).endswith(
        "drive.mat: expected one table encoderReading, found it in a.encoderReading and "
        "b.encoderReading")


@pytest.mark.parametrize("name, variables, listed", [
    ("ArucoReading.mat", ("a", "b"), "a, b"), ("aruco.mat", ("aruco",), "aruco"),
    ("logs.mat", ("ArucoReadings",), "ArucoReadings"), ("logs.mat", ("x", "markers"), "x, markers"),
    ("markers.mat", (), "none")])
def test_a_mat_file_without_the_table_that_its_names_are_near_to(
        folder, name, variables, listed):  # noqa: F811
    savemat(folder / name, {variable: matrix("ArucoReading.txt") for variable in variables})
    assert read_dataset(folder).notes == (f"Not read: {name}.",)
    (folder / "ArucoReading.txt").unlink()
    assert error_of(read_dataset, folder) == (
        f"{folder / name}: expected a matrix named ArucoReading, found the variables {listed}: "
        "rename one of them")


def test_a_struct_that_is_no_table(folder):  # noqa: F811
    (folder / "ArucoReading.txt").unlink()
    savemat(folder / "logs.mat", {"aruco": {"id": 1}})
    assert error_of(read_dataset, folder).endswith(
        "logs.mat: expected a matrix named ArucoReading, found the variables aruco, aruco.id: "
        "rename one of them")


def test_other_mat_files_are_named_with_their_variables(folder):  # noqa: F811
    (folder / "ArucoReading.txt").unlink()
    savemat(folder / "logs.mat", {"x": np.eye(3), "aruco_sigma": 0.1})
    note, = read_dataset(folder).notes
    assert note == "logs.mat is not read: it has the variables x, aruco_sigma."
    (folder / "encoderReading.txt").unlink()
    assert error_of(read_dataset, folder).endswith(
        "encoderReading.txt: expected this file, found none, but logs.mat, which has the variables "
        "x, aruco_sigma: name the matrix encoderReading")


@pytest.mark.parametrize("begin", ["# Created by Octave 8.4.0", "# name: x"])
def test_octaves_text_is_to_be_saved_as_matlabs_format(folder, begin):  # noqa: F811
    write(folder / "logs.mat", begin + "\n# type: scalar\n1\n")
    (folder / "UwbReading.txt").unlink()
    said = ("logs.mat is not read: expected a .mat file of version 7 or older, found Octave's "
            "text: save it with the option '-v7'")
    assert read_dataset(folder).notes == (said + ".",)
    (folder / "encoderReading.txt").unlink()
    assert error_of(read_dataset, folder).endswith("found none, but " + said)
    write(folder / "logs.mat", begin + "\n# type: scalar\n1\n# name: UwbReading\n")
    assert error_of(read_dataset, folder) == f"{folder}/{said.replace(' is not read', '')}"
    (folder / "logs.mat").rename(folder / "UwbReading.mat")
    assert error_of(read_dataset, folder) == f"{folder}/{said.replace('logs', 'UwbReading')}" \
        .replace(" is not read", "")
