"""Files as they come: the same numbers with a note, named as not read, or refused."""

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import test_dataset
from scipy.io import savemat
from test_dataset import FILES, assert_same, error_of, write

from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import dataset_from_arrays, inventory_lines, read_dataset, read_truth
from slamlib.io.tables import LIMITS, datasets_in
from slamlib.studies.simulation import simulate, write_dataset

folder = test_dataset.folder
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


PLAIN = {  # what all files may have, as a function of their text
    "CRLF": lambda text: text.replace("\n", "\r\n"), "no last line end": str.rstrip,
    "lone CR": lambda text: text.replace("\n", "\r"),
    "tabs": lambda text: text.replace(" ", "\t"),
    "indented": lambda text: "  " + text.replace("\n", " \t \n   "),
    "UTF-8 comments": with_comments,
    "Latin-1 comments": lambda text: with_comments(text).encode("latin-1"),
    "byte-order mark": lambda text: text.encode("utf-8-sig")}
DIALECTS = {  # those of a table
    "commas": rows(","), "commas and blanks": rows(" , "), "a comma at the end": rows(",", end=","),
    "quotes": quotes, "semicolons": rows(";"), "semicolons at the end": rows(" ", end=" ;"),
    "empty rows of a spreadsheet": lambda text: rows(",")(text) + "\n,,,\n,,,\n",
    "semicolons, decimal commas": rows(";", ","), "tabs, decimal commas": rows("\t", ","),
    "blanks, decimal commas": rows(" ", ","),
    "comments of MATLAB": lambda text: "% c, 1\n" + text.replace("\n", " % 1;2\n"),
    "comments of C": lambda text: "// c, 1\n" + text.replace("\n", " // 1;2\n"),
    "header": lambda text: "\n# c\n id  words\n" + text,
    "header and commas": lambda text: "id  words\n" + rows(",")(text),
    **{codec: lambda text, codec=codec: text.encode(codec)
       for codec in ("UTF-16", "UTF-16-be", "UTF-16-le", "UTF-32", "UTF-32-le")}, **PLAIN}
NOTES = {"decimal": " was read with decimal commas.",
         "header": ": the header 'id  words' was left out; columns were read as "}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_table_in_another_dialect_is_the_same_with_a_note(folder, dialect):
    clean, truth = read_dataset(folder), read_truth(folder)
    names = SENSORS if "decimal" in dialect else FILES if dialect in PLAIN else (
        *TABLES, "truth/vehiclePose.txt")
    for name in names:
        write(folder / name, DIALECTS[dialect](FILES[name]))
    noted = [f"{name}{note}" + f"{', '.join(LIMITS[Path(name).name])}." * (word == "header")
             for word, note in NOTES.items() if word in dialect for name in names]
    assert_same(read_dataset(folder), clean, *(note for note in noted if "truth/" not in note))
    assert_same(read_truth(folder), truth, *(
        note.replace("truth/", "In truth: ") for note in noted if "truth/" in note))


def test_of_a_header_alone_there_is_no_row(folder):
    clean, columns = read_dataset(folder), ", ".join(LIMITS["UwbReading.txt"])
    write(folder / "UwbReading.txt", "id_pose;id_beacon;r\n;;;\n")
    assert_same(read_dataset(folder), clean.without("uwb"), "UwbReading.txt: the header "
                f"'id_pose;id_beacon;r' was left out; columns were read as {columns}.")


@pytest.mark.parametrize("nan", ["nan", "NaN", "-nan"])
def test_rows_of_measurements_with_nan_or_without_reception_are_left_out(folder, nan):
    clean = read_dataset(folder)
    write(folder / "ArucoReading.txt", f"1 40 {nan} 0 0 1 0 0 1 0 1\n" + FILES["ArucoReading.txt"]
          + f"{nan} 40 0 0 0 1 0 0 1 0 1\n")
    write(folder / "UwbReading.txt", "# c\n" + rows(",")(FILES["UwbReading.txt"])
          + "\n1,3,,1\n1,3,0,0")
    assert_same(
        read_dataset(folder), clean, "ArucoReading.txt: 2 of 5 rows left out, the first in line 1: "
        "expected x, a number, found 'nan'.", "UwbReading.txt: 2 of 4 rows left out, the first in "
        "line 4: expected range, a number (0 is no reception), found 'nan'.")
    write(folder / "UwbReading.txt", f"1 3 {nan} 1\n2 3 0 0\n")
    assert read_dataset(folder).uwb is None


