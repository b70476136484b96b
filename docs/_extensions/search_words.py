"""Words that readers search for, with the pages that answer them, in the index of the search.

Sphinx ranks an entry of the index above a match in the text. Synonyms are entries, because a page
need not contain the reader's word.
"""

from docutils import nodes
from sphinx.addnodes import index
from sphinx.application import Sphinx
from sphinx.util import logging

WORDS = {  # by page, or page#heading
    "which_inputs": ["inverse uncertainty", "inverse uncertainty quantification", "how many runs"],
    "my_data": ["data", "my data", "csv", "excel", "decimal comma"],
    "my_data#units": ["unit", "units"],
    "my_data#missing-values": ["missing values", "nan", "nans"],
    "my_data#rounded-values-and-ties": ["ties", "rounded", "rounding"],
    "my_data#outliers": ["outlier", "outliers"],
    "my_data#limits-of-the-gauge": ["censored", "detection limit"],
    "my_data#few-specimens": ["few specimens", "small sample", "sample size"],
    "my_data#time-series-and-curves": ["time series"],
    "definitions": ["formula", "formulas", "equation", "probability residual", "wasserstein"],
    "decision": ["scatter", "probability of failure", "reliability", "quantile", "sensitivity"],
    "runs": ["table", "table of runs", "existing runs", "design of experiments"],
    "data_sheet": ["data sheet", "summary statistics", "published values"],
    "several_outputs": ["curve", "curves", "functional output", "multivariate"],
    "virkler": ["correlation", "correlated inputs"],
    "distributions": ["bounded", "bounded inputs", "truncated", "uniform", "limits of an input"],
    "measurement_error": ["noise", "measurement error", "repeated readings", "gauge"],
    "selection": ["selection", "truncated data", "proof test", "survivorship"],
    "counts": ["poisson", "binomial", "count data", "failures", "proportional error"],
    "optimum_or_abc": ["mirror", "mirror solution", "two solutions", "multimodal"],
    "choosing_metric": ["robust", "contaminated"],
    "validity": ["validation", "goodness of fit", "model check"],
    "inadequacy": ["bias", "model discrepancy", "model error"],
    "finite_elements": ["ansys", "abaqus", "nastran", "calculix", "fem", "solver"],
    "expensive": ["emulator", "surrogate", "time-out", "crash", "failed runs"],
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
    entries = [
        ("single", word, anchor, "main", None)
        for place, words in WORDS.items()
        for page, _, anchor in [place.partition("#")]
        for word in words
        if page == app.env.docname
    ]
    if entries:
        doctree.insert(0, index(entries=entries))


def check(app: Sphinx, env: object) -> None:
    """Warn of words for a page that does not exist."""
    for page in sorted({place.partition("#")[0] for place in WORDS} - app.env.found_docs):
        logger.warning("search_words.py names the page %r: got no such page", page)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect both functions to the build."""
    app.connect("doctree-read", add)
    app.connect("env-check-consistency", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
