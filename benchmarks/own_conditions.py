"""Coverage of intervals where each specimen has a load of its own.

A data set is a simulation-based calibration of 200 draws from the prior, with 24 specimens each, and
their loads. Rows are shares of true values in the interval of 89 %. *One output* is read exactly;
*four outputs* of two inputs have a known error.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.own_conditions
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.study import Study

CALIBRATIONS = 200
N, TIMES, ERROR = 24, np.array([0.5, 1.0, 2.0, 4.0]), 0.1


def one_output(x: Any, load: Any) -> Any:
    return np.exp(x) * load + 0.1 * load**2


def four_outputs(x: Any, z: Any, load: Any) -> Any:
    x, z, load = (np.asarray(v)[..., None] for v in (x, z, load))
    return load * np.exp(x - 0.2 * TIMES) + z * TIMES


def model_of(cell: str, rng: np.random.Generator) -> pm.Model:
    """Return the model of one data set."""
    loads = rng.uniform(0.5, 2.0, N)
    x, z = rng.normal(1.0, 0.2, N), rng.normal(0.0, 0.3, N)
    with pm.Model() as model:
        load = prb.response.condition("load", loads)
        first = pm.Normal.dist(pm.Normal("mean", 1, 0.3), pm.LogNormal("sd", np.log(0.2), 0.4))
        if cell == "one output":
            prb.Simulator("y", one_output, first, load, observed=one_output(x, loads))
            return model
        second = pm.Normal.dist(pm.Normal("mean_z", 0, 0.5), pm.LogNormal("sd_z", np.log(0.3), 0.3))
        observed = four_outputs(x, z, loads) + rng.normal(0, ERROR, (N, TIMES.size))
        metric = prb.LogLikelihood(error=ERROR)
        prb.Simulator("y", four_outputs, first, second, load, observed=observed, metric=metric)
    return model


def coverage(cell: str, number: int) -> dict[str, float]:
    """Return CPU seconds, and the share of true values in the interval of 89 %."""
    model = model_of(cell, np.random.default_rng(3 + number))
    start = time.process_time()
    ranks = prb.simulation_based_calibration(
        CALIBRATIONS, model=model, draws=500, progressbar=False
    )["prior_sbc"].to_dataset()
    row = {"cpu_seconds": time.process_time() - start}
    for name, values in ranks.data_vars.items():
        inside = (values > 0.055) & (values < 0.945)
        row[str(name)] = float(inside.mean())
    return row


STUDY = Study(
    "own_conditions",
    __doc__ or "",
    ("one output", "four outputs"),
    coverage,
    data_sets=1,
)

if __name__ == "__main__":
    STUDY.main()