POSE, ID = "pose id, a whole number from 1 to 300", "a whole number from -1e+15 to 1e+15"
BAD_ROWS = {  # rows that cannot be, by what is said of them
    "ArucoReading.txt": {
        "a positive definite covariance": [f"1 40 0 0 0 {covariance}" for covariance in (
            "1 1 0 1 0 1", "1e-4 2e-4 0 1e-4 0 1e4", "1 .9 -.9 1 .9 1", "1 9e14 0 1 0 1e-18")],
        POSE: ["301 40 0 0 0 1 0 0 1 0 1"],
        "y, a finite number from -10000 to 10000 m, found 'inf'": ["1 40 0 inf 0 1 0 0 1 0 1"],
        f"marker id, {ID}": ["1 4.5 0 0 0 1 0 0 1 0 1"]},
    "UwbReading.txt": {
        "a range that is not below -5 sigma": ["1 5 -5.1 1"], POSE: ["301 5 1 1"],
        "sigma, a finite number from 1e-09 to 10000 m, found '0'": ["1 5 1 0"],
        f"antenna id, {ID}": ["1 3.5 1 1"]}}


@pytest.mark.parametrize("name, said, row", [
    (name, said, row) for name, told in BAD_ROWS.items() for said, rows in told.items()
    for row in rows])
def test_a_bad_row_costs_a_row_up_to_a_tenth_of_the_file(tmp_path, name, said, row):
    write_dataset(tmp_path, simulate("short", 1)[0].first(300))
    clean, lines = read_dataset(tmp_path), (tmp_path / name).read_text().splitlines()
    most = len(lines) // 9                            # rows that are a tenth of the file
    lines[2:2] = [row, "# comment"]
    lines += [row] * (most - 1)
    write(tmp_path / name, "\n".join(lines))
    note, = (found := read_dataset(tmp_path)).notes
    assert_same(found, clean, note)
    assert note.startswith(f"{name}: {most} of {len(lines) - 1} rows left out, the first in line 3:"
                           f" expected {said}")
    write(tmp_path / name, "\n".join(lines + [row] * 2))
    assert error_of(read_dataset, tmp_path).startswith(
        f"{tmp_path / name}, line 3: expected {said}")


def test_bad_rows_of_all_kinds_together_are_a_tenth_at_most(tmp_path):
    write_dataset(tmp_path, simulate("short", 1)[0].first(300))
    lines, bad = (tmp_path / "UwbReading.txt").read_text().splitlines(), ["1 5 -9 1", "999 5 1 1"]
    each = len(lines) // 18 + 1
    write(tmp_path / "UwbReading.txt", "\n".join(lines + [row for row in bad for _ in range(each)]))
    assert "a range that is not below -5 sigma" in error_of(read_dataset, tmp_path)


# Ranges need guesses, and other problems need none.


def test_ranges_of_antennas_without_a_guess_are_left_out_and_named(folder):
    clean = read_dataset(folder)
    write(folder / "UwbReading.txt", "1 7 1 1\n" + FILES["UwbReading.txt"] + "2 -5 9 1\n3 7 2 1\n")
    assert_same(
        read_dataset(folder), clean, "UwbReading.txt: 3 of 5 rows left out, the first in line 1: "
        "expected an antenna id of UwbAntennaGuess.txt, which lacks -5, 7, found '7'.")
    write(folder / "UwbReading.txt", "\n".join(f"1 {k} 1 1" for k in range(50, 42, -1)))
    assert_same(
        read_dataset(folder), clean.without("uwb"), "UwbReading.txt: 8 of 8 rows left out, the "
        "first in line 1: expected an antenna id of UwbAntennaGuess.txt, which lacks 43, 44, 45, "
        "46, 47 and 3 more, found '50'.")
    arrays = dataset_from_arrays(ARRAYS["ticks"], uwb=[[1, 3, 1, 1], [1, 4, 1, 1]],
                                 guess=[[3, 0, 0]])
    assert arrays.uwb.antenna.tolist() == [3]
    assert arrays.notes == ("uwb: 1 of 2 rows left out, the first in row 2: expected an antenna id "
                            "of guess, which lacks 4, found '4'.",)


