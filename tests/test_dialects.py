"""Files as they come: the same numbers with a note, named as not read, or refused."""

import gzip
import os
from dataclasses import replace

import numpy as np
import pytest
import test_dataset
from numeric import short
from scipy.io import savemat
from test_dataset import FILES, VEHICLE, assert_same, error_of, write

from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import dataset_from_arrays, read_dataset, read_truth
from slamlib.io.tables import datasets_in
from slamlib.solve import inventory_lines
from slamlib.studies.simulation import write_dataset

folder = test_dataset.folder


def cases(table):
    """Cells of a table with a row on each line and bars between columns; a pilcrow ends a line."""
    rows = [row.split("|") for row in table.strip("\n").split("\n")]
    return [[cell.strip(" ").replace("¶", "\n") for cell in row] for row in rows]


# UwbReading.txt in each dialect, and how its note says that it was read.

DIALECTS = cases("""
tabs                     | 4\t900\t2.5\t0.1¶1\t3\t1.25\t0.2 |
indented, blanks at ends | ¶  4 900 2.5 0.1 \t ¶   1   3 1.25  0.2\t¶ |
other spellings          | 004 +900 25e-1 .1¶1.0 3. 1.25E0 2e-1 |
no last line end         | 4 900 2.5 0.1¶1 3 1.25 0.2 |
CRLF                     | 4 900 2.5 0.1\r¶1 3 1.25 0.2\r¶ |
lone CR                  | 4 900 2.5 0.1\r1 3 1.25 0.2\r |
commas                   | 4,900,2.5,0.1¶1,3,1.25,0.2 |
commas and blanks        | 4 , 900 , 2.5 , 0.1¶1, 3, 1.25, 0.2 |
a comma at the end       | 4,900,2.5,0.1,¶1,3,1.25,0.2, |
quotes                   | "4","900","2.5","0.1"¶"1","3","1.25","0.2" |
semicolons               | 4;900;2.5;0.1¶1; 3; 1.25; 0.2 |
semicolons at the end    | 4 900 2.5 0.1 ;¶1 3 1.25 0.2; |
rows of a spreadsheet    | 4,900,2.5,0.1,,¶1,3,1.25,0.2,,¶,,,,,¶,,,,,¶ |
comments                 | # é¶4 900 2.5 0.1 # 1 2, µm¶¶¶1 3 1.25 0.2 |
comments of MATLAB       | % c, 1¶4 900 2.5 0.1 % 1;2¶1 3 1.25 0.2 |
comments of C            | // c, 1¶4 900 2.5 0.1 // 1;2¶1 3 1.25 0.2 |
semicolons, commas       | 4;900;2,5;0,1¶1;3;1,25;0,2 | with decimal commas
tabs, decimal commas     | 4\t900\t2,5\t0,1¶1\t3\t1,25\t0,2 | with decimal commas
blanks, decimal commas   | 4 900 2,5 0,1¶1 3 1,25 0,2 | with decimal commas
header                   | ¶# c¶ id  words¶4 900 2.5 0.1¶1 3 1.25 0.2 | without the header line
header of commas         | pose,x1 [m]¶4,900,2.5,0.1¶1,3,1.25,0.2 | without the header line
header of tabs, CRLF     | i\tx\r¶4\t900\t2.5\t0.1\r¶1\t3\t1.25\t0.2 | without the header line
""")


@pytest.mark.parametrize("dialect, text, how", DIALECTS)
def test_a_table_in_another_dialect_is_the_same_with_a_note_of_one_line(folder, dialect, text, how):
    clean = read_dataset(folder)
    write(folder / "UwbReading.txt", text)
    notes = [f"UwbReading.txt: read {how}."] if how else []
    assert_same(read_dataset(folder), clean, *notes)


