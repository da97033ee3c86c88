"""Settings of the documentation: `make docs` builds it with Sphinx."""

import importlib.metadata

project = "nnit"
author = "the nnit authors"
release = importlib.metadata.version("nnit")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"nnit {release}"
default_role = "code"  # docstrings are Markdown: `name` is code
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_class_signature = "separated"
myst_heading_anchors = 3
