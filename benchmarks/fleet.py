"""Fleets: 1000 products from one set of runs, with the coverage of their intervals.

A data set is a fleet whose hyperparameters are draws of their prior. Each product has twenty
measured specimens, and ten further ones for its validity test. The cells differ in the number of
inputs and outputs, and whether the products are tested.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.fleet [--cells "two inputs"]
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.study import Study
from prbayes.model.specimen_likelihood import measurements_of

PRODUCTS, SPECIMENS, FURTHER = 1000, 20, 10
CELLS = ("one input, posteriors alone", "one input", "two inputs, two outputs")


def growth(x: Any) -> Any:
    return np.exp(0.5 * x)


def two_outputs(x: Any, z: Any) -> Any:
    return np.stack([np.exp(0.5 * x) + 0.3 * z, x * (1 + 0.2 * z) + z], axis=-1)


def model_of(n_inputs: int, observed: Any) -> pm.Model:
    """Return the model of one product."""
    with pm.Model() as model:
        inputs = [
            pm.Normal.dist(
                pm.Normal(f"mean_{i}", 1, 0.4), pm.LogNormal(f"spread_{i}", np.log(0.2), 0.3)
            )
            for i in range(n_inputs)
        ]
        response = growth if n_inputs == 1 else two_outputs
        prb.Simulator("y", response, *inputs, observed=observed, progressbar=False)
    return model


def fleet(cell: str, number: int) -> dict[str, Any]:
    """Return CPU seconds, runs, coverage of 89 % intervals, and the share of rejected products."""
    rng = np.random.default_rng(number)
    n_inputs = 1 if cell.startswith("one") else 2
    mean = rng.normal(1, 0.4, (PRODUCTS, n_inputs))
    spread = 0.2 * np.exp(rng.normal(0, 0.3, (PRODUCTS, n_inputs)))
    size = SPECIMENS + FURTHER
    x = rng.normal(mean[:, None], spread[:, None], (PRODUCTS, size, n_inputs))
    y = growth(x[..., 0]) if n_inputs == 1 else two_outputs(x[..., 0], x[..., 1])
    data = {f"{k}": values[:SPECIMENS] for k, values in enumerate(y)}
    further = {f"{k}": values[SPECIMENS:] for k, values in enumerate(y)}
    model = model_of(n_inputs, data["0"])
    start = time.process_time()
    tree = prb.calibrate_each(
        data,
        model=model,
        validation=None if cell.endswith("alone") else further,
        progressbar=False,
    )
    row: dict[str, Any] = {"cpu_seconds": time.process_time() - start}
    runs = [m.responses.count for m in measurements_of(model).values()]
    row["runs"] = sum(runs)
    for i in range(n_inputs):
        for name, truth in ((f"mean_{i}", mean[:, i]), (f"spread_{i}", spread[:, i])):
            draws = tree["posterior"].to_dataset()[name].values[0]
            low, high = np.quantile(draws, [0.055, 0.945], axis=0)
            row[name] = float(np.mean((low <= truth) & (truth <= high)))
    products = tree["products"].to_dataset()
    if "rejected" in products:
        row["rejected"] = float(products["rejected"].mean())
    row["findings"] = int((products["finding"] != "").sum())
    return row


STUDY = Study(
    "fleet",
    __doc__ or "",
    CELLS,
    fleet,
    data_sets=1,
)

if __name__ == "__main__":
    STUDY.main()
