"""The same by random-walk Metropolis with OpenTURNS: the stiffness of each spring is a parameter."""

import numpy as np
import openturns as ot

ot.RandomGenerator.SetSeed(1)
deflections = 3.0 / np.exp(np.random.default_rng(7).normal(1.0, 0.15, 20))


def log_density(state):
    mu, log_sigma, log_k = state[0], state[1], np.array(state[2:])
    sigma, error = np.exp(log_sigma), 0.02 * deflections  # readings need an error here
    population = -0.5 * np.sum(((log_k - mu) / sigma) ** 2) - 20 * log_sigma
    readings = -0.5 * np.sum(((deflections - 3.0 / np.exp(log_k)) / error) ** 2)
    prior = -0.5 * ((mu - 1.0) / 0.3) ** 2 - 0.5 * (sigma / 0.3) ** 2 + log_sigma
    return [prior + population + readings]


start = [1.0, -2.0, *np.log(3.0 / deflections)]
step = ot.Normal([0.0] * 22, [0.02, 0.1, *[0.01] * 20])
density = ot.PythonFunction(22, 1, log_density)
sampler = ot.RandomWalkMetropolisHastings(
    density, ot.Interval([-10.0] * 22, [10.0] * 22), start, step
)
draws = np.array(sampler.getSample(40_000))[10_000:]  # 20 runs in each

print("means of mu and sigma:", draws[:, 0].mean(), np.exp(draws[:, 1]).mean())
