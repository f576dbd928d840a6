"""Numbers as text: three digits, and means over drives with their standard errors."""

import numpy as np
import pytest

from slamlib.notebook import is_significant, number, share, table_text, verdict, with_error

THREE = [1.0, 2.0, 3.0]      # mean 2, standard deviation 1, standard error 0.577


@pytest.mark.parametrize("value, text", [
    (12345.6, "12,346"), (123.45, "123"), (99.96, "100.0"), (12.345, "12.3"), (1.234, "1.23"),
    (0.1234, "0.12"), (-12.34, "−12.3"), (-0.001, "0.00")])
def test_numbers_have_three_digits_and_at_most_two_decimals(value, text):
    assert number(value) == text


def test_the_standard_error_has_two_digits_and_the_mean_as_many_decimals():
    assert with_error(THREE) == "2.00 ± 0.58"
    assert with_error(THREE, 10) == "20.0 ± 5.8"
    assert with_error(THREE, 1000, signed=True) == "+2,000 ± 577"
    assert with_error(THREE, -1) == "−2.00 ± 0.58"
    assert with_error(THREE, 1e-4) == "0.000 ± 0.000"       # three decimals at most
    assert with_error([2.0, 2.0]) == "2.00 ± 0.00"
    assert with_error([1e6, 1e9]) == "> 10,000"


def test_shares_are_in_percent():
    assert share([True, False, True, True]) == "75\u00a0±\u00a025\u00a0%"
    assert share([1, 1]) == "100\u00a0%"
    assert share([0.5, 0.7], signed=True) == "+60\u00a0±\u00a010\u00a0%"


def test_a_difference_is_decided_beyond_two_standard_errors():
    assert is_significant(THREE) and is_significant([-3, -2, -1])         # 2 > 2 * 0.577
    assert not is_significant([0.0, 1.0, 2.0])                     # 1 < 2 * 0.577
    study = {"a x": np.array([1.0, 1.0, 1.0]), "b x": np.array([2.0, 3.0, 4.0]),
             "c x": np.array([-1.0, 0.0, -2.0]), "d x": np.array([1.0, 2.0, 0.5])}
    assert verdict(study, "abcd", "a", "x", 10) == (
        "larger with b (+20.0 ± 5.8); smaller with c (−20.0 ± 5.8); undecided with d (+1.7 ± 4.4)")


def test_numbers_of_a_table_have_minus_signs():
    text = table_text(["name", "x", "y"], [["a-1", "-0.5", "+1, -2 ± 3 (-4)"]])
    assert text.splitlines()[-1] == "| a-1 | −0.5 | +1, −2 ± 3 (−4) |"


def test_a_row_of_one_cell_is_a_heading():
    lines = table_text(["name", "x", "y"], [["*short*"], ["a", "1", "2"]]).split("\n")
    assert lines[2:] == ["| *short* |  |  |", "| a | 1 | 2 |"]
