"""Lifetimes from degradation: 15 lasers, and 12 metal specimens at three weights.

Few specimens have failed, but all of them degrade: the population of paths gives the distribution
F(t) of the time at which a path crosses a limit. The data are those of Meeker and Escobar (1998),
see examples/degradation/README.md. Numbers are compared with quadratures of the same models
(`python -m benchmarks.published`).

Run: uv run python examples/degradation.py
"""

from pathlib import Path

import numpy as np
import pymc as pm

import prbayes as prb

DATA = Path(__file__).with_name("degradation")
LASER_LIMIT = 10.0  # % increase of the current
WEAR_LIMIT = 50.0  # micrometres
AT_WEIGHT = 100.0  # g
# Probability of a lifetime below t, in 1000 hours or in cycles: mean and 89% interval.
REFERENCE = {
    "lasers": {4: (0.170, 0.062, 0.314), 5: (0.502, 0.342, 0.661), 6: (0.787, 0.639, 0.907)},
    "wear": {1000: (0.078, 0.007, 0.224), 2000: (0.258, 0.075, 0.505)},
}


def lasers():
    """Return the model of the lasers, their lifetime in 1000 hours, and its input."""
    table = np.loadtxt(DATA / "lasers.csv", delimiter=",", skiprows=2)
    time, readings = table[:, 0] / 1000, table[:, 1:].T

    def increase(rate):
        """Increase of the current in %; the rate is in % in 1000 hours."""
        return np.asarray(rate)[..., None] * time

    with pm.Model() as model:
        mu = pm.Normal("mu", np.log(2), 0.5)
        sigma = pm.HalfNormal("sigma", 0.5)
        error = pm.HalfNormal("error", 0.5)
        rate = pm.LogNormal.dist(mu, sigma, name="rate")
        metric = prb.LogLikelihood(error=error)
        prb.Simulator("increase", increase, rate, observed=readings, metric=metric)
    return model, lambda rate: LASER_LIMIT / rate, [rate]


def wear():
    """Return the model of the wear, the logarithm of the lifetime, and its inputs at a weight."""
    table = np.loadtxt(DATA / "wear.csv", delimiter=",", skiprows=1)
    weight, readings = table[:, 1], np.log(table[:, 2:])
    middle = np.log(30.0)
    time = np.log([2, 5, 10, 20, 50, 100, 200, 500]) - middle

    def log_wear(level, slope):
        """Logarithm of the wear, whose path is a power of the number of cycles."""
        level, slope = np.asarray(level)[..., None], np.asarray(slope)[..., None]
        return level + slope * time

    with pm.Model() as model:
        log_weight = prb.response.condition("log weight", np.log(weight / 50))
        level0, level1 = pm.Normal("level", np.log(10), 1), pm.Normal("level_weight", 1, 1)
        slope0, slope1 = pm.Normal("slope", 0.2, 0.2), pm.Normal("slope_weight", 0, 0.2)
        spread = pm.HalfNormal("spread_level", 0.5), pm.HalfNormal("spread_slope", 0.1)
        error = pm.HalfNormal("error", 0.2)

        def inputs(at):
            level = pm.Normal.dist(level0 + level1 * at, spread[0], name="level of a specimen")
            slope = pm.Normal.dist(slope0 + slope1 * at, spread[1], name="slope of a specimen")
            return [level, slope]

        prb.Simulator(
            "log wear", log_wear, *inputs(log_weight), observed=readings,
            metric=prb.LogLikelihood(error=error),
        )  # fmt: skip

    def log_life(level, slope):
        return middle + (np.log(WEAR_LIMIT) - level) / slope

    return model, log_life, inputs(np.log(AT_WEIGHT / 50))


def main():
    """Print probabilities of failure beside those of a quadrature."""
    for name, problem, transform in (("lasers", lasers, float), ("wear", wear, np.log)):
        model, life, inputs = problem()
        posterior = prb.sample(model=model, random_seed=1, progressbar=False)
        print(f"{name}: {posterior.posterior.attrs['n_responses']} runs")
        for time, (mean, low, high) in REFERENCE[name].items():
            failed = prb.exceedance(
                posterior, life, transform(time), *inputs, model=model, below=True, n_points=1000,
            )  # fmt: skip
            print(failed)
            print(f"  by quadrature {mean:.3f}, {low:.3f} to {high:.3f}")
            # A sixth of the interval is half a posterior standard deviation, or less.
            assert abs(float(failed.probability) - mean) < (high - low) / 6


if __name__ == "__main__":
    main()
