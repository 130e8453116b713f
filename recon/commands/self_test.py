"""A quick self-test of projection and reconstruction for `noiseflow doctor`."""


def check_projection() -> str | None:
    """Project a small ball, check the adjoint, and reconstruct the ball. Return the problem, or None."""
    import numpy as np
    import torch

    from recon.projection.classical import sirt
    from recon.projection.projector import SliceProjector

    size = 32
    grid = torch.linspace(-1, 1, size)
    z, y, x = torch.meshgrid(grid, grid, grid, indexing="ij")
    ball = (x**2 + y**2 + z**2 < 0.5).float()
    projector = SliceProjector(tilt_angles=np.arange(-60.0, 61.0, 5.0), depth=size, width=size)
    projections = projector(ball)
    probe = torch.rand(projections.shape, generator=torch.Generator().manual_seed(0))
    forward, back = float((projections * probe).sum()), float((ball * projector.T(probe)).sum())
    if abs(forward - back) > 1e-4 * abs(forward):
        return f"the projector and its adjoint disagree: {forward:.6g} and {back:.6g}"
    error = float((sirt(projections, projector, num_iterations=20) - ball).square().mean() / ball.square().mean())
    return None if error < 0.3 else f"the reconstruction of a ball has a relative error of {error:.2f}"