def test_what_several_files_have_in_common_is_one_note(folder):
    clean = read_dataset(folder)
    write(folder / "UwbReading.txt", "i;x\n4;900;2,5;0,1\n1;3;1,25;0,2\n")
    write(folder / "UwbAntennaGuess.txt", "i;x;y\n900;1,0;2\n3;-4;5,5\n")
    (folder / "vehicle.toml").rename(folder / "vehicle (1).toml")
    (folder / "encoderReading.txt").rename(folder / "encoderReading.csv")
    assert_same(read_dataset(folder), clean,
                "Read encoderReading.csv as encoderReading.txt, vehicle (1).toml as vehicle.toml.",
                "UwbReading.txt, UwbAntennaGuess.txt: read with decimal commas.",
                "UwbReading.txt, UwbAntennaGuess.txt: read without the header line.")


@pytest.mark.parametrize("codec", ["UTF-8-sig", "UTF-16", "UTF-16-be", "UTF-16-le", "latin-1"])
def test_files_may_be_in_unicode_or_have_other_comments(folder, codec):
    clean, truth = read_dataset(folder), read_truth(folder)
    for name, text in FILES.items():
        write(folder / name, f"# \u00b5m\n{text}".encode(codec))
    assert_same(read_dataset(folder), clean)
    assert_same(read_truth(folder), truth)


def test_of_a_header_alone_there_is_no_row(folder):
    clean = read_dataset(folder)
    write(folder / "UwbReading.txt", "id_pose;id_beacon;r\n;;;\n")
    assert_same(read_dataset(folder), clean.without("uwb"),
                "UwbReading.txt: no rows of numbers.",
                "UwbReading.txt: read without the header line.")


@pytest.mark.parametrize("text", [
    "900 1 2 2.5\n3 -4 5.5 0\n", "900,1,2,\n3,-4,5.5,0\n", "900;1;2;-1.5\n3;-4;5.5;3\n"])
def test_heights_of_antennas_are_left_out_with_a_note(folder, text):
    clean = read_dataset(folder)
    write(folder / "UwbAntennaGuess.txt", text)
    assert_same(read_dataset(folder), clean,
                "UwbAntennaGuess.txt: read without z, the fourth column.")


# Faults of a file: its whole text, the line that is named, and what is said.

