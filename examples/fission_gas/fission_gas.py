"""Fission gas of 31 measured experiments, each with a model of its own.

An experiment has one reading of the released share and a surrogate of its own, a Gaussian process
through 225 runs. The factors of diffusion and cracking vary between experiments: truncated normal
populations. Data and priors are those of a worked answer of OpenTURNS, see the README. Its sampler
leaves the truncation out of the density of the populations, which `normalised=False` does as well.
The numbers below are those of a quadrature (`python -m benchmarks.published`). It takes two
minutes.

Run: uv run python examples/fission_gas/fission_gas.py
"""

from pathlib import Path

import numpy as np
import pymc as pm

import prbayes as prb

DATA = Path(__file__).parent
ENDS = {"diff": (0.1, 40.0), "crack": (1e-4, 1.0)}
SPREADS = {"diff": (0.1, 40.0), "crack": (0.1, 10.0)}
# Mean and standard deviation by quadrature.
REFERENCE = {
    "mu_diff": (7.80, 2.31),
    "log_sigma_diff": (1.434, 0.356),
    "mu_crack": (0.240, 0.047),
    "log_sigma_crack": (-1.937, 0.194),
}


def kernel(first, second, lengths):
    """Squared exponential kernel of points (..., 2) and (n, 2), (..., n)."""
    distance = (first[..., None, :] - second) / lengths
    return np.exp(-0.5 * (distance**2).sum(axis=-1))


def surrogate(runs, outputs, lengths, nugget):
    """Mean of a Gaussian process with a constant trend, as a function of the two factors."""
    matrix = kernel(runs, runs, lengths) + nugget * np.eye(len(runs))
    of_ones, of_outputs = np.linalg.solve(matrix, np.stack([np.ones(len(runs)), outputs], 1)).T
    trend = of_outputs.sum() / of_ones.sum()
    weights = of_outputs - trend * of_ones

    def release(diff, crack):
        points = np.stack(np.broadcast_arrays(diff, crack), axis=-1)
        return trend + kernel(points, runs, lengths) @ weights

    return release


def experiments():
    """Return the function of each experiment, and the 31 readings."""
    runs = np.loadtxt(DATA / "runs.csv", delimiter=",", skiprows=1)
    table = np.loadtxt(DATA / "experiments.csv", delimiter=",", skiprows=1, usecols=range(1, 5))
    functions = [
        surrogate(runs[:, :2], outputs, row[1:3], row[3])
        for outputs, row in zip(runs.T[2:], table, strict=True)
    ]
    return functions, table[:, 0]


def reading_error(readings):
    """Return the standard deviation of each reading."""
    return np.sqrt((0.05 * readings) ** 2 + 1e-4)


def population(functions, readings, *, normalised=True):
    """Return the model of the two populations."""
    inputs, masses = [], []
    with pm.Model() as model:
        for name, (low, high) in ENDS.items():
            mu = pm.Uniform(f"mu_{name}", low, high)
            sigma = pm.math.exp(pm.Uniform(f"log_sigma_{name}", *np.log(SPREADS[name])))
            inputs.append(pm.TruncatedNormal.dist(mu, sigma, lower=low, upper=high, name=name))
            normal = pm.Normal.dist(mu, sigma)
            below = [pm.math.exp(pm.logcdf(normal, end)) for end in (low, high)]
            masses.append(pm.math.log(below[1] - below[0]))
        prb.Simulator(
            "release", prb.response.by_specimen(functions), *inputs, observed=readings,
            metric=prb.LogLikelihood(error=reading_error(readings)),
        )  # fmt: skip
        if not normalised:
            pm.Potential("without truncation", len(readings) * sum(masses))
    return model


def main():
    """Print the posterior beside that of a quadrature."""
    model = population(*experiments(), normalised=False)
    posterior = prb.sample(model=model, random_seed=1, progressbar=False).posterior
    print(f"{posterior.attrs['n_responses']} runs")
    for name, (mean, sd) in REFERENCE.items():
        values = posterior[name]
        print(f"{name:16s} {float(values.mean()):7.3f} +- {float(values.std()):.3f}", end="")
        print(f"   quadrature {mean:7.3f} +- {sd:.3f}")
        assert abs(float(values.mean()) - mean) < 0.3 * sd
        assert 0.8 < float(values.std()) / sd < 1.25


if __name__ == "__main__":
    main()
