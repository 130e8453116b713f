"""The HTML report of a reconstruction.

How a composition works: each part of the page is a function that adds to a `noiseflow.report.Report`; a `Guard` calls it, so that
a part that fails is named and the others are shown.
"""
