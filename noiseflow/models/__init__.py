"""Noise models, one file each.

How a composition works: ``model(signal)`` returns a `NoiseDistribution`. A wrapper (`Digitised`, `AtLevel`, `WithMaps`,
`ScanNoise`) is a model that holds a model: it passes the signal on, wraps the distribution that comes back, and forwards every
trait that it does not change. ``Digitised(AtLevel(PoissonGaussian()))`` therefore fits, saves and samples like any model.
"""
