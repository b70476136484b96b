"""Small groups beside the exact posterior: three suppliers of ten specimens, or of five.

Responses are 2 x + 1 of normal inputs, with a mean of each supplier and one standard deviation of
all, and wide priors, so that no group learns its mean from another. For each data set `minimize`
and `sample_smc` on one model of all groups, by each metric, and the exact posterior, whose means
are integrated in closed form and the spread on a grid. How far means of draws are from exact ones,
in exact standard deviations, and ratios of standard deviations; how often 89% intervals of both
hold the truth. The command goes on after the data sets whose rows its file has.

    uv run python -m benchmarks.small_groups [--data-sets 40]
"""

from __future__ import annotations

import argparse
import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record, suppliers
from prbayes._validate import Floats

OUT = record.RESULTS / "small_groups.json"
METRICS = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "log-likelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
}
SIZES = (10, 5)
MEANS = np.array([1.0, 1.3, 0.8])
SIGMA = 0.4
# Standard deviations of the priors of means, around zero, and of the spread.
PRIORS = (2.0, 1.0)
_TAILS = (0.055, 0.945)


def line(x: Any) -> Any:
    return 2 * x + 1


def model_of(observed: Any, metric: prb.Metric) -> pm.Model:
    """Return the model of all suppliers."""
    names = suppliers.NAMES[: len(MEANS)]
    with pm.Model(coords={"supplier": names}) as model:
        mu = pm.Normal("mu", 0, PRIORS[0], dims="supplier")
        sigma = pm.HalfNormal("sigma", PRIORS[1])
        x = pm.Normal.dist(mu[prb.response.group("supplier")], sigma, name="x")
        prb.Simulator("y", line, x, metric=metric, observed=observed, progressbar=False)
    return model


def exact(x: Floats, rng: np.random.Generator) -> Floats:
    """Return draws of the posterior given inputs, (suppliers, specimens): (n, suppliers + 1)."""
    groups, n = x.shape
    sigma = np.linspace(0.05, 3.0, 6000)
    variance = sigma[:, None] ** 2 / n
    total = variance + PRIORS[0] ** 2
    squares = ((x - x.mean(axis=1, keepdims=True)) ** 2).sum()
    log = -groups * (n - 1) * np.log(sigma) - squares / (2 * sigma**2)
    log -= 0.5 * (np.log(total) + x.mean(axis=1) ** 2 / total).sum(axis=1)
    log -= 0.5 * (sigma / PRIORS[1]) ** 2
    weight = np.exp(log - log.max())
    drawn = rng.choice(sigma, 20_000, p=weight / weight.sum())
    precision = n / drawn[:, None] ** 2 + 1 / PRIORS[0] ** 2
    center = n / drawn[:, None] ** 2 * x.mean(axis=1) / precision
    means = rng.normal(center, 1 / np.sqrt(precision))
    return np.column_stack([means, drawn])


def one(seed: int, size: int, name: str) -> dict[str, Any]:
    """Return errors and ratios of one data set: of each mean, and of the spread last."""
    rng = np.random.default_rng([seed, size])
    x = rng.normal(MEANS[:, None], SIGMA, (len(MEANS), size))
    names = np.repeat(suppliers.NAMES[: len(MEANS)], size)
    clock = time.process_time()
    model = model_of(suppliers.labelled(line(x).ravel(), names), METRICS[name])
    optimum = prb.minimize(model, progressbar=False)
    posterior = prb.sample_smc(
        1000, chains=2, model=model, optimum=optimum, random_seed=seed, progressbar=False
    ).posterior
    seconds = time.process_time() - clock
    draws = np.column_stack(
        [posterior["mu"].values.reshape(-1, len(MEANS)), posterior["sigma"].values.ravel()]
    )
    truth = np.append(MEANS, SIGMA)
    known = exact(x, rng)
    row: dict[str, Any] = {"seed": seed, "size": size, "metric": name, "seconds": seconds}
    row["shift"] = ((draws.mean(axis=0) - known.mean(axis=0)) / known.std(axis=0)).tolist()
    row["ratio"] = (draws.std(axis=0) / known.std(axis=0)).tolist()
    for label, found in (("held", draws), ("exact held", known)):
        low, high = np.quantile(found, _TAILS, axis=0)
        row[label] = ((low <= truth) & (truth <= high)).tolist()
    return row


def main() -> None:
    """Compute, print and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data-sets", type=int, default=40)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    rows: list[dict[str, Any]] = record.load(arguments.out, {}).get("rows", [])
    done = {(row["seed"], row["size"], row["metric"]) for row in rows}
    for seed in range(arguments.data_sets):
        for size in SIZES:
            for name in METRICS:
                if (seed, size, name) not in done:
                    rows.append(one(seed, size, name))
        record.save(arguments.out, {"table": summary(rows), "rows": rows})
        print(seed + 1, flush=True)
    for cell in summary(rows):
        print(cell)


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a cell for each size and metric: of the means together, and of the spread."""
    cells = []
    for size in SIZES:
        for name in METRICS:
            own = [row for row in rows if (row["size"], row["metric"]) == (size, name)]
            if not own:
                continue
            cell: dict[str, Any] = {"size": size, "metric": name, "data sets": len(own)}
            cell["seconds"] = float(np.median([row["seconds"] for row in own]))
            for label, part in (("mu", slice(0, -1)), ("sigma", slice(-1, None))):
                for key in ("shift", "ratio", "held", "exact held"):
                    values = np.array([row[key] for row in own], dtype=float)[:, part]
                    cell[f"{label} {key}"] = float(values.mean())
                    if key == "shift":
                        cell[f"{label} off"] = float(np.sqrt((values**2).mean()))
            cells.append(cell)
    return cells


if __name__ == "__main__":
    main()
