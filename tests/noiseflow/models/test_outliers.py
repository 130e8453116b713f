"""The Gaussian with outliers of one frequency and size at all signals."""

import numpy as np
import pytest
import torch
from scipy import stats

import noiseflow


@pytest.mark.parametrize("side", [1, -1], ids=["above", "below"])
def test_outliers_that_add_to_any_signal_are_described_where_signals_are_few(side: int) -> None:
    """Within 0.004 nats per pixel of the truth; a shape that grows with the noise is five times as far."""
    random = np.random.default_rng(0)
    signal = random.gamma(0.7, 30, 30_000).clip(0, 150)
    width, hit = np.sqrt(1 + signal), random.random(signal.size) < 0.02
    observation = signal + width * random.normal(size=signal.size) + side * hit * random.exponential(30, signal.size)
    log_prob = np.logaddexp(
        np.log(0.98) + stats.norm.logpdf(observation, signal, width),
        np.log(0.02) + stats.exponnorm.logpdf(side * (observation - signal), 30 / width, 0, width),
    )
    model = noiseflow.GaussianWithOutliers(mean_preserving=True)
    noiseflow.fit(model, *(torch.from_numpy(each).float() for each in (signal, observation - side * 0.6)))
    with torch.no_grad():
        known = model(torch.from_numpy(signal)).log_prob(torch.from_numpy(observation - side * 0.6))
    assert np.mean(log_prob) - float(known.mean()) == pytest.approx(0, abs=0.004)
    with torch.no_grad():
        bright = model(torch.tensor([20.0, 140.0]))
    torch.testing.assert_close(bright.mean, torch.tensor([20.0, 140.0]), atol=1e-3, rtol=0)
    assert 0.3 < float(bright.variance.diff()[0]) / 120 < 3  # shot noise alone grows


def test_one_component_leaves_none_for_outliers() -> None:
    with pytest.raises(ValueError, match="SignalDependentGaussian"):
        noiseflow.GaussianWithOutliers(1)
