"""Which file of a folder is which: read with a note, or named as not read."""

import shutil

import pytest
from test_dataset import FILES, assert_same, assert_same_but_notes, error_of, folder, write  # noqa: F401

from slamlib.dataset import DatasetError, dataset_names, inventory_lines, read_dataset, read_truth
from slamlib.folder import left_in


@pytest.mark.parametrize("name, variant", [
    *[("ArucoReading.txt", variant) for variant in (
        "ArucoReading.txt.txt", "ArucoReading (1).txt", "ArucoReading(2).txt", "ArucoReading",
        "ArucoReading - Copy.txt", "ArucoReading - Copy (2).txt", "ArucoReading.csv",
        "ArucoReading.tsv", "ArucoReading.dat", "arucoreading.CSV.TXT")],
    ("encoderReading.txt", "encoderReading.csv"), ("UwbReading.txt", "UwbReading"),
    ("UwbAntennaGuess.txt", "UwbAntennaGuess.txt.txt"), ("vehicle.toml", "vehicle.toml.txt"),
    ("vehicle.toml", "vehicle (1).toml"), ("vehicle.toml", "vehicle - Copy.toml")])
def test_a_name_that_is_unmistakable_is_read_with_a_note(folder, name, variant):  # noqa: F811
    clean, truth = read_dataset(folder), read_truth(folder)
    (folder / name).rename(folder / variant)
    dataset = read_dataset(folder)
    assert_same_but_notes(dataset, clean)
    assert_same(read_truth(folder), truth)
    assert dataset.notes == (f"{variant} was read as {name}.",)
    assert dataset_names(folder.parent) == ["drive"]


@pytest.mark.parametrize("change", [str.upper, str.lower])
def test_names_in_another_case_are_found(folder, change):  # noqa: F811
    clean = read_dataset(folder), read_truth(folder)
    for name in FILES:
        path = folder / name
        path.rename(path.with_name(change(path.name)))
    (folder / "truth").rename(folder / change("truth"))
    assert_same((read_dataset(folder), read_truth(folder)), clean)


def test_names_in_the_folder_truth(folder):  # noqa: F811
    truth = read_truth(folder)
    (folder / "truth/ArucoMap.txt").rename(folder / "truth/ArucoMap (1).txt")
    write(folder / "truth/sketch.png", b"\x89")
    found = read_truth(folder)
    assert_same_but_notes(found, truth)
    assert found.notes == ("In truth: ArucoMap (1).txt was read as ArucoMap.txt.",
                           "In truth: Not read: 'sketch.png'.")


def test_two_files_of_one_name_are_refused(folder):  # noqa: F811
    shutil.copy(folder / "ArucoReading.txt", folder / "ArucoReading (1).txt")
    assert error_of(read_dataset, folder) == error_of(dataset_names, folder.parent) == (
        f"{folder / 'ArucoReading.txt'}: expected one file of this name, found ArucoReading (1).txt"
        " and ArucoReading.txt: move one of them away")


@pytest.mark.parametrize("name", [
    "ArucoMeasurements.txt", "markers.csv", "ArucoReading_2.txt", "ArucoReading.txt.bak",
    "ArucoReading.json", "ArucoReading.xlsx", "ArucoReading.pdf", "ArucoReading.txt.gz",
    "ArucoReading.zip", "ArucoReading.txt.crdownload", ".ArucoReading.txt.icloud", "logs.zip"])
def test_other_names_are_not_guessed_but_listed(folder, name):  # noqa: F811
    clean = read_dataset(folder)
    (folder / "ArucoReading.txt").rename(folder / name)
    dataset = read_dataset(folder)
    assert_same_but_notes(dataset, clean.without("aruco"))
    assert dataset.notes == (f"Not read: '{name}'.",)
    (folder / "encoderReading.txt").unlink()
    assert error_of(read_dataset, folder) == (
        f"{folder / 'encoderReading.txt'}: expected this file, found none. Not read: '{name}'")


def test_other_files_are_named_and_those_of_systems_are_not(folder):  # noqa: F811
    for name in (".DS_Store", "._ArucoReading.txt", "Thumbs.db", "desktop.ini", "README.md",
                 "notes.txt", "orange.txt", "photo.jpg", "uwb.pdf", "\u6d4b\n.txt"):
        write(folder / name, b"\0")
    (folder / "__MACOSX").mkdir()
    (folder / "photos").mkdir()
    assert read_dataset(folder).notes == (
        "Not read: 'README.md', 'notes.txt', 'orange.txt', 'photo.jpg', 'photos' and 2 more.",)
    for name in ("README.md", "notes.txt", "orange.txt"):
        (folder / name).unlink()
    assert read_dataset(folder).notes == (
        "Not read: 'photo.jpg', 'photos', 'uwb.pdf', '\u6d4b\\n.txt'.",)


@pytest.mark.parametrize("name, listed", [
    ("UwbReading.txt", True), ("vehicle.toml.txt", True), ("notes.txt", False),
    ("encoder.txt", False), ("vehiclePose.mat", False), ("drive.zip", False)])
def test_what_is_no_dataset_is_left_out_and_named(folder, name, listed):  # noqa: F811
    data = folder.parent
    write(data / "README.md", "")
    assert left_in(data) == []
    write(data / "other" / name, b"\0")
    if listed:
        with pytest.raises(DatasetError, match="other.encoderReading.txt: expected this file"):
            dataset_names(data)
        assert left_in(data) == []
    else:
        assert dataset_names(data) == ["drive"]
        write(data / "course.zip", b"PK")
        assert left_in(data) == [f"{data}: Not read: 'course.zip', 'other'."]


def test_what_was_found_is_said(folder):  # noqa: F811
    assert inventory_lines(read_dataset(folder), read_truth(folder)) == [
        "drive: encoders: 4 poses, 15 ticks right and 32019 left",
        "drive: markers: 3 sightings of 2 markers at 2 poses",
        "drive: ranges: 2 ranges to 2 antennas at 2 poses",
        "drive: vehicle.toml: wheelbase = 0.5", "drive: truth: yes"]
    for name in ("ArucoReading.txt", "vehicle.toml"):
        (folder / name).unlink()
    write(folder / "UwbReading.txt", "# none\n")
    assert inventory_lines(read_dataset(folder), None) == [
        "drive: encoders: 4 poses, 15 ticks right and 32019 left",
        "drive: markers: none, no ArucoReading.txt with rows",
        "drive: ranges: none, no UwbReading.txt with rows",
        "drive: vehicle.toml: none, or as the assignment's table 2", "drive: truth: no"]