MALFORMED = {
    "encoderReading.txt": """
 |  | at least the row '1 0 0', found no rows
# nothing¶¶ |  | at least the row '1 0 0', found no rows
pose right left¶ |  | at least the row '1 0 0', found no rows
1 0 0¶2 5 | 2 | 3 numbers (pose id, right ticks, left ticks), found '2 5'
¶1 0¶2 0¶ | 2 | 3 numbers (pose id, right ticks, left ticks), found '1 0'
\r\r1 0 0\r\r2 0\r | 5 | 3 numbers (pose id, right ticks, left ticks), found '2 0'
\r¶1 0 0\r¶2 0 | 3 | 3 numbers (pose id, right ticks, left ticks), found '2 0'
# c¶¶1 0 0¶2 5 6 7 | 4 | 3 numbers (pose id, right ticks, left ticks), found '2 5 6 7'
1 0 0¶2 five 6 | 2 | 3 numbers (pose id, right ticks, left ticks), found '2 five 6'
1 0 0¶2 0x10 6 | 2 | 3 numbers (pose id, right ticks, left ticks), found '2 0x10 6'
1 0 0¶2 1e 6 | 2 | 3 numbers (pose id, right ticks, left ticks), found '2 1e 6'
1 0 0¶2 . 6 | 2 | 3 numbers (pose id, right ticks, left ticks), found '2 . 6'
1 0 0¶2 5 \0 | 2 | 3 numbers (pose id, right ticks, left ticks), found '2 5 \\x00'
a b c¶id ticks¶1 0 0 | 2 | 3 numbers (pose id, right ticks, left ticks), found 'id ticks'
a;b;c¶1;0;0¶2;;12 | 3 | right ticks, a whole number from -1e+15 to 1e+15, found '2 nan 12'
1 0 0¶2 infinity 6 | 2 | right ticks, a whole number from -1e+15 to 1e+15, found '2 inf 6'
1 0 0¶2 1e999 6 | 2 | right ticks, a whole number from -1e+15 to 1e+15, found '2 inf 6'
1 0 0¶2 -2e15 6 | 2 | right ticks, a whole number from -1e+15 to 1e+15, found '2 -2e+15 6'
1 0 0¶2 5.5 6 | 2 | right ticks, a whole number from -1e+15 to 1e+15, found '2 5.5 6'
1 0 0¶2 990 1,020 | 2 | left ticks, a whole number from -1e+15 to 1e+15, found '2 990 1.02'
1 0 0¶2.5 5 6 | 2 | pose id, a whole number from -1e+15 to 1e+15, found '2.5 5 6'
1 0 0¶2 5 80001 | 2 | at most 10 wheel revolutions (80000 ticks) since the pose before
1 0 0¶2 -80001 5 | 2 | at most 10 wheel revolutions (80000 ticks) since the pose before
# c¶1 0 1¶2 5 6 | 2 | and none in the first row, found '1 0 1'
1 0 0¶3 5 6 | 2 | pose ids 1, 2, 3, ... in order, found '3 5 6'
0 0 0¶1 5 6 | 1 | pose ids 1, 2, 3, ... in order, found '0 0 0'
""",
    "UwbReading.txt": """
0 3 1 1¶1 3 1 1 | 1 | pose ids from 1 on, found '0 3 1 1'
a;b¶¶1;3;nan;1¶1;3;2,5;1¶9;3;1,5;1 | 5 | a whole number from 1 to 4 (the rows of the encoder)
1,3,1,5,0,1 | 1 | 4 numbers (pose id, antenna id, range, sigma), found '1,3,1,5,0,1'
1a 3b 1.5c 0.1d¶1 3 1 1 | 1 | range, sigma), found '1a 3b 1.5c 0.1d'
1,3,1.5,0.1¶2,3 1.6,0.1 | 2 | 4 numbers (pose id, antenna id, range, sigma), found '2,3 1.6,0.1'
1;3;1.5;0.1¶2;3;1.6;0.1,2x | 2 | range, sigma), found '2;3;1.6;0.1,2x'
1 3 1.5 0.1¶EOF | 2 | 4 numbers (pose id, antenna id, range, sigma), found 'EOF'
1 3 1.500,00 0,1 | 1 | 4 numbers (pose id, antenna id, range, sigma), found '1 3 1.500,00 0,1'
""",
    "UwbAntennaGuess.txt": """
900 1 2¶900 1 3 | 2 | each id only once, found '900 1 3'
900 1 2¶3 nan 5.5 | 2 | x, a finite number from -1e+07 to 1e+07 m, found '3 nan 5.5'
900 1 2 up | 1 | 3 numbers (antenna id, x, y), found '900 1 2 up'
900 1 2 3 4 | 1 | 3 numbers (antenna id, x, y), found '900 1 2 3 4'
""",
    "truth/vehiclePose.txt": """
 |  | 4 poses (encoder file), found 0
1 0 0 0¶2 0 0 0 |  | 4 poses (encoder file), found 2
1 0 0 0¶2 0 0 | 2 | 4 numbers (pose id, x, y, theta), found '2 0 0'
1 0 0 0¶3 0 0 0 | 2 | pose ids 1, 2, 3, ... in order, found '3 0 0 0'
""",
    "truth/ArucoMap.txt": """
40 0 0 0¶40 0 0 0 | 2 | each id only once, found '40 0 0 0'
""",
    "truth/vehicle.toml": """
wheelbase = 0 | 1 | a number from 0.001 to 20 m for wheelbase, found '0'
""",
    "vehicle.toml": """
# a¶wheel_base = 1 | 2 | entries such as 'wheelbase', found 'wheel_base'
[wheelbases]¶x = 1 | 1 | entries such as 'wheelbase', found 'wheelbases'
# left_radius¶left_radius = 'wide' | 2 | a number from 0.001 to 2.5 m for left_radius, found 'wide'
gate = true¶ "left_radius" = [0.1] | 2 | a number from 0.001 to 2.5 m for left_radius, found '[0.1]'
left_radius = true | 1 | a number from 0.001 to 2.5 m for left_radius, found 'True'
left_radius = nan | 1 | a number from 0.001 to 2.5 m for left_radius, found 'nan'
left_radius = inf | 1 | a number from 0.001 to 2.5 m for left_radius, found 'inf'
left_radius = 0,1 |  | TOML such as 'wheelbase = 0.4', found
left_radius = |  | TOML such as 'wheelbase = 0.4', found
gate = true¶gate = true |  | TOML such as 'wheelbase = 0.4', found
left_radius = \0 1 |  | TOML such as 'wheelbase = 0.4', found
"""}
LONG = [
    ("encoderReading.txt", "1 0 0\n2 " + "x" * 999, "2", f"found '2 {118 * 'x'}...'"),
    ("encoderReading.txt", gzip.compress(b"1 0 0\n", mtime=0), "1", "3 numbers"),
    ("vehicle.toml", "left_radius = " + "[" * 5000, "", "TOML")]


