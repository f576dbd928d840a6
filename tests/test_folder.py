"""Which file of a folder is which: read with a note, named as not read, or refused."""

import shutil
import zipfile

import pytest
from test_dataset import FILES, assert_same, error_of, folder, write  # noqa: F401
from test_dialects import assert_same_but_notes

from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth
from slamlib.folder import left_in
from slamlib.inventory import inventory_lines


@pytest.mark.parametrize("variant", [
    "ArucoReading.txt.txt", "ArucoReading (1).txt", "ArucoReading(2).txt", "ArucoReading",
    "ArucoReading - Copy.txt", "ArucoReading - Copy (2).txt", "ArucoReading copy 2.txt",
    "ArucoReading - Copia.txt", "Copia di ArucoReading.txt", "Copy of ArucoReading.txt.txt",
    "ArucoReading.csv", "ArucoReading.tsv", "ArucoReading.dat", "arucoreading.CSV.TXT"])
def test_a_name_that_is_unmistakable_is_read_with_a_note(folder, variant):  # noqa: F811
    clean = read_dataset(folder)
    (folder / "ArucoReading.txt").rename(folder / variant)
    dataset = read_dataset(folder)
    assert_same_but_notes(dataset, clean)
    assert dataset.notes == (f"{variant} was read as ArucoReading.txt.",)


@pytest.mark.parametrize("name, variant", [
    ("encoderReading.txt", "encoderReading.csv"), ("UwbReading.txt", "UwbReading"),
    ("UwbAntennaGuess.txt", "UwbAntennaGuess.txt.txt"), ("vehicle.toml", "vehicle.toml.txt"),
    ("vehicle.toml", "vehicle (1).toml"), ("vehicle.toml", "vehicle - Copy.toml")])
def test_so_are_the_other_files(folder, name, variant):  # noqa: F811
    clean, truth = read_dataset(folder), read_truth(folder)
    (folder / name).rename(folder / variant)
    dataset = read_dataset(folder)
    assert_same_but_notes(dataset, clean)
    assert_same(read_truth(folder), truth)
    assert dataset.notes == (f"{variant} was read as {name}.",)
    assert dataset_names(folder.parent) == ["drive"]


def test_names_in_the_folder_truth(folder):  # noqa: F811
    truth = read_truth(folder)
    (folder / "truth/ArucoMap.txt").rename(folder / "truth/ArucoMap (1).txt")
    write(folder / "truth/sketch.png", b"\x89")
    found = read_truth(folder)
    assert_same_but_notes(found, truth)
    assert found.notes == ("In truth: ArucoMap (1).txt was read as ArucoMap.txt.",
                           "In truth: Not read: sketch.png.")
    (folder / "truth/ArucoMap (1).txt").rename(folder / "truth/ArucoMaps.txt")
    assert error_of(read_truth, folder).endswith(
        "ArucoMaps.txt: expected the name ArucoMap.txt: rename it, or move it away")


def test_a_copy_is_not_read_and_another_version_is_refused(folder):  # noqa: F811
    clean = read_dataset(folder)
    shutil.copy(folder / "ArucoReading.txt", folder / "ArucoReading (1).txt")
    dataset = read_dataset(folder)
    assert_same_but_notes(dataset, clean)
    assert dataset.notes == (
        "ArucoReading (1).txt is not read: it is a copy of ArucoReading.txt.",)
    write(folder / "ArucoReading (1).txt", FILES["ArucoReading.txt"] + "\n")
    differ = ("ArucoReading.txt: expected one file of this name, found {} and 'ArucoReading (1)"
              ".txt', which differ: move one of them away")
    assert error_of(read_dataset, folder).endswith(differ.format("ArucoReading.txt"))
    (folder / "ArucoReading.txt").rename(folder / "ArucoReading - Copy.txt")
    message = error_of(read_dataset, folder)
    assert "found ArucoReading (1).txt and" in message or "and 'ArucoReading (1).txt'" in message
    assert message.endswith("which differ: move one of them away")


@pytest.mark.parametrize("wrong, right", [
    ("ArucoMeasurements.txt", "ArucoReading.txt"), ("markers.csv", "ArucoReading.txt"),
    ("aruco", "ArucoReading.txt"), ("ArucoReading_2.txt", "ArucoReading.txt"),
    ("ArucoReading.txt.bak", "ArucoReading.txt"), ("ArucoReading.txt~", "ArucoReading.txt"),
    ("encoder.txt", "encoderReading.txt"), ("ticks.dat", "encoderReading.txt"),
    ("odometry.log", "encoderReading.txt"), ("uwb.txt", "UwbReading.txt"),
    ("ranges.txt", "UwbReading.txt"), ("AntennaGuess.txt", "UwbAntennaGuess.txt"),
    ("anchors.csv", "UwbAntennaGuess.txt"), ("UwbGuess.txt", "UwbAntennaGuess.txt"),
    *[(f"ArucoReading{end}", "ArucoReading.txt") for end in (
        ".text", ".prn", ".out", ".json", ".md", ".xml", ".m", ".txt_", ".TXT_", " (1).json")],
    ("encoderReading.text", "encoderReading.txt"), ("markers.prn", "ArucoReading.txt"),
    ("vehicle.tml", "vehicle.toml"), ("vehicle.txt", "vehicle.toml")])
