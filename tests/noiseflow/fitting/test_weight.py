"""The search for the weight of least held-out likelihood."""

import math

import pytest

from noiseflow.fitting.signal_models import choose_weight


@pytest.mark.parametrize("best", [0.02, 0.2, 0.31, 1.0, 5.0])
def test_lowest_point_of_a_smooth_valley_is_found(best):
    choice = choose_weight(lambda weight: math.log(weight / best) ** 2, 0.25, most=12)
    assert choice.weight == pytest.approx(best, rel=1e-6)


def test_the_lowest_rung_counts_where_no_bracket_is_found():
    choice = choose_weight(lambda weight: -weight, 0.25, most=4)
    assert choice.weight == max(choice.tried) == 2.0
    assert len(choice.tried) == 4


def test_a_failed_fit_is_never_chosen():
    choice = choose_weight(lambda weight: math.nan if weight > 0.3 else weight, 0.25, most=4)
    assert choice.weight < 0.25
