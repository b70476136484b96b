"""Configuration of the pages: the README says how to build them."""

import os
import sys
from inspect import isclass, ismodule
from pathlib import Path
from shutil import which

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

import prbayes

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))


def public_names() -> dict[str, str]:
    """Return where users find each public name, such as 'prbayes.response.Abort' of 'Abort'."""
    found = {}
    for name in prbayes.__all__:
        value = getattr(prbayes, name)
        if ismodule(value):
            found |= {inner: f"prbayes.{name}.{inner}" for inner in value.__all__}
        else:
            found[name] = f"prbayes.{name}"
    return found


PUBLIC = public_names()

project = "prbayes"
author = "The prbayes developers"
copyright = "The prbayes developers, Apache-2.0"
release = version = prbayes.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
    "numpydoc",
    "myst_nb",
    "sphinx_copybutton",
    "alt_texts",
    "notebooks",
    "offline_math",
    "search_words",
]
html_math_renderer = "mathml"
templates_path = ["_templates"]
exclude_patterns = ["_build", "_extensions", "inventories"]
html_theme = "furo"
html_title = "prbayes"
html_logo = html_favicon = "_static/logo.svg"
html_static_path = ["_static"]
html_css_files = ["prbayes.css"]
html_js_files = ["keyboard.js"]
html_copy_source = html_show_sourcelink = False
copybutton_selector = "div.highlight:not(.cell_output *) pre"
copybutton_exclude = ".linenos, .gp, .go"

# Pages run side by side, one on a processor: threads within one would wait for those of others.
for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

# Pages are notebooks: a page whose code fails stops the build. Results are kept, so that only
# changed pages run again.
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_timeout = 600
nb_merge_streams = True
# A page that runs a program which is not here is shown as it is written.
nb_execution_excludepatterns = [] if which("ccx") else ["finite_elements.md"]
myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4

autosummary_generate = True
autodoc_typehints = "none"  # numpydoc's parameter sections say it
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"  # but these
numpydoc_xref_aliases = PUBLIC | {
    "Executor": "concurrent.futures.Executor",
    "array_like": "numpy.typing.ArrayLike",
    "bool": "bool",
    "sequence": "collections.abc.Sequence",
    "Sequence": "collections.abc.Sequence",
    "ndarray": "numpy.ndarray",
}
default_role = "py:obj"
nitpicky = True
nitpick_ignore = [("py:obj", "matplotlib.pyplot.figure")]

# Names of other projects that these pages refer to, in files kept here: the documentation builds
# without a network.
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


def found_by_public_name(
    app: Sphinx, env: BuildEnvironment, reference: pending_xref, content: nodes.TextElement
) -> nodes.Node | None:
    """Resolve what a docstring of any module calls by its public name alone.

    That is a name such as `Affine`, an attribute such as `Optimum.design_error`, which is listed
    with its class, or one of the class whose docstring it is, such as `n_computed`.
    """
    if reference.get("refdomain") != "py":
        return None
    target = reference["reftarget"].removesuffix("()").removeprefix("prbayes.")
    parts = target.split(".")
    owner = next((part for part in parts if part in PUBLIC), None)
    if owner is None:
        owner = str(reference.get("py:class") or "").split(".")[-1]
        attributes = parts
    else:
        attributes = parts[parts.index(owner) + 1 :]
    if owner not in PUBLIC or len(attributes) > 1:
        return None
    if attributes and not has_attribute(owner, attributes[0]):
        return None
    python = env.get_domain("py")
    for full in (".".join([PUBLIC[owner], *attributes]), PUBLIC[owner]):
        found = python.resolve_xref(
            env, reference["refdoc"], app.builder, "obj", full, reference, content
        )
        if found is not None:
            return found
    return None


def has_attribute(owner: str, name: str) -> bool:
    """Whether a public class has a method, a property or a field of this name."""
    room, _, own = PUBLIC[owner].removeprefix("prbayes.").rpartition(".")
    value = getattr(getattr(prbayes, room) if room else prbayes, own)
    if not isclass(value):
        return False
    fields = set().union(*(vars(base).get("__annotations__", {}) for base in value.__mro__))
    return hasattr(value, name) or name in fields


def setup(app: Sphinx) -> None:
    """Attach what resolves bare names."""
    app.connect("missing-reference", found_by_public_name)
