"""Settings of Sphinx: `make docs` builds the pages into docs/_build/html."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent / "tutorials")]

project = "noiseflow"
author = "The noiseflow developers"
copyright = f"2026, {author}"
version = release = installed_version("noiseflow")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["_build", "examples"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
suppress_warnings = ["myst.xref_missing", "myst.header"]

autosummary_generate = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_preserve_defaults = True
napoleon_use_rtype = False
napoleon_use_ivar = True

smartquotes_action = "qe"  # without dashes: two hyphens begin an option

html_theme = "furo"
html_title = "noiseflow"
html_static_path = ["static"]
html_css_files = ["pages.css"]


def setup(app: Any) -> None:
    """Write the reference of the commands and the notebooks before each build."""
    import command_reference
    import notebooks
    import page_dates

    app.connect("config-inited", command_reference.write)
    app.connect("config-inited", notebooks.write_for_sphinx)
    app.connect("source-read", notebooks.link)
    app.connect("source-read", page_dates.add)
