"""How far a volume or projection is from its reference.

How a composition works: `metrics` compares arrays, section by section; `comparison` applies it to volumes, their projections and
their orientation, and draws the page.
"""
