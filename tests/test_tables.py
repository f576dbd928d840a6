"""Tables of notebooks: numbers as text, means over drives, and what is missing."""

from dataclasses import replace

import numpy as np
import pytest

from slamlib import localization, odometry, slam
from slamlib.evaluation import ate
from slamlib.notebook import Drive, accuracy, calibration_rows, table
from slamlib.notebook.tabular import cell
from slamlib.simulation import simulate
from slamlib.solve import problem_solution

THREE = np.array([1.0, 2.0, 6.0])      # mean 3, median 2, standard error 1.53


@pytest.mark.parametrize("value, text", [
    (12345.6, "12,346"), (123.45, "123"), (12.345, "12.3"), (1.234, "1.23"), (0.1234, "0.123"),
    (-12.34, "−12.3"), (0.0, "0"), (2e6, "> 10⁶"), (12345, "12,345"), (-5, "−5"), (True, "yes"),
    (np.False_, "no"), (None, "–"), (np.nan, "–"), ("a-1", "a-1"), (THREE, "3.0 ± 1.5 (2.0)"),
    (1e3 * THREE, "3,000 ± 1,528 (2,000)"), (THREE[:1], "1.00 (1.00)")])
def test_a_cell_has_three_digits_or_those_that_its_standard_error_leaves(value, text):
    assert cell(value) == text


def test_what_is_missing_is_a_dash_and_a_column_of_it_is_absent():
    lines = table([{"name": "a", "x": 1, "none": None, "y": 2.0},
                   {"name": "a", "x": np.nan, "none": np.nan}, {"name": "b", "z": "-3 m"}],
                  "Table 1.1. Text.").data.split("\n")
    assert lines == ["| name | x | y | z |", "| --- | ---: | ---: | ---: |", "| a | 1 | 2.00 | – |",
                     "|  | – | – | – |", "| b | – | – | −3 m |", "", "Table 1.1. Text."]
    assert table([]).data == "| – |\n| ---: |\n| – |"


@pytest.fixture(scope="module")
def drive():
    return Drive("short", *simulate("short", seed=4))


def test_accuracy_is_that_of_every_kind_of_result_and_without_truth_sigmas_only(drive):
    """The same poses with their frames, or in all rows; markers alone in their first frame."""
    alone = localization.localize(drive.dataset.aruco)
    row = accuracy(alone, drive)
    assert accuracy(problem_solution("problem2", drive.dataset, alone), drive) == row
    assert row["ATE (mm)"] > 0 and row["dataset"] == "short"
    found = odometry.equation2(drive.dataset.ticks, drive.dataset.vehicle)
    assert accuracy(found, drive)["ATE (mm)"] == 1e3 * ate(found[0], drive.truth.poses)
    late = drive.dataset.aruco.select(drive.dataset.aruco.pose > 500)     # another world
    assert accuracy(localization.localize(late), drive)["ATE (mm)"] < 200
    row = accuracy(localization.fuse(drive.dataset), replace(drive, truth=None))
    assert [*row] == ["dataset", "σ (mm)", "σ of δ (mrad)"] and row["σ (mm)"] > 0


def test_calibration_rows_state_and_estimate_and_know_the_wheels_of_simulated_drives(drive):
    result = slam.estimate(drive.dataset.without("uwb").first(400))
    rows = {row["entry"]: row for row in calibration_rows(result, drive)}
    assert not any("range" in entry or "tag" in entry for entry in rows)
    wheel = rows["`right_radius`"]
    assert wheel["stated"] == "0.1 ± 0.0001" and wheel["used"] == "both"
    assert float(wheel["true"]) == pytest.approx(drive.truth.vehicle.right_radius, abs=1e-6)
    value, sigma = map(float, wheel["estimated"].split(" ± "))
    assert abs(value - float(wheel["true"])) < 5 * sigma
    assert rows["`camera_x`"]["estimated"] is None and rows["`camera_x`"]["used"] == "statement"
    recorded = [*calibration_rows(result, replace(drive, truth=None))]
    assert {row["true"] for row in recorded} == {None}
