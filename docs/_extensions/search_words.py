"""Words that readers search for, with the pages that answer them, in the index of the search.

Sphinx ranks an entry of the index above a match in the text. Synonyms are entries, because a page
need not contain the reader's word.
"""

from docutils import nodes
from sphinx.addnodes import index
from sphinx.application import Sphinx
from sphinx.util import logging

WORDS = {
    "which_inputs": ["inverse uncertainty", "inverse uncertainty quantification", "how many runs"],
    "decision": ["scatter", "probability of failure", "reliability", "quantile", "sensitivity"],
    "runs": ["table", "table of runs", "csv", "excel", "existing runs", "design of experiments"],
    "data_sheet": ["data sheet", "summary statistics", "published values"],
    "my_data": ["csv", "excel", "units", "missing values", "ties", "decimal comma", "few data"],
    "definitions": ["formula", "formulas", "equation", "probability residual", "wasserstein"],
    "several_outputs": ["time series", "curve", "curves", "functional output", "multivariate"],
    "virkler": ["correlation", "correlated inputs"],
    "distributions": ["bounded", "bounded inputs", "truncated", "uniform", "limits of an input"],
    "measurement_error": ["noise", "measurement error", "repeated readings", "gauge"],
    "optimum_or_abc": ["mirror", "mirror solution", "two solutions", "multimodal"],
    "choosing_metric": ["robust", "outlier", "outliers", "contaminated"],
    "validity": ["validation", "goodness of fit", "model check"],
    "inadequacy": ["bias", "model discrepancy", "model error"],
    "finite_elements": ["ansys", "abaqus", "nastran", "calculix", "fem", "solver"],
    "expensive": ["emulator", "surrogate", "time-out", "crash", "nan"],
    "distributed": ["cluster", "parallel", "slurm", "dask", "hpc"],
    "groups": ["batch", "batches", "supplier", "suppliers", "random effects"],
    "likelihood": ["likelihood", "hierarchical", "mixed effects"],
    "pymc_and_arviz": ["nuts", "pm.sample", "inferencedata"],
    "peers": ["alternatives", "sbi", "pyabc", "openturns", "abc packages"],
    "quickstart": ["example", "tutorial", "first steps"],
    "gallery": ["plot", "plots", "figures", "pictures"],
}
logger = logging.getLogger(__name__)


def add(app: Sphinx, doctree: nodes.document) -> None:
    """Add the words of a page to its indexed entries."""
    words = WORDS.get(app.env.docname, [])
    entries = [("single", word, "", "main", None) for word in words]
    if entries:
        doctree.insert(0, index(entries=entries))


def check(app: Sphinx, env: object) -> None:
    """Warn of words for a page that does not exist."""
    for page in sorted(WORDS.keys() - app.env.found_docs):
        logger.warning("search_words.py names the page %r: got no such page", page)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect both functions to the build."""
    app.connect("doctree-read", add)
    app.connect("env-check-consistency", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