@pytest.mark.parametrize("name, content, line, said", LONG + [
    (name, *case) for name, table in MALFORMED.items() for case in cases(table)])
def test_faults_in_a_file_are_named_by_file_line_and_expectation(folder, name, content, line, said):
    write(folder / name, content)
    message = error_of(read_truth if name.startswith("truth/") else read_dataset, folder)
    place = f"{folder / name}, line {line}: " if line else f"{folder / name}: "
    assert message.startswith(place + "expected ") and said in message


# Readings that no sensor can have made cost a row each, up to a tenth of the file.

BAD_ROWS = cases("""
ArucoReading.txt | 1 40 0 0 0 1 1 0 1 0 1 | a positive definite covariance (smallest eigenvalue of
ArucoReading.txt | 1 40 0 0 0 1e-4 2e-4 0 1e-4 0 1e4 | a positive definite covariance
ArucoReading.txt | 1 40 0 0 0 1 .9 -.9 1 .9 1 | a positive definite covariance
ArucoReading.txt | 1 40 0 0 0 1 9e14 0 1 0 1e-18 | a positive definite covariance
ArucoReading.txt | 301 40 0 0 0 1 0 0 1 0 1 | pose id, a whole number from 1 to 300 (the rows
ArucoReading.txt | 1 40 0 inf 0 1 0 0 1 0 1 | y, a finite number from -10000 to 10000 m, found
ArucoReading.txt | 1 4.5 0 0 0 1 0 0 1 0 1 | marker id, a whole number from -1e+15 to 1e+15, found
UwbReading.txt | 1 5 -5.1 1 | a range that is not below -5 sigma, found '1 5 -5.1 1'
UwbReading.txt | 301 5 1 1 | pose id, a whole number from 1 to 300 (the rows of
UwbReading.txt | 1 5 1 0 | sigma, a finite number from 1e-09 to 10000 m, found '1 5 1 0'
UwbReading.txt | 1 3.5 1 1 | antenna id, a whole number from -1e+15 to 1e+15, found '1 3.5 1 1'
""")


@pytest.mark.parametrize("name, row, said", BAD_ROWS)
def test_a_bad_row_costs_a_row_up_to_a_tenth_of_the_file(tmp_path, name, row, said):
    folder = tmp_path / "drive"
    write_dataset(folder, short(1, 300)[0])
    clean = read_dataset(folder)
    lines = (folder / name).read_text().splitlines()
    most = len(lines) // 9                            # rows that are a tenth of the file
    write(folder / name, "\n".join(["# comment"] + [row] * most + lines))
    found = read_dataset(folder)
    assert_same(found, clean, *found.notes)
    assert found.notes[0].startswith(f"{name}: {most} of {most + len(lines)} rows left out, the "
                                     f"first in line 2: expected {said}")
    write(folder / name, "\n".join([row] * (most + 2) + lines))
    assert error_of(read_dataset, folder).startswith(
        f"{folder / name}, line 1: expected {said}")


