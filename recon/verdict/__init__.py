"""Automatic assessment of a reconstruction: evidence from the images, and a grade with reasons.

How a composition works: a `Case` is a reconstruction with evidence that is computed once, by the first check that needs it
(residuals, distortions, gaps of tilts that the others predict). `table` lists the checks, one row each; `judge` runs them with
`noiseflow.checks` and returns a `Verdict`.
"""
