"""Tilt series: reading, alignment, screening and checks.

How a composition works: `read_tilt_series` joins images, angles and masks to a `TiltSeries`; `prepare` checks its contrast,
aligns it, sorts and screens its tilts, and joins a second axis. Each step takes a series and returns another; `Prepared` holds
the last one, with what every step found.
"""
