"""Coverage of the bootstrap's intervals of a normal population, by the number of specimens.

The estimate is that of the log-likelihood: mean and standard deviation of the specimens, in closed
form, so that thousands of data sets take seconds. The weights of `prb.bootstrap` are those of the
flat Dirichlet distribution; with ``parametric=True`` it draws data sets of the fitted population.

    uv run python -m benchmarks.bootstrap [--data-sets 3000]
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.study import Study

DRAWS = 1000
CELLS = [f"{kind}/{n}" for kind in ("weighted", "parametric") for n in (8, 20, 50)]


def row(cell: str, number: int) -> list[bool]:
    """Return whether 89 % intervals contain the mean and the standard deviation."""
    kind, n = cell.split("/")
    rng = np.random.default_rng([number, int(n)])
    x = rng.standard_normal(int(n))
    if kind == "weighted":
        weights = rng.dirichlet(np.ones(len(x)), DRAWS)
        means = weights @ x
        sds = np.sqrt(np.maximum(weights @ x**2 - means**2, 0.0))
    else:
        samples = rng.normal(x.mean(), x.std(), (DRAWS, len(x)))
        means, sds = samples.mean(axis=1), samples.std(axis=1)
    low, high = np.quantile([means, sds], [0.055, 0.945], axis=1)
    return [bool(a <= truth <= b) for a, truth, b in zip(low, (0.0, 1.0), high, strict=True)]


def summary(rows: list[Any]) -> dict[str, float]:
    """Return the coverage of the intervals."""
    mean, sd = np.mean(rows, axis=0).tolist()
    return {"data sets": len(rows), "mean": mean, "standard deviation": sd}


STUDY = Study("bootstrap", __doc__, CELLS, row, 3000, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
