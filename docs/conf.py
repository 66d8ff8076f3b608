"""Sphinx reads this: `make docs` builds the site into docs/_build."""

import re

import sb3_sap

project = "sb3_sap"
author = "The sb3_sap authors"
copyright = author
release = version = sb3_sap.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
# The pages of results are written by commands and reached from docs/results/README.md.
suppress_warnings = ["toc.not_included"]
default_role = "code"  # single backticks in docstrings are code, as in Markdown

# Links such as (method.md#what-is-logged).
myst_heading_anchors = 3
# The checklist of CONTRIBUTING.md.
myst_enable_extensions = ["tasklist"]

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_default_options = {"show-inheritance": True}

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_title = f"sb3_sap {release}"
pygments_style = "friendly"


def escape(app, what, name, obj, options, lines) -> None:  # type: ignore[no-untyped-def]
    """Docstrings are written to be read as they stand, with shapes as (n, *obs_shape), magnitudes as |trackPos|."""
    lines[:] = [re.sub(r"(?<=[ (])\*(?=\w+_shape)|\|", r"\\\g<0>", line) for line in lines]


def setup(app) -> None:  # type: ignore[no-untyped-def]
    app.connect("autodoc-process-docstring", escape)
