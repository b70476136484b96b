"""How do the coefficients of Paris' law vary together? 68 crack growth curves, seen at four times.

Half crack lengths of aluminium specimens after 60, 120, 180 and 220 thousand cycles calibrate the
population of growth rate and exponent, with their correlation: four outputs of one run. Some
specimens are kept back; their crack lengths at 200 thousand cycles are predicted, and tested. An
independent reference fits Paris' law to the whole record of every specimen.

Run: uv run python examples/virkler.py [--out FOLDER]
"""

import argparse
import time
from pathlib import Path

import numpy as np
import pymc as pm
from scipy.optimize import least_squares

import prbayes as prb

TIMES = [60, 120, 180, 220]  # thousand cycles
KEPT_BACK = 24
LENGTH = 20.0  # mm: where the growth rate is stated
# The logarithm of C, for rates in mm per thousand cycles and sqrt(pi a) in sqrt(mm), is the rate's
# logarithm less this times the exponent.
LEVER = 0.5 * np.log(np.pi * LENGTH)


def growth(rate, exponent, kilocycles, start=9.0, end=36.6):
    """Half crack length in mm, shape (..., times), by Paris' law; longer ones count as the end.

    rate : logarithm of the growth at a half length of 20 mm, in mm per thousand cycles
    """
    p = exponent / 2 - 1
    left = start**-p - p * np.exp(rate) * LENGTH ** (-exponent / 2) * kilocycles
    return np.maximum(left, end**-p) ** (-1 / p)


def at_times(x):
    """Half crack lengths of specimens at the four times, shape (..., 4)."""
    return growth(x[..., 0:1], x[..., 1:2], np.array(TIMES, dtype=float))


def at_200(x):
    """Half crack lengths of specimens after 200 thousand cycles."""
    return growth(x[..., 0], x[..., 1], 200.0)


def reference(lengths):
    """Fit each specimen's record by least squares; return log C and m, shape (specimens, 2)."""
    found = []
    for record in lengths.values:
        use = np.isfinite(record)

        def residuals(t, record=record, use=use):
            return growth(t[0], t[1], lengths.kilocycles.values[use], end=1e3) - record[use]

        rate, exponent = least_squares(residuals, [-2.0, 3.5], x_scale=[0.05, 0.15]).x
        found.append([rate - LEVER * exponent, exponent])
    return np.array(found)


def calibrate(observed):
    """Return the model, its input, its optimum and its posterior."""
    with pm.Model() as model:
        mean = pm.Normal("mean", [-2.0, 3.5], [0.2, 0.5], shape=2)  # of log rate and exponent
        chol, _, sds = pm.LKJCholeskyCov(
            "chol", n=2, eta=1, sd_dist=pm.HalfNormal.dist([0.1, 0.3], shape=2)
        )
        # The same population in terms of log C.
        log_c = np.array([1.0, -LEVER])
        spread = pm.math.sqrt(((log_c @ chol) ** 2).sum())
        pm.Deterministic("mean log C", mean[0] - LEVER * mean[1])
        pm.Deterministic("mean m", mean[1])
        pm.Deterministic("sd log C", spread)
        pm.Deterministic("sd m", sds[1])
        pm.Deterministic("correlation", ((log_c @ chol) * chol[1]).sum() / (spread * sds[1]))
        x = pm.MvNormal.dist(mean, chol=chol)
        # The curves have two degrees of freedom: the rest of four readings is their error.
        metric = prb.Joint(prb.ProbabilityResidual(), components=2)
        prb.Simulator(
            *("half length", at_times, x),
            metric=metric,
            observed=observed,
            propagation=prb.Reweighted(64),
        )
    optimum = prb.minimize(model)
    print(optimum)
    posterior = prb.sample_smc(
        500, chains=2, model=model, optimum=optimum, random_seed=1, progressbar=False
    )
    return model, x, optimum, posterior


def table(fits, optimum, posterior):
    """Return found and reference values of the population, row by row."""
    n = len(fits)
    sd = fits.std(axis=0, ddof=1)
    correlation = np.corrcoef(fits.T)[0, 1]
    expected = {
        "mean log C": (fits[:, 0].mean(), sd[0] / np.sqrt(n)),
        "mean m": (fits[:, 1].mean(), sd[1] / np.sqrt(n)),
        "sd log C": (sd[0], sd[0] / np.sqrt(2 * n)),
        "sd m": (sd[1], sd[1] / np.sqrt(2 * n)),
        "correlation": (correlation, (1 - correlation**2) / np.sqrt(n)),
    }
    rows = []
    for name, (value, error) in expected.items():
        draws = posterior.posterior[name]
        rows.append(
            f"{name:12} {value:8.3f} +- {error:.3f} {float(optimum.point[name]):9.3f} +- "
            f"{float(optimum.stderr[name]):.3f} {float(draws.mean()):9.3f} +- {float(draws.std()):.3f}"
        )
    return rows


def main(out):
    clock = time.perf_counter()
    lengths = prb.datasets.virkler().half_crack_length_mm
    # What had grown beyond the record counts as its end, measured as simulated.
    at = lengths.sel(kilocycles=TIMES).fillna(36.6)
    order = np.random.default_rng(1).permutation(lengths.sizes["specimen"])
    kept_back = np.sort(order[:KEPT_BACK])
    used = np.sort(order[KEPT_BACK:])
    model, x, optimum, posterior = calibrate(at.isel(specimen=used))

    print(f"{used.size} specimens, {optimum.n_responses} runs, {time.perf_counter() - clock:.0f} s")
    print(f"{'':12} {'whole records':>18} {'optimum':>18} {'posterior':>18}")
    print("\n".join(table(reference(lengths), optimum, posterior)))

    # The specimens kept back: at 200 thousand cycles, and at all four times together.
    predicted = prb.predict(posterior, at_200, x, model=model, random_seed=1)
    fresh = lengths.sel(kilocycles=200).isel(specimen=kept_back)
    print(
        f"half length at 200 kilocycles, {KEPT_BACK} specimens kept back: measured "
        f"{float(fresh.mean()):.2f} +- {float(fresh.std(ddof=1)):.2f} mm, predicted "
        f"{float(predicted.mean()):.2f} +- {float(predicted.std()):.2f} mm"
    )
    print(prb.area_test(fresh.values, predicted))
    # The population has no reading error: all four lengths of a specimen lie on its curve.
    curves = prb.predict(posterior, at_times, x, model=model, random_seed=1)
    print(prb.area_test(at.isel(specimen=kept_back).values, curves))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        prb.plots.plot_responses(posterior, model=model).savefig(out / "virkler.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path)
    main(parser.parse_args().out)
