"""Two crack lengths of the same specimens are not the lengths of twice as many specimens.

Lengths after 50 000 and 80 000 cycles calibrate one population, once as if all were independent and
once with specimen labels: standard errors, posterior and bootstrap with and without them.

Run: uv run python examples/specimen_labels.py
"""

import numpy as np
import pymc as pm
from crack_growth import EXPONENT, growth
from scipy.stats import spearmanr

import prbayes as prb


def later(C, m):
    """Crack length relative to the notch after 80 000 cycles."""
    return growth(C, m, 0.08)


def main():
    """Calibrate with and without labels; print standard deviations of the mean and sd of log C."""
    data = prb.datasets.crack_growth()
    lengths = data.crack_length_inch / data.notch_inch
    early = lengths.sel(million_cycles=0.05)
    late = lengths.sel(million_cycles=0.08)
    print(
        "rank correlation of the two lengths: "
        f"{spearmanr(early, late, nan_policy='omit').statistic:.2f}"
    )
    for labels in (False, True):
        with pm.Model() as model:
            mu = pm.Normal("mu", 1.1, 0.5)
            sigma = pm.HalfNormal("sigma", 0.5)
            C = pm.LogNormal.dist(mu, sigma)
            for name, response, column in (("early", growth, early), ("late", later, late)):
                measured = np.isfinite(column.values)
                prb.Simulator(
                    name, response, C, EXPONENT,
                    metric=prb.ProbabilityResidual(), observed=column.values[measured],
                    specimens=data.specimen.values[measured] if labels else None,
                )  # fmt: skip
        optimum = prb.minimize(model)
        posterior = prb.sample_smc(
            500, chains=2, model=model, optimum=optimum, random_seed=1, progressbar=False
        )
        resampled = prb.bootstrap(optimum, draws=400)
        print("with labels" if labels else "without labels")
        for what, sd in (
            ("standard error", optimum.stderr),
            ("posterior", {n: float(posterior.posterior[n].std()) for n in ("mu", "sigma")}),
            ("bootstrap", {n: float(resampled.posterior[n].std()) for n in ("mu", "sigma")}),
        ):
            print(f"  {what:15s} mu {sd['mu']:.3f}  sigma {sd['sigma']:.3f}")


if __name__ == "__main__":
    main()
