"""How Sphinx builds these pages: `make docs`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

from sb3_hds import __version__

project = "sb3_hds"
author = "sb3_hds contributors"
copyright = "sb3_hds contributors, MIT licence"
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "generated_parts",
    "offline_math",
]
exclude_patterns = ["_build", "modules/_*.md"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autosummary_generate = False  # the tables link to what the pages describe

autoclass_content = "both"  # arguments are documented where they are declared, by the constructor
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
maximum_signature_line_length = 88
python_use_unqualified_type_names = True

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"sb3_hds {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
