"""What tilts that were not taken leave behind: a slice and its Fourier transform, for three tilt ranges."""

import numpy as np
from drawing import main, new_figure, show

import recon
from recon.simulate.phantoms import make_phantom


def draw():
    """Back-project clean images of ±90°, ±60° and ±40°."""
    truth = make_phantom("shells", 64, generator=np.random.default_rng(3))
    figure, axes = new_figure(3, 2, width=11, height=3.5)
    for column, limit in enumerate((90, 60, 40)):
        series, _ = recon.clean_tilt_series(truth, np.arange(-limit, limit, 2.0))
        grid = recon.VolumeGrid.of(series, 64)
        piece = recon.reconstruct(series, grid, method="wbp", window="hann").volume.attenuation[:, 32]
        power = np.log10(np.abs(np.fft.fftshift(np.fft.fft2(piece))) + 1e-3)
        show(axes[0, column], piece, f"tilts ±{limit}°, slice (z, x)", bar=(16, "16 voxels"), unit="attenuation")
        bar = (16, "0.25 / voxel")
        show(axes[1, column], power, "its Fourier transform", bar=bar, unit="log₁₀ amplitude", cmap="viridis", vmin=-2)
    return figure


if __name__ == "__main__":
    main(draw)
