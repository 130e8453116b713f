"""Settings of Sphinx: `make docs` builds the pages into docs/_build/html."""

import sys
from pathlib import Path
from typing import Any

from noiseflow.installation import library_version

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE / "tutorials")]

project = "noiseflow"
author = "The noiseflow developers"
copyright = f"2026, {author}"
version = release = library_version()

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "examples", "gallery/GALLERY_HEADER.rst", "gallery/generated/index.rst"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
suppress_warnings = [
    "myst.xref_missing",
    "myst.header",
    "sphinx_gallery.config",  # no back references
    "sphinx_gallery.duplicate_filename",  # the programs that an earlier build copied to gallery/generated
]

autosummary_generate = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_use_rtype = False
napoleon_use_ivar = True

# Pages only: the pictures are in docs/images, where `make gallery` draws them. Notebooks bring the shared functions with them.
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "gallery/generated",
    "ignore_pattern": r"(drawing|import_graph)\.py$",
    "plot_gallery": False,
    "within_subsection_order": "FileNameSortKey",
    "first_notebook_cell": "%%writefile drawing.py\n" + (HERE / "gallery" / "drawing.py").read_text(encoding="utf-8"),
    "notebook_images": True,
    "remove_config_comments": True,
    "show_signature": False,
    "write_computation_times": False,
}

smartquotes_action = "qe"  # without dashes: two hyphens begin an option

html_theme = "furo"
html_title = "noiseflow"
html_static_path = ["static"]
html_css_files = ["pages.css"]


def setup(app: Any) -> None:
    """Write the reference of the commands and the notebooks before each build."""
    import check_table
    import command_reference
    import notebooks
    import page_dates

    app.connect("config-inited", command_reference.write)
    app.connect("config-inited", check_table.write)
    app.connect("config-inited", notebooks.write_for_sphinx)
    app.connect("source-read", notebooks.link)
    app.connect("source-read", page_dates.add)
