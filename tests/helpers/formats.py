"""Files of each kind that prbayes writes, from a small problem.

`tests/formats` has such files of released versions; `tests/test_formats.py` reads them. A folder of a
new version, which is never changed afterwards:

    OMP_NUM_THREADS=1 uv run python tests/helpers/formats.py tests/formats/1.0
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb

FOLDER = Path(__file__).parents[1] / "formats"
NEW = (1.4, 2.2, 2.7, 1.6)  # specimens of the validity test
OBSERVED = (1.2, 2.9, 2.1, 1.7, 2.4, 1.5, 2.2, 1.9, 2.6, 1.8)
SAMPLED = {"draws": 40, "chains": 2, "random_seed": 3, "progressbar": False}


def square(x: Any) -> Any:
    """Return the response of the problem."""
    return 1 + x**2 / 4


def model_of(response: Callable[[Any], Any], folder: Path) -> pm.Model:
    """Return the model, whose responses are stored in a folder."""
    metric = prb.ProbabilityResidual()
    stored = prb.Reweighted(64, store=folder / "store", version="1")
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 2, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator("y", response, x, metric=metric, observed=OBSERVED, propagation=stored)
    return model


def sampled(model: pm.Model, folder: Path) -> Any:
    """Return draws of a run with a checkpoint in a folder."""
    return prb.sample_smc(model=model, checkpoint=folder / "run.nc", **SAMPLED)


def write(folder: Path) -> None:
    """Write a file of each kind, and the numbers that a reader should find."""
    folder.mkdir(parents=True)
    model = model_of(square, folder)
    optimum = prb.minimize(model, progressbar=False)
    optimum.to_datatree().to_netcdf(folder / "optimum.nc")
    posterior = sampled(model, folder)
    posterior.to_netcdf(folder / "posterior.nc")
    x = pm.Normal.dist(model["mu"], model["sigma"])
    predicted = prb.predict(posterior, square, x, model=model, n_samples=20, n_draws=20)
    predicted.to_netcdf(folder / "prediction.nc")
    test = prb.area_test(NEW, predicted, random_seed=5, progressbar=False)
    test.to_dataset().to_netcdf(folder / "validity.nc")
    beyond = prb.exceedance(posterior, square, 3, x, model=model, n_draws=20, n_points=200)
    beyond.to_netcdf(folder / "exceedance.nc")
    surrogate = prb.Surrogate.fit(square, {"x": (0, 4)}, 16, progressbar=False)
    surrogate.save(folder / "surrogate.nc")
    (folder / "run.nc.lock").unlink(missing_ok=True)
    numbers = {
        "version": prb.__version__,
        "optimum": {name: float(optimum.point[name]) for name in ("mu", "sigma")},
        "posterior": {name: float(posterior.posterior[name].mean()) for name in ("mu", "sigma")},
        "statistic": float(test.statistic),
        "surrogate": float(surrogate(np.array([1.5]))[0]),
    }
    (folder / "numbers.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
