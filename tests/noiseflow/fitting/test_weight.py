"""The search for the weight of least held-out likelihood."""

import math

import pytest

from noiseflow.fitting.weight import choose_weight


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


def test_a_dent_of_a_flat_curve_does_not_end_the_ladder():
    curve = {0.2: 3.911, 0.4: 3.9087, 0.8: 3.9093, 1.6: 3.905, 3.2: 3.895, 6.4: 3.88, 12.8: 3.90}
    rounded = {round(weight, 3): nll for weight, nll in curve.items()}
    known = choose_weight(lambda weight: rounded.get(round(weight, 3), 3.92), 0.4)
    assert known.weight < 0.8
    found = choose_weight(
        lambda weight: rounded.get(round(weight, 3), 3.92),
        0.4,
        alike=lambda weight, best: rounded.get(round(weight, 3), 3.92) - rounded.get(round(best, 3), 3.92) < 1e-3,
    )
    assert 4.5 < found.weight < 9


def test_both_sides_of_the_best_weight_are_tried_before_the_ladder_goes_over_a_dent():
    choice = choose_weight(lambda weight: math.log(weight / 0.2) ** 2, 0.4, most=4, alike=lambda weight, best: True)
    assert choice.weight == pytest.approx(0.2, rel=1e-6)