@pytest.mark.parametrize("gap", ["1 3 NaN 1", "nan 3 1 1", "1,3,,1", "1,3,1,", "1 3 0 0"])
def test_any_number_of_rows_with_a_gap_or_without_reception_is_left_out(folder, gap):
    clean = read_dataset(folder)
    write(folder / "UwbReading.txt", f"{gap}\n{FILES['UwbReading.txt']}{gap}\n{gap}")
    found = read_dataset(folder)
    assert_same(found, clean, *found.notes)
    assert found.notes[0].startswith("UwbReading.txt: 3 of 5 rows left out, the first in line 1: "
                                     "expected no gap (an empty cell, NaN or the range 0), found '")


def test_without_usable_rows_a_sensor_is_none(folder):
    write(folder / "UwbReading.txt", "1 3 nan 1\n2 3 0 0\n")
    assert read_dataset(folder).uwb is None


# Ranges need guesses, and other problems need none.


def test_ranges_of_antennas_without_a_guess_are_left_out(folder):
    clean = read_dataset(folder)
    write(folder / "UwbReading.txt", "1 7 1 1\n" + FILES["UwbReading.txt"] + "2 -5 9 1\n3 7 2 1\n")
    assert_same(
        read_dataset(folder), clean, "UwbReading.txt: 3 of 5 rows left out, the first in line 1: "
        "expected an antenna id of UwbAntennaGuess.txt, found '1 7 1 1'.")


def test_without_guesses_problem_4_is_left_out_with_a_note(folder):
    clean = replace(read_dataset(folder), uwb=None, antenna_guess=None)
    (folder / "UwbAntennaGuess.txt").unlink()
    found = read_dataset(folder)
    assert_same(found, clean, "UwbAntennaGuess.txt is missing: the ranges are left out.")
    assert inventory_lines(found, None)[:2] == [
        "drive: 4 poses, 3 sightings, 0 ranges, truth unknown",
        "drive: left out, no UWB ranges to antennas with a guess: problem4"]


# Files of MATLAB.


def matrix(name):
    return np.array([line.split() for line in FILES[name].splitlines()], float)


MATRICES = {"ENCODERreading": matrix("encoderReading.txt").astype("int32"), "x": 1.0,
            **{name: matrix(f"{name}.txt")
               for name in ("ArucoReading", "UwbReading", "UwbAntennaGuess")}}


def test_matrices_of_a_mat_file_stand_in_for_missing_text(folder):
    clean = read_dataset(folder)
    savemat(folder / "drive.mat", MATRICES, do_compression=True)
    assert read_dataset(folder).notes == ("Not read: 'drive.mat'.",)
    for path in folder.glob("*.txt"):
        path.unlink()
    found = read_dataset(folder)
    assert_same(found, clean, *found.notes)
    assert found.notes[0].startswith(
        "Read drive.mat, variable ENCODERreading as encoderReading.txt, drive.mat, ")


def test_faults_in_a_mat_file_are_named_by_variable_and_row(folder):
    (folder / "UwbReading.txt").unlink()
    savemat(folder / "logs.mat", {"UwbReading": [[1, 3, 1.5, 0.1], [9, 3, 1.5, 0.1]]})
    assert error_of(read_dataset, folder).startswith(
        f"{folder / 'logs.mat'}, variable UwbReading, row 2: expected pose id, a whole number from "
        "1 to 4")


