"""The crack growth case from end to end, on data that ship.

Calibration, validity on specimens that were not used for it, report.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes import datasets
from prbayes._validate import Floats
from prbayes.metrics.residual import ProbabilityResidual
from prbayes.model.simulator import Simulator
from prbayes.optimize.minimize import minimize
from prbayes.posterior.smc import sample_smc
from prbayes.reports.report import Report
from prbayes.results.predict import predict
from prbayes.validation.area_test import ValidityTest, area_test

_log = logging.getLogger("prbayes")

# Paris' exponent, held at one value for all specimens, as in examples/crack_growth.py.
EXPONENT = 2.6
# Million cycles: the last reading before cracks fail is at 0.08, so that all are known at both, and
# the test is one of extrapolation.
CALIBRATED_AT, TESTED_AT = 0.05, 0.08
CONDITION = "80 000 cycles"

# What a reader of the report calls what is in it.
LABELS = {
    "mu": "mean of log C",
    "sigma": "standard deviation of log C",
    "C": "Paris' coefficient C",
    "crack": "crack length / notch length, 50 000 cycles",
    CONDITION: "crack length / notch length, 80 000 cycles",
}


def relative_length(million_cycles: float) -> Callable[[Any, Any], Any]:
    """Return the response after so many load cycles: crack length over notch length."""

    def growth(C: Any, m: Any) -> Any:  # noqa: N803 (Paris' coefficient)
        left = 1 - (m - 1) * C * million_cycles
        # Where that is used the crack is infinite; any small value keeps NumPy from a warning.
        length = np.maximum(left, 1e-12) ** (-1 / (m - 1))
        return np.where(left > 0, length, np.inf)

    return growth


def run_demo(folder: Path, *, draws: int = 1000, chains: int = 4, seed: int = 1) -> list[Path]:
    """Calibrate on eleven specimens, test on the other ten, write results and a report.

    The paths of what was written are returned: ``results.nc``, ``optimum.nc``, ``validity.nc`` and
    ``report.html``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    used, fresh = _specimens()
    model, C = _model(used)  # noqa: N806
    _log.info("looking for the optimum on %d specimens", used.labels.size)
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
    _log.info("predicting the crack lengths of the other %d specimens", fresh.labels.size)
    response = relative_length(TESTED_AT)
    later = predict(posterior, response, C, EXPONENT, model=model, random_seed=seed)
    test = _tested(fresh, later)
    _log.info("writing the report")
    report = Report(
        "Crack growth: Paris' coefficient of 11 specimens",
        model=model,
        optimum=optimum,
        posterior=posterior,
        validity=test,
        validation={CONDITION: (_measured(fresh), later)},
        labels=LABELS,
    )
    trees: dict[str, xr.DataTree | xr.Dataset] = {
        "results.nc": posterior,
        "optimum.nc": optimum.to_datatree(),
        "validity.nc": test.to_dataset(),
    }
    for name, tree in trees.items():
        tree.to_netcdf(folder / name, engine="h5netcdf")
    return [*(folder / name for name in trees), report.to_html(folder / "report.html")]


@dataclass(frozen=True, eq=False)
class _Specimens:
    """Some of the specimens: labels, and crack lengths over notch lengths by million cycles."""

    labels: Any
    lengths: xr.DataArray

    def at(self, million_cycles: float) -> Floats:
        return np.asarray(self.lengths.sel(million_cycles=million_cycles).values)


def _specimens() -> tuple[_Specimens, _Specimens]:
    """Return those for the calibration, and the others."""
    data = datasets.crack_growth()
    lengths = data.crack_length_inch / data.notch_inch
    order = np.random.default_rng(0).permutation(data.specimen.size)
    # About half of the 21 are for the calibration.
    used = np.sort(order[:11])
    fresh = np.sort(order[11:])
    parts = [
        _Specimens(data.specimen.values[some], lengths.isel(specimen=some))
        for some in (used, fresh)
    ]
    return parts[0], parts[1]


def _model(used: _Specimens) -> tuple[pm.Model, Any]:
    """Return the model and its aleatory input."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.1, 0.5)
        sigma = pm.HalfNormal("sigma", 0.5)
        C = pm.LogNormal.dist(mu, sigma)  # noqa: N806
        Simulator(
            "crack",
            relative_length(CALIBRATED_AT),
            C,
            EXPONENT,
            metric=ProbabilityResidual(),
            observed=used.at(CALIBRATED_AT),
            specimens=used.labels,
        )
    return model, C


def _tested(fresh: _Specimens, predicted: Any) -> ValidityTest:
    return area_test(_measured(fresh), predicted, specimens=fresh.labels)


def _measured(fresh: _Specimens) -> Floats:
    """Return the lengths of the test; without one a specimen has failed: it is longer than all."""
    lengths = fresh.at(TESTED_AT)
    return np.where(np.isnan(lengths), np.inf, lengths)