@pytest.mark.parametrize("content, lack", [(None, "is missing"), ("# none\n", "has no rows")])
def test_without_guesses_problem_4_is_left_out_with_a_note(folder, content, lack):
    clean = dataclasses.replace(read_dataset(folder), uwb=None, antenna_guess=None)
    (folder / "UwbAntennaGuess.txt").unlink()
    if content is not None:
        write(folder / "UwbAntennaGuess.txt", content)
    found = read_dataset(folder)
    assert_same(found, clean, f"UwbAntennaGuess.txt {lack}: problem 4 is left out.")
    assert "drive: ranges: none, no UwbReading.txt with usable rows" in inventory_lines(found, None)
    write(folder / "UwbReading.txt", "1 3 nan 1\n# none\n")
    assert "problem 4" not in str(read_dataset(folder).notes)
    assert dataset_from_arrays(ARRAYS["ticks"], uwb=ARRAYS["uwb"]).notes == (
        "guess has no rows: problem 4 is left out.",)


@pytest.mark.parametrize("text", [
    "900 1 2 2.5\n3 -4 5.5 nan\n", "900,1,2,\n3,-4,5.5,0\n", "900;1;2;-1,5\n3;-4;5,5;3\n"])
def test_heights_of_antennas_are_left_out_with_a_note(folder, text):
    clean = read_dataset(folder)
    write(folder / "UwbAntennaGuess.txt", text)
    notes = ["UwbAntennaGuess.txt: the last of 4 columns was taken as z and left out."]
    if "1,5" in text:
        notes.append("UwbAntennaGuess.txt was read with decimal commas.")
    assert_same(read_dataset(folder), clean, *notes)


# Files of MATLAB.


def matrix(name):
    return np.array([line.split() for line in FILES[name].splitlines()], float)


def test_tables_in_one_mat_file_where_the_text_is_missing(folder):
    clean = read_dataset(folder)
    values = {"ENCODERreading": matrix("encoderReading.txt").astype("int32"), "x": 1.0,
              **{name.removesuffix(".txt"): matrix(name) for name in SENSORS}}
    values["UwbReading"] = np.vstack([values["UwbReading"], [1, 3, np.nan, 1]])
    for name in ("drive.mat", "other.mat"):
        savemat(folder / name, values, do_compression=True)
    assert read_dataset(folder).notes == ("Not read: 'drive.mat', 'other.mat'.",)
    for name in TABLES:
        (folder / name).unlink()
    assert_same(
        read_dataset(folder), clean,
        *(f"Variable {variable} of drive.mat was read as {name}." for variable, name in zip(
            ["ENCODERreading", *(name.removesuffix(".txt") for name in SENSORS)], TABLES)),
        "Not read: 'other.mat'.",
        "drive.mat, variable UwbReading: 1 of 3 rows left out, the first in row 3: expected range, "
        "a number (0 is no reception), found 'nan'.")


def test_faults_in_a_mat_file_are_named_by_variable_and_row(folder):
    (folder / "UwbReading.txt").unlink()
    savemat(folder / "logs.mat", {"UwbReading": [[1, 3, 1.5, 0.1], [9, 3, 1.5, 0.1]]})
    assert error_of(read_dataset, folder).startswith(
        f"{folder / 'logs.mat'}, variable UwbReading, row 2: expected pose id, a whole number from "
        "1 to 4")