@pytest.mark.parametrize("content", [
    None, b"nonsense", b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\0" * 99])
def test_why_a_mat_file_is_not_read_is_said(folder, content):
    path = folder / "UwbReading.mat"
    os.mkfifo(path) if content is None else write(path, content)
    (folder / "UwbReading.txt").unlink()
    listed, *reasons = read_dataset(folder).notes
    assert listed == "Not read: 'UwbReading.mat'."
    assert content is None or reasons == [
        "UwbReading.mat: expected a matrix named as UwbReading.txt of a file that 'save -v7' "
        "wrote."]


def test_a_mat_file_without_the_matrix_of_a_missing_file_is_told(folder):
    (folder / "encoderReading.txt").unlink()
    savemat(folder / "logs.mat", {"encoders": [[1, 0, 0]]})
    assert error_of(read_dataset, folder).endswith(
        "logs.mat: expected a matrix named as encoderReading.txt of a file that 'save -v7' wrote.")


def test_two_matrices_of_one_name_are_refused(folder):
    (folder / "UwbReading.txt").unlink()
    for name in "ab":
        savemat(folder / f"{name}.mat", {"UwbReading": matrix("UwbReading.txt")})
    assert error_of(read_dataset, folder) == (
        f"{folder / 'b.mat'}, variable UwbReading: expected only one UwbReading.txt, found 'a.mat, "
        "variable UwbReading'")


# Arrays in place of files.

ARRAYS = {"ticks": matrix("encoderReading.txt")[:, 1:], "aruco": MATRICES["ArucoReading"],
          "uwb": MATRICES["UwbReading"], "guess": MATRICES["UwbAntennaGuess"]}


def test_arrays_are_the_dataset_of_their_files(folder):
    expected = read_dataset(folder)
    lists = {name: value.tolist() for name, value in ARRAYS.items()}
    assert_same(dataset_from_arrays(**lists, vehicle=VEHICLE, name="drive"), expected)
    assert dataset_from_arrays(ARRAYS["ticks"]).aruco is None


@pytest.mark.parametrize("name, value, told", [
    ("ticks", [[0], [1]], ": expected a matrix of numbers with 2 columns (right ticks, left ticks),"
     " found 'shape (2, 1)'"), ("ticks", [], ": expected at least"),
    ("ticks", [[0, 0], [1, np.nan]], ", row 2: expected left ticks, a whole number"),
    ("ticks", [[0, 0], [80_001, 0]], ", row 2: expected at most 10 wheel revolutions"),
    ("aruco", [[1], [1, 2]], ": expected a matrix of numbers with 11 columns (pose id, marker id"),
    ("guess", [[1j, 1, 1]], ": expected a matrix of numbers with 3 columns (antenna id, x, y), "),
    ("uwb", [[1, "a"]], ": expected a matrix of numbers with 4 columns (pose id, antenna id, "),
    ("uwb", [[9, 3, 1, 1]], ", row 1: expected pose id, a whole number from 1 to 4"),
    ("guess", [[3, 0, 0], [3, 1, 1]], ", row 2: expected each id only once"),
    ("vehicle", Vehicle(sigma_wheelbase=-1.0), ": expected a number from 1e-09 to 20 m for "
     "sigma_wheelbase, found '-1.0'")])
def test_arguments_pass_the_checks_of_files_or_are_named_with_the_row(name, value, told):
    given = ARRAYS | {name: value}
    assert error_of(dataset_from_arrays, *given.values()).startswith(name + told)


# Which file of a folder is which.


@pytest.mark.parametrize("name, variant", cases("""
ArucoReading.txt    | ArucoReading.txt.txt
ArucoReading.txt    | ArucoReading (1).txt
ArucoReading.txt    | ArucoReading(2).txt
ArucoReading.txt    | ArucoReading
ArucoReading.txt    | ArucoReading.csv
ArucoReading.txt    | ArucoReading.tsv
ArucoReading.txt    | ArucoReading.dat
ArucoReading.txt    | arucoreading.CSV.TXT
encoderReading.txt  | encoderReading.csv
UwbAntennaGuess.txt | UwbAntennaGuess.txt.txt
vehicle.toml        | vehicle.toml.txt
vehicle.toml        | vehicle (1).toml
"""))
def test_a_name_that_is_unmistakable_is_read_with_a_note(folder, name, variant):
    clean = read_dataset(folder)
    (folder / name).rename(folder / variant)
    assert_same(read_dataset(folder), clean, f"Read {variant} as {name}.")


def test_names_in_another_case_are_found(folder):
    clean, truth = read_dataset(folder), read_truth(folder)
    for name in FILES:
        path = folder / name
        path.rename(path.with_name(path.name.upper()))
    (folder / "truth").rename(folder / "TRUTH")
    assert_same(read_dataset(folder), clean)
    assert_same(read_truth(folder), truth)


def test_notes_on_the_files_of_the_truth_say_so(folder):
    truth = read_truth(folder)
    (folder / "truth/ArucoMap.txt").rename(folder / "truth/ArucoMap (1).txt")
    write(folder / "truth/sketch.png", b"\x89")
    assert_same(read_truth(folder), truth, "In truth: Read ArucoMap (1).txt as ArucoMap.txt.",
                "In truth: Not read: 'sketch.png'.")


def test_two_files_of_one_name_are_refused(folder):
    write(folder / "ArucoReading (1).txt", FILES["ArucoReading.txt"])
    assert error_of(read_dataset, folder) == error_of(datasets_in, folder.parent) == (
        f"{folder / 'ArucoReading.txt'}: expected only one ArucoReading.txt, found 'ArucoReading "
        "(1).txt'")


@pytest.mark.parametrize("name", [
    "ArucoMeasurements.txt", "ArucoReading_2.txt", "ArucoReading.txt.bak", "ArucoReading.xlsx",
    "ArucoReading.txt.gz", "ArucoReading.txt.crdownload", "ArucoReading - Copy.txt"])
def test_other_names_are_not_guessed_but_listed(folder, name):
    clean = read_dataset(folder)
    (folder / "ArucoReading.txt").rename(folder / name)
    assert_same(read_dataset(folder), clean.without("aruco"), f"Not read: '{name}'.")
    (folder / "encoderReading.txt").unlink()
    assert error_of(read_dataset, folder) == (
        f"{folder / 'encoderReading.txt'}: expected this file, found none. Not read: '{name}'.")


def test_other_files_are_named_in_a_short_line_and_hidden_ones_are_not(folder):
    for name in (".DS_Store", "._ArucoReading.txt", "\u6d4b\n.txt", "notes.txt"):
        write(folder / name, b"\0")
    (folder / "photos").mkdir()
    assert read_dataset(folder).notes == ("Not read: 'notes.txt', 'photos', '\u6d4b\\n.txt'.",)
    for number in range(100):
        write(folder / f"photo{number}.jpg", b"\0")
    assert len(read_dataset(folder).notes[0]) < 120


def test_datasets_are_the_folders_with_any_file_of_one_and_all_others_are_named(tmp_path):
    for name in ("b/encoderReading.txt", "a/ENCODERREADING.TXT", ".hidden/encoderReading.txt",
                 "c/vehicle.toml.txt", "README.md", "notes/notes.txt", "course.zip"):
        write(tmp_path / name, "1 0 0\n")
    unread = [f"{tmp_path}: Not read: 'course.zip', 'notes'."]
    assert datasets_in(tmp_path) == (["a", "b", "c"], unread)
    assert datasets_in(tmp_path, ["b"]) == (["b"], unread)
    assert error_of(datasets_in, tmp_path, ["b", "d"]).endswith("one of a, b, c, found 'd'")
    assert "with a sub-folder with an enc" in error_of(datasets_in, tmp_path / "a")


def test_what_was_not_found_is_said(folder):
    for name in ("ArucoReading.txt", "vehicle.toml"):
        (folder / name).unlink()
    write(folder / "UwbReading.txt", "# none\n")
    assert inventory_lines(read_dataset(folder), read_truth(folder)) == [
        "drive: 4 poses, 0 sightings, 0 ranges, truth known",
        "drive: left out, no markers: problem2, problem2_hint, problem2_fused, problem3",
        "drive: left out, no UWB ranges to antennas with a guess: problem4",
        "drive: note: UwbReading.txt: no rows of numbers."]
