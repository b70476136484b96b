"""A report in a few sentences: what was calibrated, the answer, whether it may be trusted."""

from __future__ import annotations

from typing import Any

import numpy as np

from prbayes.reports.material import Material, elements
from prbayes.reports.section import number, plus_minus
from prbayes.validation.validity import ValidityTest

_MOST = 6  # hyperparameters that the summary lists
_WORDS = {
    "ProbabilityResidual": "probability residual",
    "KullbackLeibler": "Kullback-Leibler divergence",
    "AreaMetric": "area metric",
    "LogLikelihood": "log-likelihood",
}


def summary(m: Material) -> list[str]:
    """Return the sentences, as paragraphs."""
    said = [_what(m), f"{_answer(m)} {_agreement(m)}", _trust(m)]
    return [s.strip() for s in (*said, *(verdict(label, t, m) for label, t in m.tests.items())) if s.strip()]


def counted(n: int, what: str) -> str:
    """Return a number with a noun."""
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def shown(seconds: float) -> str:
    """Return seconds, to a tenth below ten."""
    return f"{seconds:.1f}" if seconds < 9.95 else f"{seconds:.0f}"


def verdict(label: str, test: ValidityTest, m: Material) -> str:
    """Return what a test found, in one sentence."""
    n, of = test.u_values.size, int(np.unique(test.specimens).size)
    who = f"{label}: " if len(m.tests) > 1 else ""
    what = "the spread of the responses" if test.folded else "the responses"
    found = "is rejected" if test.rejected else "is not rejected"
    sign = ">" if test.statistic > test.critical_value else "≤"
    return (
        f"{who}On {what} of {counted(of, 'specimen')} ({counted(n, 'value')}), the calibrated model {found} at level "
        f"{100 * test.level:g}% (area {test.statistic:.3f} {sign} critical {test.critical_value:.3f}, "
        f"p = {test.p_value:.2g})."
    )


def _what(m: Material) -> str:
    names = m.hyperparameters
    if not names:
        return ""
    few = f" ({', '.join(names)})" if len(names) <= _MOST else ""
    data = [f"{counted(v.size, 'measured response')} of {name}" for name, v in m.observed.items()]
    on = f" on {_listed(data)}" if data else ""
    metrics = _metrics(m)
    by = f", by the {_listed(metrics)}" if metrics else ""
    if not m.results:
        return f"The model has {counted(len(names), 'hyperparameter')}{few}. No result of a calibration was given."
    return f"{counted(len(names), 'hyperparameter')}{few} of the model {_were(len(names))} calibrated{on}{by}."


def _were(n: int) -> str:
    return "was" if n == 1 else "were"


def _metrics(m: Material) -> list[str]:
    if m.description is not None:
        found = [str(s["metric"]) for s in m.description["simulators"]]
    else:
        trees = [tree["calibration"].to_dataset() for tree in m.results.values() if "calibration" in tree]
        found = [str(v) for tree in trees[:1] for v in tree["metric"].values.tolist()]
    return list(dict.fromkeys(_WORDS.get(called := name.partition("(")[0], called) for name in found))


def _listed(items: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(items[:-1]), items[-1]]))


def _answer(m: Material) -> str:
    """Return the estimates of the first posterior, or else of the first optimum."""
    if m.posteriors:
        label, tree = next(iter(m.posteriors.items()))
        draws = elements(tree["posterior"].to_dataset())
        found = {name: (float(v.mean()), float(v.std(ddof=1))) for name, v in draws.items()}
        what = "mean and standard deviation of the posterior"
    elif m.optima:
        label, tree = next(iter(m.optima.items()))
        points, errors = elements(tree["optimum"].to_dataset()), elements(tree["stderr"].to_dataset())
        found = {name: (float(v[0]), float(errors[name][0])) for name, v in points.items()}
        what = "optimum and standard error"
    else:
        return ""
    names = [n for n in found if n.split("[")[0] in m.hyperparameters]
    if not names or len(names) > _MOST:
        return f"The answer is in the table of the {'posterior' if m.posteriors else 'optimum'}."
    values = ", ".join(f"{name} = {plus_minus(*found[name])}" for name in names)
    several = len(m.posteriors or m.optima) > 1
    return f"The answer{f' of {label}' if several else ''} is {values} ({what})."


def _agreement(m: Material) -> str:
    """Return how far apart optimum and posterior are."""
    if m.comparison is None or m.comparison.sizes["result"] != 2:
        return ""
    shifts: Any = np.abs(m.comparison["shift"].values)
    names = m.comparison["result"].values.tolist()
    worst = float(np.nanmax(shifts)) if np.isfinite(shifts).any() else np.nan
    if not np.isfinite(worst):
        return ""
    return f"The estimates of {names[0]} and {names[1]} differ by at most {number(worst, 2)} standard deviations."


def _trust(m: Material) -> str:
    known = {label: d for label, d in m.diagnoses.items() if d is not None}
    if not known:
        return ""
    bad = {label: len(d.messages) for label, d in known.items() if not d.ok}
    if not bad:
        return "The diagnostics found no problem."
    problems = _listed([f"{counted(n, 'problem')} with {label}" for label, n in bad.items()])
    return f"The diagnostics found {problems}; see the section on diagnostics before the answer is used."
