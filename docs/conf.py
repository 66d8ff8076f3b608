"""Sphinx reads this: `make docs` builds the site into docs/_build."""

import re
import shutil
from pathlib import Path

import sb3_sap

project = "sb3_sap"
author = "The sb3_sap authors"
copyright = author
release = version = sb3_sap.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
# The pages of results are reached from results/README.md.
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


def copy_results(app) -> None:  # type: ignore[no-untyped-def]
    """Copies results/ to docs/results/, because Sphinx reads pages of its own folder only."""
    copy = Path(app.srcdir) / "results"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(copy.parent.parent / "results", copy, ignore=shutil.ignore_patterns("runs", "*.xz"))


def follow_results(app, docname, source) -> None:  # type: ignore[no-untyped-def]
    """Redirects links between docs/ and results/, which lie side by side in the repository, to the copy."""
    if docname.startswith("results/"):
        source[0] = re.sub(r"(\]\((?:\.\./)+)docs/", r"\1", source[0])
    else:
        source[0] = re.sub(r"(\]\((?:\.\./)*)\.\./results/", r"\1results/", source[0])


def setup(app) -> None:  # type: ignore[no-untyped-def]
    app.connect("autodoc-process-docstring", escape)
    app.connect("builder-inited", copy_results)
    app.connect("source-read", follow_results)