def test_a_name_near_to_a_missing_one_is_refused(folder, wrong, right):  # noqa: F811
    (folder / right).rename(folder / wrong)
    message = error_of(read_dataset, folder)
    assert message == f"{folder / wrong}: expected the name {right}: rename it, or move it away"
    shutil.copy(folder / wrong, folder / right)          # with the right file it is only named
    assert read_dataset(folder).notes == (f"Not read: {wrong}.",)


def test_a_spreadsheet_is_to_be_saved_as_text(folder):  # noqa: F811
    (folder / "UwbReading.txt").rename(folder / "UwbReading.xlsx")
    assert error_of(read_dataset, folder).endswith(
        "UwbReading.xlsx: expected text, found a spreadsheet: save it as UwbReading.csv")


@pytest.mark.parametrize("extension, said", [
    *[(end, "a document: save it as text in UwbReading.txt")
      for end in (".docx", ".odt", ".pdf", ".rtf", ".html", ".txt.pdf", " (1).PDF")],
    (".npy", "arrays of numpy: save them as text in UwbReading.txt"),
    (".txt.download", "an unfinished download: download UwbReading.txt again"),
    (".txt.crdownload", "an unfinished download: download UwbReading.txt again"),
    (".txt.url", "a link: copy UwbReading.txt itself here"),
    (".txt.lnk", "a link: copy UwbReading.txt itself here"),
    (".zip", "an archive: unpack it here as UwbReading.txt"),
    (".txt.gz", "an archive: unpack it here as UwbReading.txt")])
def test_a_file_of_a_sensor_that_is_no_text_is_refused(folder, extension, said):  # noqa: F811
    path = folder / f"UwbReading{extension}"
    shutil.copy(folder / "UwbReading.txt", path)
    assert len(read_dataset(folder).notes) == 1
    (folder / "UwbReading.txt").unlink()
    assert error_of(read_dataset, folder) == f"{path}: expected text, found {said}"


def test_maps_of_the_truth_that_are_no_text_are_refused(folder):  # noqa: F811
    (folder / "truth/UwbMap.txt").rename(folder / "truth/UwbMap.mat")
    assert error_of(read_truth, folder).endswith(
        "UwbMap.mat: expected text, found a .mat file: save it as text in UwbMap.txt")


@pytest.mark.parametrize("name", [
    ".UwbReading.txt.icloud", "._UwbReading.txt", ".uwbreading.csv.icloud"])
def test_a_hidden_file_stands_for_one_that_is_not_here(folder, name):  # noqa: F811
    write(folder / name, b"\0")
    write(folder / ".other.icloud", b"\0")
    assert read_dataset(folder).notes == ()
    (folder / "UwbReading.txt").unlink()
    assert error_of(read_dataset, folder) == (
        f"{folder / name}: expected text, found a hidden file: download or copy UwbReading.txt "
        "itself here")


def test_a_dataset_of_which_all_files_are_in_a_cloud_is_not_left_out(folder):  # noqa: F811
    write(folder.parent / "other" / ".encoderReading.txt.icloud", b"\0")
    with pytest.raises(DatasetError, match="other.*download or copy encoderReading.txt itself"):
        dataset_names(folder.parent)


@pytest.mark.parametrize("name", ["vehicle.jpg", "vehicle.pdf", "ArucoReading.png", "uwb.docx",
                                  "aruco.md", "markers.pdf", "range.html"])
def test_pictures_and_documents_are_no_sensors(folder, name):  # noqa: F811
    for missing in ("ArucoReading.txt", "UwbReading.txt", "vehicle.toml"):
        (folder / missing).unlink()
    write(folder / name, b"\0")
    assert read_dataset(folder).notes == (f"Not read: {name}.",)


def test_a_table_in_a_sub_folder_is_to_be_moved_up(folder):  # noqa: F811
    (folder / "sens").mkdir()
    (folder / "ArucoReading.txt").rename(folder / "sens/ArucoReading.txt.txt")
    assert error_of(read_dataset, folder) == (
        f"{folder / 'ArucoReading.txt'}: expected this file, found it as "
        "sens/ArucoReading.txt.txt: move it up, or away")
    shutil.copy(folder / "encoderReading.txt", folder / "sens")     # a dataset of its own
    assert read_dataset(folder).notes == ("Not read: sens.",)
    (folder / "encoderReading.txt").unlink()
    (folder / "sens/ArucoReading.txt.txt").rename(folder / "ArucoReading.txt")
    assert error_of(read_dataset, folder).endswith(
        "encoderReading.txt: expected this file, found it as sens/encoderReading.txt: move it up, "
        "or away")


