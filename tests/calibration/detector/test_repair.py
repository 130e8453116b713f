"""Repairs of exposures, whatever the mask leaves."""

import numpy as np
import pytest

from calibration.detector.repair import _shared


def test_offsets_of_rows_are_found_where_the_mask_cuts_half_of_some():
    generator = np.random.default_rng(0)
    z = generator.standard_normal((128, 128)) + 0.5 * generator.standard_normal((128, 1))
    mask = np.ones(z.shape, bool)
    mask[:7, 10:] = False  # one run of 16 left in these rows, so that only the even part has a mean
    mask[90:94, :16] = mask[90:94, 26:] = False
    deviation, error = _shared(z, mask, 1)
    assert deviation == pytest.approx(0.5, rel=0.2)
    assert error < 0.1