@pytest.mark.parametrize("content", [
    None, b"", b"nonsense", b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\0" * 99])
def test_a_mat_file_that_cannot_be_read_is_listed(folder, content):
    path = folder / "UwbReading.mat"
    os.mkfifo(path) if content is None else write(path, content)
    (folder / "UwbReading.txt").unlink()
    assert read_dataset(folder).notes == ("Not read: 'UwbReading.mat'.",)
    (folder / "encoderReading.txt").unlink()
    assert error_of(read_dataset, folder).endswith("found none. Not read: 'UwbReading.mat'")


# Arrays in place of files.

ARRAYS = {"ticks": matrix("encoderReading.txt")[:, 1:], **{
    argument: matrix(name) for argument, name in zip(("aruco", "uwb", "guess"), SENSORS)}}


def test_arrays_are_the_dataset_of_their_files(folder):
    expected = read_dataset(folder)
    options = {"vehicle": expected.vehicle, "name": "drive"}
    for given in (ARRAYS, {name: value.tolist() for name, value in ARRAYS.items()}):
        assert_same(dataset_from_arrays(**given, **options), expected)
    alone = dataset_from_arrays(ARRAYS["ticks"])
    assert (alone.aruco, alone.uwb, alone.antenna_guess) == (None, None, None)
    gaps = {"aruco": [[1, 4, np.nan, *ARRAYS["aruco"][0, 3:]], *ARRAYS["aruco"]],
            "uwb": [*ARRAYS["uwb"], [1, 3, 0, 1]]}
    assert_same(
        dataset_from_arrays(**ARRAYS | gaps, **options), expected,
        "aruco: 1 of 4 rows left out, the first in row 1: expected x, a number, found 'nan'.",
        "uwb: 1 of 3 rows left out, the first in row 3: expected range, a number (0 is no "
        "reception), found '0'.")


@pytest.mark.parametrize("name, place, value, told", [
    ("ticks", None, [[0], [1]], ": expected a matrix of real numbers with 2 columns (right ticks, "
     "left ticks), found float64 of shape (2, 1)"), ("ticks", None, [], ": expected at least"),
    ("ticks", (3, 1), np.nan, ", row 4: expected left ticks, a number"),
    ("aruco", None, [[1], [1, 2]], ": expected a matrix of real numbers with 11 columns (pose id"),
    ("uwb", None, [[1, 3, 1j, 1]], ": expected a matrix of real numbers with 4 columns (pose id, "
     "antenna id, range, sigma), found object of shape (1, 4)"),
    ("uwb", None, [[1, "a"]], ": expected a matrix of real numbers with 4 columns (pose id, "
     "antenna id, range, sigma), found object of shape (1, 2)"),
    ("aruco", (2, 0), 5, ", row 3: expected pose id, a whole number from 1 to 4"),
    ("ticks", (2, 0), 80_001, ", row 3: expected at most 10 wheel revolutions (80000 ticks) since "
     "the pose before, not since the start, and none in the first row, found '80001'"),
    ("guess", (1, 0), 900, ", row 2: expected each id only once"),
    ("vehicle", None, "tractor", ": expected a Vehicle, found 'tractor'"),
    ("vehicle", None, Vehicle(sigma_wheelbase=-1.0), ": expected a number from 1e-09 to 20 m for "
     "sigma_wheelbase, found '-1.0'"),
    ("vehicle", None, Vehicle(kernel="L2"), ': expected "asymmetric Tukey" or')])
def test_arguments_pass_the_checks_of_files_or_are_named_with_the_row(name, place, value, told):
    if place:
        value, number = ARRAYS[name].copy(), value
        value[place] = number
    given = ARRAYS | {name: value}
    assert error_of(dataset_from_arrays, *given.values()).startswith(name + told)


# Which file of a folder is which.


@pytest.mark.parametrize("name, variant", [
    *[("ArucoReading.txt", variant) for variant in (
        "ArucoReading.txt.txt", "ArucoReading (1).txt", "ArucoReading(2).txt", "ArucoReading",
        "ArucoReading - Copy.txt", "ArucoReading - Copy (2).txt", "ArucoReading.csv",
        "ArucoReading.tsv", "ArucoReading.dat", "arucoreading.CSV.TXT")],
    ("encoderReading.txt", "encoderReading.csv"), ("UwbReading.txt", "UwbReading"),
    ("UwbAntennaGuess.txt", "UwbAntennaGuess.txt.txt"), ("vehicle.toml", "vehicle.toml.txt"),
    ("vehicle.toml", "vehicle (1).toml"), ("vehicle.toml", "vehicle - Copy.toml")])
def test_a_name_that_is_unmistakable_is_read_with_a_note(folder, name, variant):
    clean, truth = read_dataset(folder), read_truth(folder)
    (folder / name).rename(folder / variant)
    assert_same(read_dataset(folder), clean, f"{variant} was read as {name}.")
    assert_same(read_truth(folder), truth)
    assert datasets_in(folder.parent) == (["drive"], [])


@pytest.mark.parametrize("change", [str.upper, str.lower])
def test_names_in_another_case_are_found_in_the_folder_truth_too(folder, change):
    clean, truth = read_dataset(folder), read_truth(folder)
    for name in FILES:
        path = folder / name
        path.rename(path.with_name(change(path.name)))
    (folder / "truth").rename(truths := folder / change("truth"))
    assert_same(read_dataset(folder), clean)
    assert_same(read_truth(folder), truth)
    (truths / change("ArucoMap.txt")).rename(truths / "ArucoMap (1).txt")
    write(truths / "sketch.png", b"\x89")
    assert_same(read_truth(folder), truth, "In truth: ArucoMap (1).txt was read as ArucoMap.txt.",
                "In truth: Not read: 'sketch.png'.")


def test_two_files_of_one_name_are_refused(folder):
    shutil.copy(folder / "ArucoReading.txt", folder / "ArucoReading (1).txt")
    assert error_of(read_dataset, folder) == error_of(datasets_in, folder.parent) == (
        f"{folder / 'ArucoReading.txt'}: expected one file of this name, found ArucoReading (1).txt"
        " and ArucoReading.txt: move one of them away")


@pytest.mark.parametrize("name", [
    "ArucoMeasurements.txt", "markers.csv", "ArucoReading_2.txt", "ArucoReading.txt.bak",
    "ArucoReading.json", "ArucoReading.xlsx", "ArucoReading.pdf", "ArucoReading.txt.gz",
    "ArucoReading.zip", "ArucoReading.txt.crdownload", ".ArucoReading.txt.icloud", "logs.zip"])
def test_other_names_are_not_guessed_but_listed(folder, name):
    clean = read_dataset(folder)
    (folder / "ArucoReading.txt").rename(folder / name)
    assert_same(read_dataset(folder), clean.without("aruco"), f"Not read: '{name}'.")
    (folder / "encoderReading.txt").unlink()
    assert error_of(read_dataset, folder) == (
        f"{folder / 'encoderReading.txt'}: expected this file, found none. Not read: '{name}'")


def test_other_files_are_named_and_those_of_systems_are_not(folder):
    for name in (".DS_Store", "._ArucoReading.txt", "Thumbs.db", "desktop.ini", "README.md",
                 "notes.txt", "photo.jpg", "uwb.pdf", "\u6d4b\n.txt"):
        write(folder / name, b"\0")
    (folder / "__MACOSX").mkdir()
    (folder / "photos").mkdir()
    assert read_dataset(folder).notes == (
        "Not read: 'README.md', 'notes.txt', 'photo.jpg', 'photos', 'uwb.pdf' and 1 more.",)
    (folder / "README.md").unlink()
    assert read_dataset(folder).notes == (
        "Not read: 'notes.txt', 'photo.jpg', 'photos', 'uwb.pdf', '\u6d4b\\n.txt'.",)


def test_datasets_are_the_folders_with_any_file_of_one_and_all_others_are_named(tmp_path):
    for name in ("b/encoderReading.txt", "a/ENCODERREADING.TXT", ".hidden/encoderReading.txt",
                 "README.md"):
        write(tmp_path / name, "1 0 0\n")
    assert datasets_in(tmp_path) == (["a", "b"], [])
    for name in ("notes.txt", "encoder.txt", "vehiclePose.mat", "drive.zip"):
        write(tmp_path / "notes" / name, b"\0")
    write(tmp_path / "course.zip", b"PK")
    for names in (["a", "b"], ["b"]):
        assert datasets_in(tmp_path, names) == (names, [
            f"{tmp_path}: Not read: 'course.zip', 'notes'."])
    for name in ("UwbReading.txt", "vehicle.toml.txt"):
        write(tmp_path / f"{name}_alone" / name, "")
    assert datasets_in(tmp_path)[0] == ["UwbReading.txt_alone", "a", "b", "vehicle.toml.txt_alone"]
    said = "expected one of UwbReading.txt_alone, a, b, vehicle.toml.txt_alone, found 'c'"
    assert error_of(datasets_in, tmp_path, ["b", "c"]) == f"{tmp_path}: {said}"
    assert "with a sub-folder with an enc" in error_of(datasets_in, tmp_path / "a")


def test_what_was_found_is_said(folder):
    wheels = "drive: encoders: 4 poses, 15 ticks right and 32019 left"
    assert inventory_lines(read_dataset(folder), read_truth(folder)) == [
        wheels, "drive: markers: 3 sightings of 2 markers at 2 poses",
        "drive: ranges: 2 ranges to 2 antennas at 2 poses",
        "drive: vehicle.toml: wheelbase = 0.5", "drive: truth: yes"]
    for name in ("ArucoReading.txt", "vehicle.toml"):
        (folder / name).unlink()
    write(folder / "UwbReading.txt", "# none\n")
    assert inventory_lines(read_dataset(folder), None) == [
        wheels, "drive: markers: none, no ArucoReading.txt with usable rows",
        "drive: ranges: none, no UwbReading.txt with usable rows",
        "drive: vehicle.toml: none, or as the assignment's table 2", "drive: truth: no"]
