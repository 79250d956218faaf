"""Configuration of Sphinx: `make docs` builds docs/_build/html, without a network."""

import sys
from pathlib import Path

import jax

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

import jaxsky  # noqa: E402

jax.config.update("jax_enable_x64", True)

project = "jaxsky"
author = copyright = "the jaxsky developers"
release = version = jaxsky.__version__
html_title = f"jaxsky {version}"
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "myst_nb",
    "sphinx_copybutton",
    "mathtext",
    "generated",
]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
nb_execution_mode = "cache"  # notebooks run once, and again when they change
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_output_stderr = "remove"
exclude_patterns = ["_build", "generated/cache", ".gitignore"]
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["plain.css"]
html_math_renderer = "mathtext"
pygments_style = "default"
napoleon_google_docstring = False
napoleon_use_param = False  # types of arguments are prose, not references
napoleon_use_rtype = False
napoleon_use_ivar = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
default_role = "code"