def test_tables_in_folders_beside_each_other_are_to_be_moved(folder):  # noqa: F811
    for name, inner in (("encoderReading.txt", "wheels"), ("UwbReading.txt", "radio")):
        (folder / inner).mkdir()
        (folder / name).rename(folder / inner / name)
    for name in ("ArucoReading.txt", "UwbAntennaGuess.txt", "vehicle.toml"):
        (folder / name).unlink()
    assert error_of(read_dataset, folder).endswith(
        "UwbReading.txt: expected this file, found it as radio/UwbReading.txt: move it up, or away")
    shutil.rmtree(folder / "truth")
    assert error_of(read_dataset, folder).endswith(
        "expected the files of one dataset, found those of radio, wheels in sub-folders")


def test_other_files_are_named_and_those_of_systems_are_not(folder):  # noqa: F811
    (folder / "UwbReading.txt").unlink()
    for name in (".DS_Store", "Thumbs.db", "desktop.ini", "README.md", "notes.txt", "orange.txt",
                 "aruco_photo.jpg", "uwb.pdf"):
        write(folder / name, b"\0")
    (folder / "__MACOSX").mkdir()
    (folder / "photos").mkdir()
    assert read_dataset(folder).notes == (
        "Not read: README.md, aruco_photo.jpg, notes.txt, orange.txt, photos and 1 more.",)


def test_names_that_no_font_has_are_written_in_ascii(folder):  # noqa: F811
    write(folder / "\u6d4b\n.txt", "")
    assert read_dataset(folder).notes == (r"Not read: '\u6d4b\n.txt'.",)


def test_archives_are_pointed_at(folder):  # noqa: F811
    with zipfile.ZipFile(folder / "logs.zip", "w") as archive:
        archive.writestr("ArucoReading.txt", FILES["ArucoReading.txt"])
    note = "logs.zip is not read: unpack it here if it holds files of this dataset."
    assert read_dataset(folder).notes == (note,)
    (folder / "encoderReading.txt").unlink()
    assert error_of(read_dataset, folder).endswith(
        "encoderReading.txt: expected this file, found none, but 'logs.zip': unpack it")


def test_a_folder_with_an_archive_only_is_not_left_out(folder):  # noqa: F811
    write(folder.parent / "other" / "drive.zip", b"PK")
    with pytest.raises(DatasetError, match="other.encoderReading.txt: .*'drive.zip': unpack it"):
        dataset_names(folder.parent)
    assert dataset_names(folder.parent, ["drive"]) == ["drive"]


def test_files_one_folder_deeper(folder):  # noqa: F811
    clean, truth, data = read_dataset(folder), read_truth(folder), folder.parent
    (data / "inner").mkdir()
    folder.rename(data / "inner" / "logs")
    (data / "inner").rename(folder)
    write(folder / "README.md", "")
    dataset = read_dataset(folder)
    assert_same_but_notes(dataset, clean)
    assert dataset.name == "drive"
    assert dataset.notes == ("The files were read from the sub-folder logs.",
                             "Not read: README.md.")
    assert_same(read_truth(folder), truth)
    assert dataset_names(data) == ["drive"]
    shutil.copytree(folder / "logs", folder / "again")
    assert error_of(read_dataset, folder).endswith(
        "drive: expected the files of one dataset, found those of again, logs in sub-folders")


@pytest.mark.parametrize("name, listed", [
    ("encoder.txt", True), ("uwb.txt", True), ("vehicle.toml.txt", True), ("UwbReading.mat", True),
    ("notes.txt", False), ("vehiclePose.mat", False), ("README.md", False), ("photo.jpg", False)])
def test_a_folder_that_looks_like_a_dataset_is_not_left_out(folder, name, listed):  # noqa: F811
    write(folder.parent / "other" / name, b"\0")
    if listed:
        with pytest.raises(DatasetError, match=r"other.*expected"):
            dataset_names(folder.parent)
    else:
        assert dataset_names(folder.parent) == ["drive"]


def test_what_lies_beside_the_datasets_is_named(folder):  # noqa: F811
    data = folder.parent
    write(data / "README.md", "")
    assert left_in(data) == []
    write(data / "course.zip", b"PK")
    write(data / "UwbReading.txt", "")
    assert left_in(data) == [
        f"{data / 'UwbReading.txt'} is not read: move it into a folder of its dataset in {data}.",
        f"{data / 'course.zip'} is not read: unpack it into a folder in {data}."]


def test_what_was_found_is_said(folder):  # noqa: F811
    assert inventory_lines(read_dataset(folder), read_truth(folder)) == [
        "drive: encoders: 4 poses, 15 ticks right and 80019 left",
        "drive: markers: 3 sightings of 2 markers at 2 poses",
        "drive: ranges: 2 ranges to 2 antennas at 2 poses",
        "drive: vehicle.toml: wheelbase = 0.5", "drive: truth: yes"]
    for name in ("ArucoReading.txt", "vehicle.toml"):
        (folder / name).unlink()
    write(folder / "UwbReading.txt", "# none\n")
    assert inventory_lines(read_dataset(folder), None) == [
        "drive: encoders: 4 poses, 15 ticks right and 80019 left",
        "drive: markers: none, no ArucoReading.txt with rows",
        "drive: ranges: none, no UwbReading.txt with rows",
        "drive: vehicle.toml: none, or as the assignment's table 2", "drive: truth: no",
        "drive: note: UwbReading.txt holds no rows."]
