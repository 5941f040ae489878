"""The site: `.venv/bin/sphinx-build docs out/site`, after `sh install.sh --docs`.

Sphinx, MyST and Furo are kept by many: Furo dresses the guides of Python, pip, attrs and Black. Pages are Markdown that any
reader of Markdown shows; `pages.py` adds what only a site can show. Nothing is loaded from the network.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # else JAX tells of the others
sys.path[:0] = [str(HERE), str(HERE.parent)]

project = "udkjax"
html_title = "udkjax"
author = "The udkjax authors"
extensions = ["myst_parser", "pages"]
exclude_patterns = ["**/*.html"]
myst_enable_extensions = ["dollarmath", "attrs_inline", "attrs_block"]
myst_heading_anchors = 3
# `page:` stands before links to pages that are not made from Markdown, such as players.
myst_url_schemes = {"http": None, "https": None, "mailto": None, "page": "{{path}}"}
smartquotes = False
html_math_renderer = "mathml"
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = html_show_sourcelink = html_show_copyright = html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5f8a", "color-brand-content": "#0b5f8a"},
    "dark_css_variables": {"color-brand-primary": "#7cc4ee", "color-brand-content": "#7cc4ee"},
}
