"""Pages of probcal: `uv run sphinx-build notebooks site` builds them into the folder `site`."""

from importlib import metadata

project, author, release = "probcal", "The probcal developers", metadata.version("probcal")
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = ["pictures"]
nb_execution_mode = "off"  # notebooks are committed with their outputs
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
html_theme, html_title = "furo", "probcal"
autodoc_typehints = "none"
default_role = "code"
autodoc_member_order = "bysource"
suppress_warnings = ["myst.xref_missing"]  # links to files of the repository beside these pages
