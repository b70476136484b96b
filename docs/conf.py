"""Configuration of the documentation: `uv run --group docs sphinx-build -W docs docs/_build/html`."""

import prbayes

project = "prbayes"
author = "The prbayes developers"
copyright = "The prbayes developers, Apache-2.0"
release = version = prbayes.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "numpydoc",
    "myst_nb",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "inventories"]
html_theme = "furo"
html_title = "prbayes"
html_static_path = ["_static"]
html_css_files = ["prbayes.css"]

# Pages are notebooks: a page whose code fails stops the build. Results are kept, so that only changed pages run again.
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_timeout = 600
nb_merge_streams = True
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4

autosummary_generate = True
autodoc_typehints = "none"  # numpydoc's parameter sections say it
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"  # but these
numpydoc_xref_aliases = {name: f"prbayes.{name}" for name in prbayes.__all__} | {
    "Executor": "concurrent.futures.Executor",
    "array_like": "numpy.typing.ArrayLike",
    "bool": "bool",
    "sequence": "collections.abc.Sequence",
    "Sequence": "collections.abc.Sequence",
    "ndarray": "numpy.ndarray",
}
default_role = "py:obj"
nitpicky = True
nitpick_ignore_regex = [("py:obj", r"prbayes\.\w+\.\w+")]  # attributes are listed with their class

# Names of other projects that these pages refer to, in files kept here: the documentation builds without a network.
intersphinx_mapping = {
    name: (address, f"inventories/{name}.inv")
    for name, address in {
        "arviz": "https://python.arviz.org/",
        "numpy": "https://numpy.org/doc/stable/",
        "pymc": "https://www.pymc.io/projects/docs/en/stable/",
        "python": "https://docs.python.org/3/",
        "scipy": "https://docs.scipy.org/doc/scipy/",
        "xarray": "https://docs.xarray.dev/en/stable/",
    }.items()
}
