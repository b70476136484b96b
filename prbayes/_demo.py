"""The crack growth case from end to end, on data that ship: calibration, validity on fresh specimens, report."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes import datasets
from prbayes._predict import predict
from prbayes.estimate.minimization import minimize
from prbayes.metrics.residual import ProbabilityResidual
from prbayes.model.simulator import Simulator
from prbayes.posterior.smc import sample_smc
from prbayes.reports.report import Report
from prbayes.validation.validity import area_test

_log = logging.getLogger("prbayes")
EXPONENT = 2.6
CALIBRATED_AT, TESTED_AT = 0.05, 0.08  # million cycles


def relative_length(million_cycles: float) -> Callable[[Any, Any], Any]:
    """Return the response after so many load cycles: crack length over notch length."""

    def growth(C: Any, m: Any) -> Any:  # noqa: N803 (Paris' coefficient)
        left = 1 - (m - 1) * C * million_cycles
        return np.where(left > 0, np.maximum(left, 1e-12) ** (-1 / (m - 1)), np.inf)

    return growth


def run_demo(folder: Path, *, draws: int = 1000, chains: int = 4, seed: int = 1) -> list[Path]:
    """Calibrate on eleven specimens, test on the other ten, write results and a report; return what was written.

    Files are ``results.nc``, ``optimum.nc``, ``validity.nc`` and ``report.html``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = datasets.crack_growth()
    lengths = data.crack_length_inch / data.notch_inch
    labels = data.specimen.values
    order = np.random.default_rng(0).permutation(labels.size)
    used, fresh = np.sort(order[:11]), np.sort(order[11:])
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.1, 0.5)
        sigma = pm.HalfNormal("sigma", 0.5)
        C = pm.LogNormal.dist(mu, sigma)  # noqa: N806
        observed = lengths.sel(million_cycles=CALIBRATED_AT).values[used]
        response = relative_length(CALIBRATED_AT)
        metric = ProbabilityResidual()
        Simulator("crack", response, C, EXPONENT, metric=metric, observed=observed, specimens=labels[used])
    _log.info("looking for the optimum on %d specimens", used.size)
    optimum = minimize(model)
    _log.info("sampling")
    posterior = sample_smc(
        draws,
        chains=chains,
        model=model,
        optimum=optimum,
        random_seed=seed,
        progressbar=_log.isEnabledFor(logging.INFO),
    )
    _log.info("predicting the crack lengths of the other %d specimens", fresh.size)
    later = predict(posterior, relative_length(TESTED_AT), C, EXPONENT, model=model, random_seed=seed)
    measured = lengths.sel(million_cycles=TESTED_AT).values[fresh]
    test = area_test(np.where(np.isnan(measured), np.inf, measured), later, specimens=labels[fresh])
    _log.info("writing the report")
    report = Report(
        "Crack growth: Paris' coefficient of 11 specimens",
        model=model,
        optimum=optimum,
        posterior=posterior,
        validity=test,
    )
    trees: dict[str, xr.DataTree | xr.Dataset] = {
        "results.nc": posterior,
        "optimum.nc": optimum.to_datatree(),
        "validity.nc": test.to_dataset(),
    }
    for name, tree in trees.items():
        tree.to_netcdf(folder / name, engine="h5netcdf")
    return [*(folder / name for name in trees), report.to_html(folder / "report.html")]
