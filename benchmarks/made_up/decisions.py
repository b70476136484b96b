"""Made-up problems of predictions, decisions, checks and metrics of distributions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pymc as pm
from scipy import optimize, stats

import prbayes as prb
from benchmarks.made_up import difference, moments, on_grid, problem

Differences = Iterator[tuple[str, float]]
DRAWS = 4000  # of a posterior, in four chains


def of_weights(values: Any, weights: Any, levels: Any) -> Any:
    """Return quantiles of a weighted grid."""
    order = np.argsort(values)
    return np.interp(levels, weights[order].cumsum() - weights[order] / 2, values[order])


def with_interval(
    name: str, table: Any, values: Any, weights: Any, prob: float = 0.89
) -> Differences:
    """Yield differences of a mean and its interval from those of a weighted grid."""
    mean = weights @ values
    sd = np.sqrt(weights @ (values - mean) ** 2)
    ends = of_weights(values, weights, [(1 - prob) / 2, (1 + prob) / 2])
    centre = table.get("estimate", table.get("probability"))
    yield difference(f"{name}: mean", centre, mean, 0.1 * sd)
    yield difference(f"{name}: lower", table.lower, ends[0], 0.15 * sd)
    yield difference(f"{name}: upper", table.upper, ends[1], 0.25 * sd)


@problem
def population_of_eight_lognormals_in_nanounits() -> Differences:
    x = 3e-9 * np.exp(0.4 * np.random.default_rng(21).normal(size=8))
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", -19.5, 2.0), pm.HalfNormal("sigma", 0.5)
        c = pm.LogNormal.dist(mu, sigma, name="c")
        prb.Simulator("y", lambda c: 1 / c, c, observed=1 / x)
        idata = prb.sample(DRAWS // 4, random_seed=1)
    got = prb.population(idata, "c", model=model, quantiles=[0.01, 0.5]).sel(name="c")

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(np.log(x)).sum(axis=1)
        return logs + stats.norm(-19.5, 2).logpdf(mu) + stats.halfnorm(scale=0.5).logpdf(sigma)

    grid, weights = on_grid(
        log_posterior, mu=np.linspace(-21.5, -17.5, 401), sigma=np.linspace(0.08, 1.8, 401)
    )
    mu, sigma = grid["mu"], grid["sigma"]
    exact = {
        "50% quantile": np.exp(mu),
        "mean": np.exp(mu + sigma**2 / 2),
        "cv": np.sqrt(np.expm1(sigma**2)),
        "1% quantile": np.exp(mu + stats.norm.ppf(0.01) * sigma),
    }
    for name, values in exact.items():
        yield from with_interval(name, got.sel(quantity=name), values, weights)
    one = exact["1% quantile"]
    bound = of_weights(one, weights, 0.05)
    sd = np.sqrt(weights @ (one - weights @ one) ** 2)
    yield difference("A-basis", got.estimate.sel(quantity="A-basis"), bound, 0.15 * sd)


@problem
def population_of_gammas_in_millions() -> Differences:
    x = np.random.default_rng(22).gamma(3.0, 2e6, 12)
    with pm.Model() as model:
        shape, scale = pm.HalfNormal("shape", 10.0), pm.HalfNormal("scale", 1e7)
        load = pm.Gamma.dist(shape, 1 / scale, name="load")
        prb.Simulator("y", np.sqrt, load, observed=np.sqrt(x))
        idata = prb.sample(DRAWS // 4, random_seed=1)
    got = prb.population(idata, load, model=model, upper=True).sel(name="load")

    def log_posterior(log_shape: Any, log_scale: Any) -> Any:
        shape, scale = np.exp(log_shape), np.exp(log_scale)
        logs = stats.gamma(shape[:, None], scale=scale[:, None]).logpdf(x).sum(axis=1)
        logs += stats.halfnorm(scale=10).logpdf(shape) + stats.halfnorm(scale=1e7).logpdf(scale)
        return logs + log_shape + log_scale

    grid, weights = on_grid(
        log_posterior,
        log_shape=np.linspace(np.log(0.2), np.log(60), 301),
        log_scale=np.linspace(np.log(5e4), np.log(6e7), 301),
    )
    shape, scale = np.exp(grid["log_shape"]), np.exp(grid["log_scale"])
    population = stats.gamma(shape, scale=scale)
    exact = {"mean": shape * scale, "sd": population.std(), "95% quantile": population.ppf(0.95)}
    for name, values in exact.items():
        yield from with_interval(name, got.sel(quantity=name), values, weights)
    ninety = population.ppf(0.9)
    sd = np.sqrt(weights @ (ninety - weights @ ninety) ** 2)
    bound = of_weights(ninety, weights, 0.95)
    yield difference("B-basis", got.estimate.sel(quantity="B-basis"), bound, 0.25 * sd)


def uniform_ends() -> Any:
    """Return the observed inputs, model, input and posterior of a uniform population."""
    x = np.random.default_rng(23).uniform(2.0, 5.0, 15)
    with pm.Model() as model:
        low, width = pm.Normal("low", 0.0, 5.0), pm.HalfNormal("width", 10.0)
        a = pm.Uniform.dist(low, low + width, name="a")
        prb.Simulator("y", lambda a: a**3, a, observed=x**3)
        idata = prb.sample(DRAWS // 4, random_seed=1)
    return x, model, a, idata


@problem
def population_between_uniform_ends() -> Differences:
    x, model, a, idata = uniform_ends()
    got = prb.population(idata, a, model=model).sel(name="a")
    below, above = np.meshgrid(*[np.linspace(0, 4, 1601) + 5e-4] * 2, indexing="ij")
    low, high = (x.min() - below).ravel(), (x.max() + above).ravel()
    logs = -x.size * np.log(high - low)
    logs += stats.norm(0, 5).logpdf(low) + stats.halfnorm(scale=10).logpdf(high - low)
    weights = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    for level in (5, 50, 95):
        values = low + level / 100 * (high - low)
        name = f"{level}% quantile"
        yield from with_interval(name, got.sel(quantity=name), values, weights)


def of_normals(x: Any, spread: float = 1.0) -> tuple[Any, Any, Any]:
    """Return means, standard deviations and weights of the posterior of a normal population.

    Its priors are N(0, 10 spread) and the half-normal one with the standard deviation spread.
    """

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(x).sum(axis=1)
        logs += stats.norm(0, 10 * spread).logpdf(mu)
        return logs + stats.halfnorm(scale=spread).logpdf(sigma)

    half_width = 8 * x.std() / np.sqrt(x.size)
    grid, weights = on_grid(
        log_posterior,
        mu=np.linspace(x.mean() - half_width, x.mean() + half_width, 201),
        sigma=np.linspace(0.4 * x.std(), 4 * x.std(), 301),
    )
    return grid["mu"], grid["sigma"], weights


def normal_population(
    x: Any, response: Any, spread: float = 1.0, **arguments: Any
) -> tuple[Any, Any, Any]:
    """Return the model, input and posterior of a normal population."""
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 10.0 * spread), pm.HalfNormal("sigma", spread)
        a = pm.Normal.dist(mu, sigma, name="a")
        prb.Simulator("y", response, a, observed=response(x), **arguments)
        idata = prb.sample(DRAWS // 4, random_seed=1)
    return model, a, idata


@problem
def prediction_of_a_hump_elsewhere() -> Differences:
    x = np.random.default_rng(24).normal(0.5, 0.4, 20)
    model, a, idata = normal_population(x, np.exp)
    hump = prb.predict(
        idata, lambda a: 1e6 * np.exp(-((a - 0.5) ** 2) / 0.1), a, model=model, n_draws=2000
    )
    mu, sigma, weights = of_normals(x)
    nodes = stats.norm.ppf((np.arange(401) + 0.5) / 401)
    values = 1e6 * np.exp(-((mu[:, None] + sigma[:, None] * nodes - 0.5) ** 2) / 0.1)
    drawn = hump.values.reshape(-1, hump.sizes["sample"])
    yield from with_moments("mean", drawn.mean(axis=1), values.mean(axis=1), weights)
    share = (values < 2e5).mean(axis=1)
    yield from with_moments("share below", (drawn < 2e5).mean(axis=1), share, weights)


def with_moments(name: str, drawn: Any, values: Any, weights: Any) -> Differences:
    """Yield differences of mean and standard deviation of draws from those of a weighted grid."""
    mean = weights @ values
    sd = np.sqrt(weights @ (values - mean) ** 2)
    yield difference(f"{name}: mean", drawn.mean(), mean, 0.1 * sd)
    yield difference(f"{name}: sd", drawn.std(), sd, 0.12 * sd)


@problem
def prediction_with_missing_readings() -> Differences:
    rng = np.random.default_rng(25)
    a, b = rng.normal(2.0, 0.3, 24), rng.normal(1.0, 0.2, 24)
    observed = {"sum": a + b, "first": 1e-9 * np.exp(a)}
    observed["first"][::3] = np.nan
    with pm.Model() as model:
        mu_a, mu_b = pm.Normal("mu_a", 0.0, 10.0), pm.Normal("mu_b", 0.0, 10.0)
        dist_a, dist_b = pm.Normal.dist(mu_a, 0.3), pm.Normal.dist(mu_b, 0.2)

        def response(a: Any, b: Any) -> Any:
            return {"sum": a + b, "first": 1e-9 * np.exp(a)}

        prb.Simulator("y", response, dist_a, dist_b, observed=observed)
        idata = prb.sample(DRAWS // 4, random_seed=1)
    got = prb.predict(
        idata,
        lambda a, b: np.stack([a * b, a - b], axis=-1),
        dist_a,
        dist_b,
        model=model,
        n_draws=2000,
    )
    both = ~np.isnan(observed["first"])
    # the normal posterior of the two means: complete specimens and those with the sum alone
    precision = both.sum() * np.diag([1 / 0.09, 1 / 0.04]) + (~both).sum() / 0.13 + np.eye(2) / 100
    total = both.sum() * np.array([a[both].mean() / 0.09, b[both].mean() / 0.04])
    total += (~both).sum() * (a + b)[~both].mean() / 0.13
    mean, covariance = np.linalg.solve(precision, total), np.linalg.inv(precision)
    draws = got.values.reshape(-1, got.sizes["sample"], 2).mean(axis=1)
    slope = np.array([mean[1], mean[0]])
    sds = np.sqrt([slope @ covariance @ slope, [1, -1] @ covariance @ [1, -1]])
    expected = [mean.prod() + covariance[0, 1], mean[0] - mean[1]]
    yield difference("means", draws.mean(axis=0), expected, 0.1 * sds)
    yield difference("sds", draws.std(axis=0), sds, 0.12 * sds)


@problem
def prediction_at_another_hardness() -> Differences:
    rng = np.random.default_rng(26)
    hardness = np.linspace(150.0, 350.0, 30)
    x = 1.0 + 0.004 * hardness + rng.normal(0, 0.15, 30)
    with pm.Model() as model:
        base, slope = pm.Normal("base", 0.0, 5.0), pm.Normal("slope", 0.0, 0.1)
        covariate = prb.response.condition("hardness", hardness)
        a = pm.Normal.dist(base + slope * covariate, 0.15, name="a")
        prb.Simulator("y", np.exp, a, observed=np.exp(x))
        idata = prb.sample(DRAWS // 4, random_seed=1)
    got = prb.predict(
        idata, np.square, a, model=model, at={"hardness": 420.0}, n_draws=2000, stored=False
    )
    table = prb.population(idata, a, model=model, at={"hardness": 420.0}).sel(name="a")
    design = np.stack([np.ones(30), hardness], axis=1)
    precision = design.T @ design / 0.15**2 + np.diag([1 / 25, 1 / 0.01])
    mean = np.linalg.solve(precision, design.T @ x / 0.15**2) @ [1, 420]
    sd = np.sqrt(np.array([1, 420]) @ np.linalg.inv(precision) @ [1, 420])
    draws = got.values.reshape(-1, got.sizes["sample"]).mean(axis=1)
    yield difference("mean square", draws.mean(), mean**2 + sd**2 + 0.15**2, 0.2 * mean * sd)
    yield difference("sd of mean square", draws.std(), 2 * mean * sd, 0.2 * mean * sd)
    yield difference("mean", table.estimate.sel(quantity="mean"), mean, 0.1 * sd)
    ends = mean + sd * stats.norm.ppf([0.055, 0.945])
    got_ends = [table.lower.sel(quantity="mean"), table.upper.sel(quantity="mean")]
    yield difference("ends", got_ends, ends, 0.2 * sd)


def with_probability(name: str, table: Any, values: Any, weights: Any) -> Differences:
    """Yield differences of a probability in its error, and of the ends of its interval in logs."""
    mean = weights @ values
    sd = np.sqrt(weights @ (values - mean) ** 2)
    allowed = 4 * np.asarray(table.error) + 4 * sd / np.sqrt(2000)
    yield difference(f"{name}: probability", table.probability, mean, allowed)
    yield difference(f"{name}: error", table.error, 0, np.maximum(0.3 * mean, 0.3 * sd))
    ends = of_weights(np.log(values), weights, [0.055, 0.945])
    got = np.log([float(table.lower), float(table.upper)])
    sd = np.sqrt(weights @ (np.log(values) - weights @ np.log(values)) ** 2)
    yield difference(f"{name}: ends of the logarithm", got, ends, 0.3 * sd)


@problem
def exceedance_on_both_sides_of_a_dip() -> Differences:
    x = np.random.default_rng(27).normal(0.0, 1.0, 30)
    model, a, idata = normal_population(x, np.sinh, 2.0)
    mu, sigma, weights = of_normals(x, 2.0)
    for limit, n_points in ((1.0, None), (25.0, 1000), (36.0, 1000)):
        got = prb.exceedance(idata, lambda a: a**2 + a, limit, a, model=model, n_points=n_points)
        roots = -0.5 + np.sqrt(0.25 + limit) * np.array([-1.0, 1.0])
        values = stats.norm.cdf(roots[0], mu, sigma) + stats.norm.sf(roots[1], mu, sigma)
        yield from with_probability(f"above {limit}", got, values, weights)


@problem
def exceedance_below_of_the_second_output() -> Differences:
    rng = np.random.default_rng(28)
    a, b = 2.0 * rng.weibull(3.0, 25), rng.lognormal(0.0, 0.2, 25)
    with pm.Model() as model:
        k, scale = pm.HalfNormal("k", 10.0), pm.HalfNormal("scale", 10.0)
        mu, sigma = pm.Normal("mu", 0.0, 1.0), pm.HalfNormal("sigma", 1.0)
        inputs = pm.Weibull.dist(k, scale), pm.LogNormal.dist(mu, sigma)

        def response(a: Any, b: Any) -> Any:
            return {"product": a * b, "ratio": a / b}

        prb.Simulator("y", response, *inputs, observed=response(a, b))
        idata = prb.sample(DRAWS // 4, random_seed=1)
    limit = 1e-3
    got = prb.exceedance(
        idata, response, limit, *inputs, model=model, output="ratio", below=True, n_points=1000
    )

    def log_weibull(k: Any, scale: Any) -> Any:
        logs = stats.weibull_min(k[:, None], scale=scale[:, None]).logpdf(a).sum(axis=1)
        return logs + stats.halfnorm(scale=10).logpdf(k) + stats.halfnorm(scale=10).logpdf(scale)

    def log_normal(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(np.log(b)).sum(axis=1)
        return logs + stats.norm(0, 1).logpdf(mu) + stats.halfnorm(scale=1).logpdf(sigma)

    rng = np.random.default_rng(1)
    first, p = on_grid(log_weibull, k=np.linspace(1, 7, 301), scale=np.linspace(1.2, 3.2, 301))
    second, q = on_grid(
        log_normal, mu=np.linspace(-0.4, 0.4, 301), sigma=np.linspace(0.08, 0.6, 301)
    )
    i, j = rng.choice(p.size, 20_000, p=p), rng.choice(q.size, 20_000, p=q)
    nodes = stats.norm.ppf((np.arange(101) + 0.5) / 101)
    limits = limit * np.exp(second["mu"][j, None] + second["sigma"][j, None] * nodes)
    values = -np.expm1(-((limits / first["scale"][i, None]) ** first["k"][i, None])).mean(axis=1)
    yield from with_probability("ratio", got, values, np.full(20_000, 1 / 20_000))


@problem
def exceedance_between_bounds_at_the_optimum() -> Differences:
    x = np.random.default_rng(29).normal(3.0, 0.5, 40)
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 10.0), pm.HalfNormal("sigma", 5.0)
        a = pm.Normal.dist(mu, sigma)
        prb.Simulator("y", np.exp, a, observed=np.exp(x))
        optimum = prb.minimize()
    interval = prb.decision.Interval(-1.0, 1.0)

    def response(a: Any, factor: Any) -> Any:
        return a * 1e6 * (1 - (factor - 0.3) ** 2 / 10)

    got = prb.exceedance(optimum, response, 5.5e6, a, interval, model=model, n_points=1000)
    rng = np.random.default_rng(1)  # the sampling distribution, normal in mu and log sigma
    mu = x.mean() + rng.normal(size=100_000) * x.std() / np.sqrt(40)
    sigma = x.std() * np.exp(rng.normal(size=100_000) / np.sqrt(80))
    for bound, factor in (("lower", -1.0), ("upper", 0.3)):
        limit = 5.5 / (1 - (factor - 0.3) ** 2 / 10)
        values = stats.norm.sf(limit, mu, sigma)
        allowed = 4 * got.error.sel(bound=bound) + 4 * values.std() / np.sqrt(2000)
        yield difference(bound, got.probability.sel(bound=bound), values.mean(), allowed)


@problem
def evaluated_median_of_a_bounded_response() -> Differences:
    x = np.random.default_rng(30).normal(1.0, 0.3, 20)
    model, a, idata = normal_population(x, np.exp)
    mu, sigma, weights = of_normals(x)
    quantity = prb.decision.Quantile(np.tanh, a, probability=0.1)
    got = prb.decision.evaluate(idata, quantity, model=model)
    exact = np.tanh(mu + stats.norm.ppf(0.1) * sigma)
    yield from with_interval("10%", got, exact, weights)
    got = prb.decision.evaluate(idata, prb.decision.StandardDeviation(np.exp, a), model=model)
    exact = np.sqrt(np.expm1(sigma**2)) * np.exp(mu + sigma**2 / 2)
    yield from with_interval("sd", got, exact, weights)


@problem
def evaluated_exceedance_by_a_metric() -> Differences:
    x = np.random.default_rng(31).normal(5.0, 2.0, 40)
    model, a, idata = normal_population(x, np.positive, metric=prb.KullbackLeibler(), spread=5.0)
    mu, sigma, weights = of_normals(x, 5.0)
    quantity = prb.decision.Exceedance(lambda a: 1e-9 * (a - 5) ** 2, a, limit=1e-8)
    got = prb.decision.evaluate(idata, quantity, model=model)
    root = np.sqrt(10)
    exact = stats.norm.cdf(5 - root, mu, sigma) + stats.norm.sf(5 + root, mu, sigma)
    yield from with_interval("probability", got, exact, weights)


@problem
def p_box_of_a_folded_population() -> Differences:
    x = np.random.default_rng(32).normal(0.3, 1.0, 30)
    model, a, idata = normal_population(x, np.sinh, 2.0)
    mu, sigma, weights = of_normals(x, 2.0)
    box = prb.decision.p_box(idata, np.abs, a, model=model)
    got = box.sel(band="pointwise").interp(y=[0.3, 1.0, 2.0])
    for k, y in enumerate((0.3, 1.0, 2.0)):
        exact = stats.norm.cdf(y, mu, sigma) - stats.norm.cdf(-y, mu, sigma)
        sd = np.sqrt(weights @ (exact - weights @ exact) ** 2)
        ends = of_weights(exact, weights, [0.055, 0.945])
        yield difference(f"mean at {y}", got["mean"][k], weights @ exact, 0.15 * sd + 0.003)
        both = [got.lower[k], got.upper[k]]
        yield difference(f"ends at {y}", both, ends, 0.3 * sd + 0.003)
    # the share of the posterior's distribution functions that lie within the simultaneous band
    band = box.sel(band="simultaneous")
    chosen = np.random.default_rng(1).choice(mu.size, 4000, p=weights)
    y = box.y.values
    curves = stats.norm.cdf(y, mu[chosen, None], sigma[chosen, None])
    curves -= stats.norm.cdf(-y, mu[chosen, None], sigma[chosen, None])
    slack = 0.005
    inside = ((curves >= band.lower.values - slack) & (curves <= band.upper.values + slack)).all(1)
    yield difference("coverage of the band", inside.mean(), 0.89, 0.05)


def planned(idata: Any, centre: Any, covariance: Any, information: Any, k: int) -> Any:
    """Return standard deviations of mu and sigma after k specimens with an information matrix.

    Matrices are those of mu and log sigma.
    """
    after = np.linalg.inv(np.linalg.inv(covariance) + k * information)
    return np.sqrt(np.diag(after)) * [1.0, centre[1]]


def in_logarithms(mu: Any, sigma: Any, weights: Any) -> tuple[Any, Any]:
    """Return the centre in mu and sigma, and the covariance of mu and log sigma."""
    values = np.stack([mu, np.log(sigma)])
    mean = values @ weights
    deviations = values - mean[:, None]
    return np.array([mean[0], np.exp(mean[1])]), (deviations * weights) @ deviations.T


@problem
def plan_of_the_same_test() -> Differences:
    x = np.random.default_rng(41).normal(2.0, 0.4, 20)
    model, a, idata = normal_population(x, np.exp)
    candidates = {"same": prb.decision.Condition(np.exp, a)}
    table = prb.plan(idata, candidates, k=[20, 200], model=model)
    centre, covariance = in_logarithms(*of_normals(x))
    for k in (20, 200):
        exact = planned(idata, centre, covariance, np.diag([centre[1] ** -2, 2.0]), k)
        got = table.sd.sel(candidate="same", k=k, name=["mu", "sigma"])
        yield difference(f"after {k}", got, exact, 0.1 * exact)


@problem
def plan_of_a_folded_test_in_nanounits() -> Differences:
    x = np.random.default_rng(42).normal(0.5, 0.5, 30)
    model, a, idata = normal_population(x, lambda a: 1e-9 * a)
    candidates = {"folded": prb.decision.Condition(lambda a: 1e6 * a**2, a)}
    table = prb.plan(idata, candidates, k=[30, 300], model=model)
    centre, covariance = in_logarithms(*of_normals(x))
    nodes = np.linspace(1e-6, centre[0] + 9 * centre[1], 20_001)

    def density(mu: float, sigma: float) -> Any:
        return stats.norm(mu, sigma).pdf(nodes) + stats.norm(mu, sigma).pdf(-nodes)

    mu, sigma = centre
    slopes = [
        (density(mu + 1e-5, sigma) - density(mu - 1e-5, sigma)) / 2e-5,
        (density(mu, sigma * np.exp(1e-5)) - density(mu, sigma * np.exp(-1e-5))) / 2e-5,
    ]
    information = np.array(
        [[np.trapezoid(p * q / density(mu, sigma), nodes) for p in slopes] for q in slopes]
    )
    for k in (30, 300):
        exact = planned(idata, centre, covariance, information, k)
        got = table.sd.sel(candidate="folded", k=k, name=["mu", "sigma"])
        yield difference(f"after {k}", got, exact, 0.1 * exact)


@problem
def plan_of_readings_with_error() -> Differences:
    x = np.random.default_rng(43).normal(2e6, 2e5, 25)
    model, a, idata = normal_population(x, np.positive, 1e6)
    error = 3e5
    rough = prb.decision.Condition(np.positive, a, metric=prb.LogLikelihood(error=error))
    quantity = prb.decision.Quantile(np.positive, a, probability=0.99)
    table = prb.plan(idata, {"rough": rough}, k=[25, 100], model=model, quantity=quantity)
    centre, covariance = in_logarithms(*of_normals(x, 1e6))
    variance = centre[1] ** 2 + error**2
    information = np.diag([1 / variance, 2 * (centre[1] ** 2 / variance) ** 2])
    for k in (25, 100):
        exact = planned(idata, centre, covariance, information, k)
        got = table.sd.sel(candidate="rough", k=k, name=["mu", "sigma"])
        yield difference(f"after {k}", got, exact, 0.1 * exact)
        after = np.linalg.inv(np.linalg.inv(covariance) + k * information)
        slope = np.array([1.0, stats.norm.ppf(0.99) * centre[1]])
        exact = np.sqrt(slope @ after @ slope)
        got = table.sd.sel(candidate="rough", k=k, name="quantity")
        yield difference(f"quantile after {k}", got, exact, 0.12 * exact)


@problem
def sensitivity_of_a_quantile_to_moments() -> Differences:
    x = np.random.default_rng(44).normal(1.0, 0.5, 12)
    model, a, idata = normal_population(x, np.exp)
    quantity = prb.decision.Quantile(lambda a: 1e6 * a, a, probability=0.9)
    table = prb.sensitivity(idata, quantity, model=model)
    mu, sigma, weights = of_normals(x)
    values = mu + stats.norm.ppf(0.9) * sigma
    total = weights @ (values - weights @ values) ** 2
    for name, by in (("mu", mu), ("sigma", sigma)):
        other = sigma if name == "mu" else mu
        for row, given in (("first", by), ("total", other)):
            places = np.unique(given, return_inverse=True)[1]
            mass = np.bincount(places, weights)
            mean = np.bincount(places, weights * values) / np.maximum(mass, 1e-300)
            share = mass @ (mean - weights @ values) ** 2 / total
            exact = share if row == "first" else 1 - share
            yield difference(f"{row} of {name}", table[row].sel(factor=name), exact, 0.06)
    yield difference("sd", table.attrs["sd"], 1e6 * np.sqrt(total), 1e5 * np.sqrt(total))


@problem
def sensitivity_of_a_product_to_inputs() -> Differences:
    rng = np.random.default_rng(45)
    a, b = rng.normal(2.0, 0.5, 20), rng.lognormal(0.0, 0.4, 20)
    with pm.Model() as model:
        inputs = (
            pm.Normal.dist(pm.Normal("mu_a", 0, 5), 0.5, name="a"),
            pm.LogNormal.dist(pm.Normal("mu_b", 0, 1), 0.4, name="b"),
        )

        def response(a: Any, b: Any) -> Any:
            return {"a": a**3, "ratio": a / b}

        prb.Simulator("y", response, *inputs, observed=response(a, b))
        idata = prb.sample(DRAWS // 4, random_seed=1)
    quantity = prb.decision.Mean(lambda a, b: 1e-9 * a * b**2, *inputs)
    table = prb.sensitivity(idata, quantity, model=model)
    centre = [float(idata.posterior[name].median()) for name in ("mu_a", "mu_b")]
    means = centre[0], np.exp(2 * centre[1] + 2 * 0.16)
    squares = centre[0] ** 2 + 0.25, np.exp(4 * centre[1] + 8 * 0.16)
    variance = squares[0] * squares[1] - (means[0] * means[1]) ** 2
    by_a = (squares[0] - means[0] ** 2) * means[1] ** 2 / variance
    by_b = (squares[1] - means[1] ** 2) * means[0] ** 2 / variance
    yield difference("first of a", table["first"].sel(factor="a"), by_a, 0.05)
    yield difference("first of b", table["first"].sel(factor="b"), by_b, 0.05)
    yield difference("total of a", table["total"].sel(factor="a"), 1 - by_b, 0.05)
    yield difference("total of b", table["total"].sel(factor="b"), 1 - by_a, 0.05)
    # the mean is mu_a exp(2 mu_b + .32), of independent normal numbers
    first, second = 0.5 / np.sqrt(20) / centre[0], 2 * 0.4 / np.sqrt(20)
    variance = (1 + first**2) * np.exp(second**2) - 1
    yield difference("first of mu_a", table["first"].sel(factor="mu_a"), first**2 / variance, 0.05)
    exact = np.expm1(second**2) / variance
    yield difference("first of mu_b", table["first"].sel(factor="mu_b"), exact, 0.05)


@problem
def sensitivity_of_a_failure_to_inputs() -> Differences:
    rng = np.random.default_rng(46)
    a, b = rng.gamma(4.0, 0.5, 30), rng.normal(1.0, 0.6, 30)
    with pm.Model() as model:
        inputs = (
            pm.Gamma.dist(4.0, 1 / pm.HalfNormal("scale", 2.0), name="a"),
            pm.Normal.dist(pm.Normal("mu", 0, 5), 0.6, name="b"),
        )

        def response(a: Any, b: Any) -> Any:
            return np.stack([a + b, a - b], axis=-1)

        prb.Simulator("y", response, *inputs, observed=response(a, b))
        optimum = prb.minimize()
    quantity = prb.decision.Exceedance(lambda a, b: a + np.exp(b), *inputs, limit=7.0)
    table = prb.sensitivity(optimum, quantity, model=model)
    scale, mu = optimum.point["scale"], optimum.point["mu"]
    yield difference("estimates", [scale, mu], [a.mean() / 4, b.mean()], [0.01, 0.01])
    levels = (np.arange(4000) + 0.5) / 4000
    of_a, of_b = stats.gamma(4, scale=scale).ppf(levels), stats.norm(mu, 0.6).ppf(levels)
    given_a = stats.norm(mu, 0.6).sf(np.log(np.maximum(7 - of_a, 1e-300)))
    given_b = stats.gamma(4, scale=scale).sf(7 - np.exp(of_b))
    p = given_a.mean()
    yield difference("value", table.attrs["value"], p, 4 * table.attrs["value_error"] + 0.002)
    for name, values, others in (("a", given_a, given_b), ("b", given_b, given_a)):
        first, total = values.var() / (p - p * p), 1 - others.var() / (p - p * p)
        allowed = 4 * np.asarray(table["first_error"].sel(factor=name)) + 0.02
        yield difference(f"first of {name}", table["first"].sel(factor=name), first, allowed)
        allowed = 4 * np.asarray(table["total_error"].sel(factor=name)) + 0.02
        yield difference(f"total of {name}", table["total"].sel(factor=name), total, allowed)


class Counted:
    """A response of one or two inputs that counts its specimens."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, a: Any, b: Any = 0.0) -> Any:
        a = np.asarray(a, dtype=float)  # refuses symbols, which are no runs
        self.count += a.size
        return 1e6 * np.exp(a) + b


@problem
def cost_of_stored_responses_that_are_shared() -> Differences:
    response, rng = Counted(), np.random.default_rng(47)
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        for name in ("y", "z"):
            prb.Simulator(
                name,
                response,
                a,
                metric=prb.AreaMetric(),
                observed=1e6 * rng.lognormal(size=12),
                propagation=prb.Reweighted(512),
            )
        stated = prb.cost(model).runs
        yield difference("before", response.count, 0, 1)
        prb.minimize(refine=False)
    # besides the runs a few of the first ones are repeated
    yield difference("runs", response.count, stated, 16)
    yield difference("afterwards", prb.cost(model).runs, 0, 1)


@problem
def cost_of_each_value_when_resimulated() -> Differences:
    response = Counted()
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        b = pm.Gamma.dist(2.0, 1e-6)
        prb.Simulator(
            "y",
            response,
            a,
            b,
            metric=prb.ProbabilityResidual(),
            observed=1e6 * np.random.default_rng(48).lognormal(size=9),
            propagation=prb.Resimulated(128),
            epsilon=1.0,
        )
    cost = prb.cost(model)
    logp = model.compile_logp()
    logp({"mu": 0.1})
    first = response.count
    yield difference("first runs", first, cost.runs + cost.runs_each, 16)
    for mu in (0.2, 0.3, 0.4):
        logp({"mu": mu})
    yield difference("each", (response.count - first) / 3, cost.runs_each, 0.5)


@problem
def cost_of_a_likelihood_with_a_budget() -> Differences:
    response = Counted()
    x = np.random.default_rng(49).normal(size=(2, 20))
    observed = {"y": 1e6 * np.exp(x[0]) + x[1]}
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        a, b = pm.Normal.dist(mu, 1.0), pm.Normal.dist(0.0, 1.0)
        prb.Simulator("y", response, a, b, observed=observed["y"])
        cost = prb.cost(model)
        optimum = prb.minimize()
    yield difference("runs that are stated", optimum.n_responses, cost.runs, 0.6 * response.count)
    yield difference("runs that are counted", optimum.n_responses, response.count, 16)


@problem
def area_test_by_exact_tables() -> Differences:
    rng = np.random.default_rng(50)
    for n in (4, 13, 40):
        u = np.sort(rng.random((40_000, n)), axis=1)
        areas = area(u)
        u = u[0]
        predicted = 1e-9 * stats.gamma.ppf((np.arange(100_000) + 0.5) / 100_000, 0.7)
        test = prb.area_test(1e-9 * stats.gamma.ppf(u, 0.7), predicted)
        yield difference(f"area of {n}", test.statistic, areas[0], 1e-3)
        p = (areas >= areas[0]).mean()
        yield difference(f"p of {n}", test.p_value, p, 0.02)
        critical = prb.validation.ExactModel().critical_value(n)
        share = (areas > critical).mean()
        yield difference(f"level of {n}", share, 0.05, 0.005)


def area(u: Any) -> Any:
    """Return areas between distribution functions of sorted u, (k, n), and the diagonal."""
    n = u.shape[1]
    ends = np.concatenate([np.zeros((len(u), 1)), u, np.ones((len(u), 1))], axis=1)
    level = np.arange(n + 1) / n

    def integral(x: Any) -> Any:
        return np.sign(x - level) * (x - level) ** 2 / 2

    return (integral(ends[:, 1:]) - integral(ends[:, :-1])).sum(axis=1)


def rejected(n_data_sets: int, tested: Any, **arguments: Any) -> float:
    """Return the share of data sets in which an area test rejects at .1.

    The posterior is that of a normal population with 12 data under Jeffreys' prior. ``tested``
    returns the tested values, and the response of specimens (draws, samples).
    """
    rng, count = np.random.default_rng(51), 0
    for _ in range(n_data_sets):
        x = rng.normal(size=12)
        sigma = np.sqrt(12 * x.var() / rng.chisquare(11, (300, 1)))
        mu = x.mean() + sigma / np.sqrt(12) * rng.normal(size=(300, 1))
        values, predicted = tested(rng, mu + sigma * rng.normal(size=(300, 200)))
        null = prb.validation.PosteriorNull(299, random_seed=1)
        test = prb.area_test(values, predicted, null=null, alpha=0.1, **arguments)
        count += test.rejected
    return count / n_data_sets


@problem
def area_test_of_rounded_readings() -> Differences:
    def right(rng: Any, z: Any) -> Any:
        return np.round(np.exp(rng.normal(size=15))), np.round(np.exp(z))

    # the largest size of this discrete test is .1; three and a half standard errors
    size = rejected(200, right)
    yield difference("size", max(size - 0.1, 0.0), 0.0, 3.5 * 0.3 / np.sqrt(200))
    yield difference("not degenerate", size, 0.1, 0.095)
    size = rejected(200, right, folded=True)
    yield difference("size, folded", max(size - 0.1, 0.0), 0.0, 3.5 * 0.3 / np.sqrt(200))


@problem
def area_test_of_two_conditions_of_the_same_specimens() -> Differences:
    def right(rng: Any, z: Any) -> Any:
        x = rng.normal(size=10)
        return {"a": np.exp(x), "b": 1e6 * x}, {"a": np.exp(z), "b": 1e6 * z}

    def wrong(rng: Any, z: Any) -> Any:
        x = 2.0 + rng.normal(size=10)
        return {"a": np.exp(x), "b": 1e6 * x}, {"a": np.exp(z), "b": 1e6 * z}

    labels = {"a": np.arange(10), "b": np.arange(10)}
    size = rejected(150, right, specimens=labels)
    yield difference("size", size, 0.1, 3.5 * 0.3 / np.sqrt(150))
    yield difference("power", rejected(40, wrong, specimens=labels), 1.0, 0.2)


@problem
def area_test_of_two_outputs() -> Differences:
    def right(rng: Any, z: Any) -> Any:
        noise = rng.normal(size=z.shape)
        x = rng.normal(size=20)
        observed = np.stack([x, 1e-9 * (x + rng.normal(size=20))], axis=1)
        return observed, np.stack([z, 1e-9 * (z + noise)], axis=-1)

    def wrong(rng: Any, z: Any) -> Any:
        observed, predicted = right(rng, z)
        observed[:, 1] = 1e-9 * np.sqrt(2) * rng.normal(size=20)
        observed[:, 0] = -np.sqrt(2) * observed[:, 1] / np.sqrt(2) / 1e-9 / np.sqrt(2)
        return observed, predicted

    yield difference("size", rejected(100, right), 0.1, 3.5 * 0.3 / np.sqrt(100))
    yield difference("power", rejected(40, wrong), 1.0, 0.2)


def estimated(
    response: Any, observed: Any, dist: Any = None, width: float = 10.0, **arguments: Any
) -> Any:
    """Return the optimum of a normal population, or of another one of its mean and spread."""
    dist = pm.Normal.dist if dist is None else dist
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, width), pm.HalfNormal("sigma", width)
        prb.Simulator("y", response, dist(mu, sigma), observed=observed, **arguments)
        return prb.minimize()


@problem
def rank_of_two_families() -> Differences:
    y = np.random.default_rng(52).lognormal(1.0, 0.7, 40)
    with pm.Model():
        mean, sd = pm.Normal("mean", 3, 10), pm.HalfNormal("sd", 10)
        prb.Simulator("y", np.positive, pm.Normal.dist(mean, sd), observed=y)
        normal = prb.minimize()
    lognormal = estimated(np.positive, y, pm.LogNormal.dist)
    table = prb.rank({"normal": normal, "lognormal": lognormal}, folds=20)
    yield difference("order", table.candidate.values[0] != "lognormal", 0, 0.5)
    # by leaving out each specimen; a tenth of each density is spread widely, as is documented
    scores, wide = [], 0.1 * stats.cauchy(np.median(y), stats.iqr(y)).pdf(y)
    for i in range(40):
        rest = np.delete(y, i)
        logs = np.log(rest)
        candidates = (
            stats.norm(rest.mean(), rest.std()),
            stats.lognorm(logs.std(), scale=np.exp(logs.mean())),
        )
        scores.append([np.log(0.9 * x.pdf(y[i]) + wide[i]) for x in candidates])
    exact = np.subtract(*np.sum(scores, axis=0)[::-1])
    row = table.sel(candidate="normal")
    yield difference("difference", row.difference, exact, 1.0 * float(row.stderr))


@problem
def rank_is_that_of_any_unit() -> Differences:
    y = np.random.default_rng(53).gamma(5.0, 1.0, 30)
    tables = []
    for unit in (1e-9, 1.0, 1e6):
        curved = estimated(lambda a, unit=unit: unit * np.exp(a), unit * y)
        straight = estimated(lambda a, unit=unit: unit * 10 * a, unit * y)
        tables.append(prb.rank({"curved": curved, "straight": straight}))
    for table in tables[::2]:
        for name in ("difference", "stderr"):
            got = table[name].sel(candidate=["curved", "straight"])
            exact = tables[1][name].sel(candidate=["curved", "straight"])
            yield difference(name, got, exact, 0.05 * float(tables[1].stderr.max()))
    shifts = tables[0].score.values - tables[2].score.values
    yield difference("scores", shifts, np.log(1e15), 0.01)


@problem
def rank_of_the_same_model_twice() -> Differences:
    x = np.random.default_rng(54).normal(1.0, 0.2, 12)
    by_exp, by_line = estimated(np.exp, np.exp(x)), estimated(np.exp, np.exp(x), epsilon=None)
    equal = estimated(np.positive, np.exp(x), pm.LogNormal.dist)
    table = prb.rank({"a": by_exp, "b": by_line, "c": equal}, folds=6)
    yield difference("differences", table.difference, 0, 0.05)
    yield difference("beyond chance", table.significant.sum(), 0, 0.5)


@problem
def comparison_of_optimum_and_posterior() -> Differences:
    x = np.random.default_rng(55).normal(2.0, 0.5, 9)
    spread = 1.0
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 10.0), pm.HalfNormal("sigma", spread)
        prb.Simulator("y", lambda a: 1e-9 * a**3, pm.Normal.dist(mu, sigma), observed=1e-9 * x**3)
        optimum = prb.minimize()
        idata = prb.sample(random_seed=1)
    table = prb.compare({"optimum": optimum, "posterior": idata}, model=model)
    row = table.sel(result="optimum")
    exact = np.array([x.mean(), x.std()])
    sds = exact[1] / np.sqrt([9, 18])
    yield difference("optimum", row.estimate, exact, 0.02 * sds)
    yield difference("standard errors", row.sd, sds, 0.02 * sds)
    row = table.sel(result="posterior")
    for name, values in zip(("mu", "sigma"), of_normals(x, spread)[:2], strict=True):
        weights = of_normals(x, spread)[2]
        yield from with_interval(name, row.sel(hyperparameter=name), values, weights)
    # the area metric of the populations at the estimates
    nodes = stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)
    for result in ("optimum", "posterior"):
        mu, sigma = table.estimate.sel(result=result).values
        area = stats.wasserstein_distance(1e-9 * (mu + sigma * nodes) ** 3, 1e-9 * x**3)
        yield difference(
            f"area of {result}", table["AreaMetric"].sel(result=result), area, 0.02 * area
        )


@problem
def comparison_of_four_metrics() -> Differences:
    x = np.random.default_rng(56).normal(5.0, 2.0, 16)
    results, models = {}, []
    for label, metric in {"area": prb.AreaMetric(), "KLD": prb.KullbackLeibler()}.items():
        with pm.Model() as model:
            mu, sigma = pm.Normal("mu", 0.0, 10.0), pm.HalfNormal("sigma", 10.0)
            a = pm.Normal.dist(mu, sigma)
            prb.Simulator("y", lambda a: 1e6 * a, a, metric=metric, observed=1e6 * x)
            results[label] = prb.minimize()
        models.append(model)
    kernel = prb.LogLikelihood(density=prb.GaussianKDE())
    metrics = [prb.AreaMetric(), prb.ProbabilityResidual(), prb.KullbackLeibler(), kernel]
    table = prb.compare(results, model=models[0], metrics=metrics)
    nodes = stats.norm.ppf((np.arange(4001) + 0.5) / 4001)
    for result, optimum in results.items():
        values = 1e6 * (optimum.point["mu"] + optimum.point["sigma"] * nodes)
        for metric in metrics:
            exact = metric(values, 1e6 * x)
            name = type(metric).__name__
            got = float(table[name].sel(result=result))
            yield difference(f"{name} at {result}", got, exact, 0.02 * abs(exact) + 1e-4)


@problem
def comparison_of_a_chain_of_pymc() -> Differences:
    x = np.random.default_rng(57).gamma(3.0, 1.0, 20)
    with pm.Model() as model:
        shape, rate = pm.HalfNormal("shape", 10.0), pm.HalfNormal("rate", 10.0)
        mean = pm.Deterministic("mean", shape / rate)
        prb.Simulator("y", lambda a: a**2, pm.Gamma.dist(shape, rate), observed=x**2)
        optimum = prb.minimize()
        idata = pm.sample(
            500,
            tune=500,
            initvals=optimum.initvals,
            init="adapt_diag",
            random_seed=1,
            chains=1,
            cores=1,
            progressbar=False,
        )
    table = prb.compare({"optimum": optimum, "chain": idata}, model=model)
    del mean
    fitted = stats.gamma.fit(x, floc=0)
    exact = [fitted[0], 1 / fitted[2], fitted[0] * fitted[2]]
    names = ["shape", "rate", "mean"]
    sds = table["sd"].sel(result="optimum", hyperparameter=names).values
    got = table.estimate.sel(result="optimum", hyperparameter=names)
    yield difference("optimum", got, exact, 0.02 * sds)
    yield difference("sd of mean", sds[2], x.mean() / np.sqrt(20 * fitted[0]), 0.05 * sds[2])

    def log_posterior(log_shape: Any, log_rate: Any) -> Any:
        shape, rate = np.exp(log_shape), np.exp(log_rate)
        logs = stats.gamma(shape[:, None], scale=1 / rate[:, None]).logpdf(x).sum(axis=1)
        logs += stats.halfnorm(scale=10).logpdf(shape) + stats.halfnorm(scale=10).logpdf(rate)
        return logs + log_shape + log_rate

    grid, weights = on_grid(
        log_posterior, log_shape=np.linspace(-0.5, 2.8, 301), log_rate=np.linspace(-2, 2.2, 301)
    )
    values = {"shape": np.exp(grid["log_shape"]), "rate": np.exp(grid["log_rate"])}
    values["mean"] = values["shape"] / values["rate"]
    for name in names:
        row = table.sel(result="chain", hyperparameter=name)
        mean = weights @ values[name]
        sd = np.sqrt(weights @ (values[name] - mean) ** 2)
        yield difference(f"mean of {name}", row.estimate, mean, 0.2 * sd)
        yield difference(f"sd of {name}", row.sd, sd, 0.2 * sd)


@problem
def bootstrap_with_dirichlet_weights() -> Differences:
    x = np.random.default_rng(58).normal(0.5, 0.4, 30)
    draws = prb.bootstrap(estimated(np.exp, np.exp(x)), 1000, random_seed=1).posterior
    weights = np.random.default_rng(2).dirichlet(np.ones(30), 50_000)
    means = weights @ x
    sds = np.sqrt(weights @ x**2 - means**2)
    for name, exact in (("mu", means), ("sigma", sds)):
        got = draws[name].values.ravel()
        yield difference(f"mean of {name}", got.mean(), exact.mean(), 0.13 * exact.std())
        yield difference(f"sd of {name}", got.std(), exact.std(), 0.1 * exact.std())


@problem
def bootstrap_of_a_parametric_weibull() -> Differences:
    y = 1e6 * np.random.default_rng(59).weibull(2.0, 12)
    with pm.Model():
        k, scale = pm.HalfNormal("k", 10.0), pm.HalfNormal("scale", 1e7)
        dist = pm.Weibull.dist(k, scale)
        prb.Simulator("y", lambda a: 1e-12 * a**2, dist, observed=1e-12 * y**2)
        optimum = prb.minimize()
    fitted = stats.weibull_min.fit(y, floc=0)
    exact = np.array([fitted[0], fitted[2]])
    point = [optimum.point["k"], optimum.point["scale"]]
    yield difference("optimum", point, exact, 0.01 * exact)
    draws = prb.bootstrap(optimum, 600, parametric=True, random_seed=1).posterior
    rng, refits = np.random.default_rng(3), []
    for _ in range(1500):
        data = rng.weibull(fitted[0], 12)
        logs = np.log(data)
        k = 1.5  # Newton's iterations for the shape by maximum likelihood
        for _ in range(50):
            powers = data**k
            ratio = (powers @ logs) / powers.sum()
            slope = (powers @ logs**2) / powers.sum() - ratio**2 + 1 / k**2
            k = max(k - (ratio - 1 / k - logs.mean()) / slope, 0.1)
        refits.append([k, fitted[2] * (data**k).mean() ** (1 / k)])
    for name, values in zip(("k", "scale"), np.transpose(refits), strict=True):
        got = draws[name].values.ravel()
        yield difference(f"mean of {name}", got.mean(), values.mean(), 0.2 * values.std())
        yield difference(f"sd of {name}", got.std(), values.std(), 0.2 * values.std())


@problem
def bootstrap_of_an_area_with_labels() -> Differences:
    # two readings of each specimen: the weights are those of the twelve specimens
    x = np.random.default_rng(60).normal(0.0, 1.0, 12)
    labels = np.repeat(np.arange(12), 2)
    with pm.Model():
        mu = pm.Normal("mu", 0.0, 5.0)
        prb.Simulator(
            "y",
            np.positive,
            pm.Normal.dist(mu, 1.0),
            metric=prb.AreaMetric(),
            observed=np.repeat(x, 2) + np.tile([-0.05, 0.05], 12),
            specimens=labels,
        )
        optimum = prb.minimize()
    draws = prb.bootstrap(optimum, 1000, random_seed=1).posterior["mu"].values.ravel()
    nodes = stats.norm.ppf((np.arange(400) + 0.5) / 400)
    rng, minima = np.random.default_rng(4), []
    for _ in range(1500):
        weights = np.repeat(rng.dirichlet(np.ones(12)), 2) / 2
        values = np.repeat(x, 2) + np.tile([-0.05, 0.05], 12)
        order = np.argsort(values)
        places = np.searchsorted(np.cumsum(weights[order]), (np.arange(400) + 0.5) / 400)
        # the transport map of equal variances: the best shift is the median of the differences
        minima.append(np.median(values[order][np.minimum(places, 23)] - nodes))
    yield difference("mean", draws.mean(), np.mean(minima), 0.15 * np.std(minima))
    yield difference("sd", draws.std(), np.std(minima), 0.12 * np.std(minima))


def is_partition(candidates: Any, n: int) -> bool:
    """Return whether one pair from each of the lists of candidates makes a partition of n."""
    if not candidates:
        return n == 0
    first, *rest = candidates
    return any(
        is_partition([[q for q in pairs if not {*p} & {*q}] for pairs in rest], n - 2)
        for p in first
    )


def held_out_pairs(table: Any, loss: Any, n: int) -> Differences:
    """Yield differences of the losses of folds of two specimens from those of the nearest pairs.

    ``loss`` returns the losses of held-out and of other specimens, of the indices of a pair.
    """
    pairs = [(i, j) for i in range(n) for j in range(i)]
    exact = np.array([loss(np.array(pair)) for pair in pairs])
    got = table[["discrepancy", "calibrated"]].isel(simulator=0)
    got = np.stack([got.discrepancy.values, got.calibrated.values], axis=1)
    differences = np.abs(exact - got[:, None]).max(axis=2)
    yield difference("losses", differences.min(axis=1), 0, 0.01)
    near = [[pairs[k] for k in np.flatnonzero(row < 0.01)] for row in differences]
    yield difference("folds are a partition", is_partition(near, n), 1, 0.5)


@problem
def cross_validation_of_a_likelihood() -> Differences:
    x = np.random.default_rng(61).normal(1.0, 0.5, 12)
    table = prb.cross_validate(estimated(np.exp, np.exp(x)), folds=6)

    def loss(out: Any) -> Any:
        rest = np.delete(x, out)
        population = stats.norm(rest.mean(), rest.std())
        return [(part - population.logpdf(part)).mean() for part in (x[out], rest)]

    yield from held_out_pairs(table, loss, 12)


@problem
def cross_validation_of_a_divergence() -> Differences:
    x = np.random.default_rng(62).normal(3.0, 1.0, 10)
    optimum = estimated(lambda a: a, x, metric=prb.KullbackLeibler())
    table = prb.cross_validate(optimum, folds=5)

    h = bandwidth(x)  # of all data; the minimiser does not depend on it
    grid = np.linspace(x.min() - 8 * h, x.max() + 8 * h, 2001)

    def loss(out: Any) -> Any:
        rest = np.delete(x, out)
        p = stats.norm(rest.mean(), np.hypot(rest.std(), h)).pdf(grid)
        densities = [stats.norm(z, h).pdf(grid[:, None]).mean(axis=1) for z in (x[out], rest)]
        return [np.trapezoid(q * np.log(q / p), grid) for q in densities]

    yield from held_out_pairs(table, loss, 10)


@problem
def cross_validation_with_missing_readings() -> Differences:
    rng = np.random.default_rng(63)
    a, b = rng.normal(2.0, 0.5, 10), rng.lognormal(0.0, 0.5, 10)
    observed = {"a": np.exp(a), "b": 1e6 * b}
    observed["b"][:3] = np.nan
    with pm.Model():
        first = pm.Normal.dist(pm.Normal("mu_a", 0, 10), 0.5)
        second = pm.LogNormal.dist(pm.Normal("mu_b", 0, 10), 0.5)

        def response(a: Any, b: Any) -> Any:
            return {"a": np.exp(a), "b": 1e6 * b}

        prb.Simulator("y", response, first, second, observed=observed)
        table = prb.cross_validate(prb.minimize(), folds=5)
    seen = ~np.isnan(observed["b"])

    def loss(out: Any) -> Any:
        rest = np.delete(np.arange(10), out)
        logs = stats.norm(a[rest].mean(), 0.5).logpdf(a) - a
        mean = np.log(b[rest][seen[rest]]).mean()
        logs += np.where(seen, stats.lognorm(0.5, scale=np.exp(mean)).logpdf(b) - np.log(1e6), 0)
        return [-logs[out].mean(), -logs[rest].mean()]

    yield from held_out_pairs(table, loss, 10)


@problem
def residuals_of_a_line_with_error() -> Differences:
    rng = np.random.default_rng(64)
    y = 1e6 * (rng.normal(2.0, 0.5, 15) * 3 + rng.normal(0, 0.4, 15))
    optimum = estimated(lambda a: 3e6 * a, y, metric=prb.LogLikelihood(error=0.4e6))
    table = prb.residuals(optimum, n_draws=20_000)["y"]
    mu, sigma = optimum.point["mu"], optimum.point["sigma"]
    yield difference("mean", mu, y.mean() / 3e6, 1e-3)
    yield difference("sd", sigma, np.sqrt(y.var() - 0.16e12) / 3e6, 2e-3)
    variance = (3e6 * sigma) ** 2 + 0.4e6**2
    yield difference("CWRES", table.CWRES.values.ravel(), (y - 3e6 * mu) / np.sqrt(variance), 0.05)
    # five Monte Carlo errors of 20 000 draws
    yield difference("PRED", table.PRED.values.ravel(), 3e6 * mu, 5 * 3e6 * sigma / 141)
    shrunk = 3e6 * mu + (3e6 * sigma) ** 2 / variance * (y - 3e6 * mu)
    yield difference("IPRED", table.IPRED.values.ravel(), shrunk, 0.05 * 0.4e6)
    yield difference("IWRES", table.IWRES.values.ravel(), (y - shrunk) / 0.4e6, 0.06)


@problem
def residuals_of_two_outputs_of_one_input() -> Differences:
    rng = np.random.default_rng(65)
    x = rng.normal(1.0, 0.3, 12)
    y = np.stack([x, 2 * x], axis=1) + rng.normal(0, [0.1, 0.3], (12, 2))
    y[2, 1] = y[5, 0] = np.nan
    with pm.Model():
        a = pm.Normal.dist(pm.Normal("mu", 0, 10), 0.3)
        prb.Simulator(
            "y",
            lambda a: np.stack([a, 2 * a], axis=-1),
            a,
            observed=y,
            metric=prb.LogLikelihood(error=[0.1, 0.3]),
        )
        optimum = prb.minimize()
    table = prb.residuals(optimum, n_draws=20_000)["y"]
    slope, mu = np.array([1.0, 2.0]), optimum.point["mu"]
    covariance = 0.09 * np.outer(slope, slope) + np.diag([0.01, 0.09])
    squares, is_seen = [], ~np.isnan(y)
    for row, seen in zip(y, is_seen, strict=True):
        r = (row - slope * mu)[seen]
        squares.append(r @ np.linalg.solve(covariance[np.ix_(seen, seen)], r))
    got = np.nansum(table.CWRES.values**2, axis=1)
    yield difference("squares of CWRES", np.sqrt(got), np.sqrt(squares), 0.06)
    yield difference("missing", np.isnan(table.CWRES.values) == is_seen, 0, 0.5)


@problem
def residuals_of_lognormal_inputs_given_a_posterior() -> Differences:
    rng = np.random.default_rng(66)
    logs = rng.normal(1.0, 0.4, 20)
    y = 1e-9 * np.exp(2 * logs)
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0, 10), pm.HalfNormal("sigma", 1.0)
        c = pm.LogNormal.dist(mu, sigma)
        prb.Simulator("y", lambda c: 1e-9 * c**2, c, observed=y)
        idata = prb.sample(random_seed=1)
    table = prb.residuals(idata, model=model, n_draws=4000)["y"]
    grid_mu, grid_sigma, weights = of_normals(logs, 1.0)
    mean = weights @ grid_mu
    # all populations together: the mean variance and the variance of the mean
    variance = weights @ (grid_sigma**2 + (grid_mu - mean) ** 2)
    exact = (logs - mean) / np.sqrt(variance)
    yield difference("CWRES", table.CWRES.values.ravel(), exact, 0.06)
    yield difference("IPRED", table.IPRED.values.ravel(), y, 1e-3 * y)


def bandwidth(z: Any, factor: float = 1.8, power: float = 0.2) -> float:
    """Return the kernel's bandwidth of measured values."""
    quartiles = np.quantile(z, [0.25, 0.75], method="hazen")
    return float(factor * min(z.std(), np.ptp(quartiles) / 1.34) * z.size**-power)


def minimiser(loss: Any, start: Any) -> Any:
    """Return the minimiser of a loss of a mean and the logarithm of a spread."""
    found = optimize.minimize(
        loss, start, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-12}
    )
    return np.array([found.x[0], np.exp(found.x[1])])


def by_metric(response: Any, observed: Any, metric: Any, scale: float = 1.0) -> Any:
    """Return the optimum of a normal population under a metric."""
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 10 * scale), pm.HalfNormal("sigma", 5 * scale)
        prb.Simulator("y", response, pm.Normal.dist(mu, sigma), metric=metric, observed=observed)
        return prb.minimize()


@problem
def minima_of_metrics_of_a_line_in_nanounits() -> Differences:
    x = np.random.default_rng(71).normal(3.0, 1.0, 14)
    y, h = 1e-9 * x, bandwidth(x)
    nodes = stats.norm.ppf((np.arange(4000) + 0.5) / 4000)

    def residual(at: Any) -> float:
        spread = np.sqrt(np.exp(2 * at[1]) + h**2)
        own = stats.norm(0, np.sqrt(2) * spread).pdf(0)
        return float(own - 2 * stats.norm(at[0], np.hypot(spread, h)).pdf(x).mean())

    def area(at: Any) -> float:
        return float(stats.wasserstein_distance(at[0] + np.exp(at[1]) * nodes, x))

    start = [x.mean(), np.log(x.std())]
    exact = {
        prb.KullbackLeibler(): np.array([x.mean(), x.std()]),
        prb.ProbabilityResidual(): minimiser(residual, start),
        prb.AreaMetric(): minimiser(area, start),
    }
    for metric, values in exact.items():
        optimum = by_metric(lambda a: 1e-9 * a, y, metric)
        sds = x.std() / np.sqrt([14, 28])
        got = [optimum.point["mu"], optimum.point["sigma"]]
        yield difference(type(metric).__name__, got, values, 0.1 * sds)


@problem
def minima_of_metrics_of_a_curve() -> Differences:
    x = np.random.default_rng(72).normal(0.0, 0.7, 25)
    y, nodes = np.exp(x), stats.norm.ppf((np.arange(4000) + 0.5) / 4000)
    h = bandwidth(y)
    grid = np.linspace(y.min() - 8 * h, y.max() + 12 * h, 601)
    q = stats.norm(y, h).pdf(grid[:, None]).mean(axis=1)

    def density(at: Any) -> Any:
        values = np.exp(at[0] + np.exp(at[1]) * nodes[::4])
        return stats.norm.pdf(grid[:, None], values, h).mean(axis=1)

    def residual(at: Any) -> float:
        return float(np.trapezoid((density(at) - q) ** 2, grid))

    def divergence(at: Any) -> float:
        return float(np.trapezoid(q * np.log(q / (density(at) + 1e-12)), grid))

    def area(at: Any) -> float:
        return float(stats.wasserstein_distance(np.exp(at[0] + np.exp(at[1]) * nodes), y))

    losses = {
        prb.ProbabilityResidual(): residual,
        prb.KullbackLeibler(): divergence,
        prb.AreaMetric(): area,
    }
    for metric, loss in losses.items():
        optimum = by_metric(np.exp, y, metric)
        values = minimiser(loss, [x.mean(), np.log(x.std())])
        got = [optimum.point["mu"], optimum.point["sigma"]]
        allowed = 0.1 * x.std() / np.sqrt([25, 50])
        yield difference(type(metric).__name__, got, values, allowed)


@problem
def posterior_of_a_divergence_of_few_specimens() -> Differences:
    # the minimiser is the mean and the standard deviation, which are sufficient
    x = np.random.default_rng(73).normal(2.0, 0.5, 8)
    _, _, idata = normal_population(x, lambda a: 1e6 * a, metric=prb.KullbackLeibler())
    mu, sigma, weights = of_normals(x)
    yield from moments(idata.posterior, {"mu": mu, "sigma": sigma}, weights)


def draws_of_abc(metric: Any, response: Any, y: Any, epsilon: float, n: int = 512) -> Any:
    """Return draws of the pseudo-posterior of a normal mean with spread .5 and prior N(0, 2)."""
    with pm.Model():
        mu = pm.Normal("mu", 0.0, 2.0)
        prb.Simulator(
            "y",
            response,
            pm.Normal.dist(mu, 0.5),
            metric=metric,
            observed=y,
            epsilon=epsilon,
            propagation=prb.Reweighted(n),
        )
        return prb.sample_smc(1000, adjustment=None, random_seed=1).posterior


def of_kernel(loss: Any, epsilon: float, low: float = -3.0, high: float = 5.0) -> Any:
    """Return a grid and weights of the prior N(0, 2) times exp(-loss / epsilon)."""
    return on_grid(
        lambda mu: stats.norm(0, 2).logpdf(mu) - np.array([loss(m) for m in mu]) / epsilon,
        mu=np.linspace(low, high, 801),
    )


@problem
def abc_by_an_area_in_millions() -> Differences:
    x = np.random.default_rng(74).normal(1.0, 0.6, 11)
    nodes = 0.5 * stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
    for epsilon in (0.05, 0.5):
        draws = draws_of_abc(prb.AreaMetric(), lambda a: 1e6 * a, 1e6 * x, 1e6 * epsilon)

        def loss(mu: Any) -> float:
            return float(stats.wasserstein_distance(mu + nodes, x))

        yield from moments(draws, *of_kernel(loss, epsilon))


@problem
def abc_of_a_fold_by_residuals() -> Differences:
    x = np.random.default_rng(75).normal(1.2, 0.5, 15)
    y, nodes = x**2, 0.5 * stats.norm.ppf((np.arange(800) + 0.5) / 800)
    metric = prb.ProbabilityResidual()

    def loss(mu: Any) -> float:
        return float(metric((mu + nodes) ** 2, y))

    draws = draws_of_abc(metric, np.square, y, 0.02)
    grid, weights = of_kernel(loss, 0.02, -4.0, 4.0)
    yield from moments({"mu": np.abs(draws["mu"])}, {"mu": np.abs(grid["mu"])}, weights)
    share = float((draws["mu"] > 0).mean())
    yield difference("share of the positive mode", share, weights[grid["mu"] > 0].sum(), 0.1)


@problem
def abc_by_a_function_of_means() -> Differences:
    x = np.random.default_rng(76).normal(1.5, 0.5, 6)

    def squared(simulated: Any, observed: Any, weights: Any) -> Any:
        return ((simulated * weights).sum(axis=-1) - observed.mean()) ** 2

    metric = prb.FunctionMetric(squared, weighted=True)
    draws = draws_of_abc(metric, np.positive, x, 0.08, 1024)["mu"]
    precision = 1 / 4 + 2 / 0.08
    mean, sd = 2 / 0.08 * x.mean() / precision, precision**-0.5
    yield difference("mean", float(draws.mean()), mean, 0.1 * sd)
    yield difference("sd", float(draws.std()), sd, 0.1 * sd)


@problem
def function_of_moments_with_refits() -> Differences:
    x = np.random.default_rng(77).normal(2.0, 0.4, 40)

    def of_moments(simulated: Any, observed: Any, weights: Any) -> Any:
        mean = (simulated * weights).sum(axis=-1)
        square = (simulated**2 * weights).sum(axis=-1)
        deviation = np.sqrt(np.maximum(square - mean**2, 0)) - observed.std()
        return (mean - observed.mean()) ** 2 + deviation**2

    metric = prb.FunctionMetric(of_moments, weighted=True)
    optimum = by_metric(np.positive, x, metric)
    sds = x.std() / np.sqrt([40, 80])
    got = [optimum.point["mu"], optimum.point["sigma"]]
    yield difference("minimum", got, [x.mean(), x.std()], 0.1 * sds)
    got = [optimum.stderr["mu"], optimum.stderr["sigma"]]
    yield difference("standard errors", got, sds, 0.15 * sds)


@problem
def joint_divergence_of_correlated_outputs() -> Differences:
    rng = np.random.default_rng(78)
    covariance = np.array([[0.25, 0.3], [0.3, 1.0]])
    x = rng.multivariate_normal([1.0, -2.0], covariance, 40)
    units = np.array([1e6, 1e-9])
    with pm.Model():
        mu = pm.Normal("mu", 0.0, 5.0, shape=2)
        sd = pm.HalfNormal("sd", 2.0, shape=2)
        rho = pm.Uniform("rho", -1, 1)
        matrix = pm.math.stack(
            [sd[0] ** 2, rho * sd[0] * sd[1], rho * sd[0] * sd[1], sd[1] ** 2]
        ).reshape((2, 2))
        dist = pm.MvNormal.dist(mu, matrix, shape=2)
        prb.Simulator(
            "y",
            lambda a: a * units,
            dist,
            metric=prb.Joint(prb.KullbackLeibler()),
            observed=x * units,
        )
        optimum = prb.minimize()
    exact = np.cov(x.T, bias=True)
    sds = np.sqrt(np.diag(exact))
    rho_exact = exact[0, 1] / sds.prod()
    yield difference("means", optimum.point["mu"], x.mean(axis=0), 0.1 * sds / np.sqrt(40))
    yield difference("sds", optimum.point["sd"], sds, 0.1 * sds / np.sqrt(80))
    error = (1 - rho_exact**2) / np.sqrt(40)
    yield difference("correlation", optimum.point["rho"], rho_exact, 0.1 * error)


@dataclass(frozen=True)
class SquaredDensities(prb.Metric):
    """The integral of the squared difference of two densities, without a scale."""

    density: prb.GaussianKDE = field(default_factory=prb.GaussianKDE)
    minimum: ClassVar[prb.metrics.Minimum] = prb.metrics.Minimum.QUADRATIC
    additive: ClassVar[bool] = False

    def _prepare(self, observed: Any, weights: Any) -> Any:
        cells = self.density.cells(observed, weights)
        return SquaredDifference.on_cells(self, observed, weights, cells)


class SquaredDifference(prb.metrics.DensityDiscrepancy):
    """The integral against fixed observed values."""

    def outer(self, *features: Any, xp: Any) -> Any:
        return (xp.square(features[0] - self.density) * self.cells.widths).sum(axis=-1)


@problem
def metric_of_ones_own_with_a_quadratic_minimum() -> Differences:
    x = np.random.default_rng(79).normal(0.5, 0.5, 30)
    own = by_metric(np.exp, np.exp(x), SquaredDensities())
    built_in = by_metric(np.exp, np.exp(x), prb.ProbabilityResidual())
    for name in ("mu", "sigma"):
        sd = built_in.stderr[name]
        yield difference(f"estimate of {name}", own.point[name], built_in.point[name], 0.02 * sd)
        yield difference(f"standard error of {name}", own.stderr[name], sd, 0.15 * sd)


def calibrated_ranks(metric: Any, response: Any, n: int) -> Any:
    """Return ranks of a normal mean with the prior N(1, 2) of 8 specimens with the spread 1."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.0, 2.0), 1.0)
        arguments = {} if metric is None else {"metric": metric}
        observed = response(np.linspace(0.0, 2.0, 8))
        prb.Simulator("y", response, x, observed=observed, **arguments)
    return prb.simulation_based_calibration(n, model=model, draws=400, random_seed=1)


def rank_differences(ranks: Any, name: str, sd: float, n: int) -> Differences:
    """Yield differences of ranks from uniform ones, and of standard deviations."""
    values = ranks.prior_sbc[name].values.ravel()
    yield difference("mean rank", values.mean(), 0.5, 3.5 * np.sqrt(1 / 12 / n))
    yield difference("variance of ranks", values.var(), 1 / 12, 3.5 * np.sqrt(1 / 180 / n))
    yield difference("posterior sds", ranks.posterior_sd[name].values, sd, 0.25 * sd)


@problem
def ranks_of_a_likelihood() -> Differences:
    ranks = calibrated_ranks(None, np.sinh, 40)
    yield from rank_differences(ranks, "mu", (8 + 1 / 4) ** -0.5, 40)
    truth = ranks.truth["mu"].values
    yield difference("truths", truth.mean(), 1.0, 3.5 * 2 / np.sqrt(40))


@problem
def ranks_of_a_divergence() -> Differences:
    ranks = calibrated_ranks(prb.KullbackLeibler(), lambda x: 1e-9 * x, 25)
    yield from rank_differences(ranks, "mu", (8 + 1 / 4) ** -0.5, 25)


@problem
def ranks_of_a_gamma_population_with_labels() -> Differences:
    rng = np.random.default_rng(80)
    with pm.Model() as model:
        rate = pm.Gamma("rate", 5.0, 5.0)
        load = pm.Gamma.dist(3.0, rate)
        labels, loads = [f"specimen {i}" for i in range(10)], rng.gamma(3.0, 1.0, 10)
        for name, response in (("y", np.sqrt), ("z", np.log)):
            # an error makes two readings of a specimen possible
            prb.Simulator(
                name,
                response,
                load,
                observed=response(loads),
                specimens=labels,
                metric=prb.LogLikelihood(error=1e-3),
            )
    ranks = prb.simulation_based_calibration(20, model=model, draws=400, random_seed=1)
    # the posterior is a gamma distribution with shape 5 + 30, whose mean is near the truth
    truth = ranks.truth["rate"].values.ravel()
    values = ranks.prior_sbc["rate"].values.ravel()
    yield difference("mean rank", values.mean(), 0.5, 3.5 * np.sqrt(1 / 12 / 20))
    shares = ranks.posterior_sd["rate"].values.ravel() / truth
    # of 35 / (5 + sum) with the sum gamma (30): a mean of about sqrt(35) (1 +- .2) / 35
    yield difference("relative sd", shares.mean(), 35**-0.5, 0.2 * 35**-0.5)


@problem
def proposed_runs_beyond_a_table() -> Differences:
    x = np.random.default_rng(81).normal(2.4, 0.1, 20)
    table = np.linspace(1.0, 2.0, 12)
    for turn in range(4):
        with pm.Model() as model:
            mu, sigma = pm.Normal("mu", 2.0, 1.0), pm.HalfNormal("sigma", 0.5)
            dist = pm.Normal.dist(mu, sigma, name="x")
            prb.Simulator("y", prb.Runs({"x": table}, 1e6 * table**2), dist, observed=1e6 * x**2)
        if table.max() > x.max() + 0.1 and turn > 1:
            break
        added = prb.propose_runs(model)["x"].to_numpy()
        yield difference(
            "distance of proposals", max(added.max() - 3.5, 1.0 - added.min(), 0), 0, 1
        )
        table = np.unique(np.concatenate([table, added]))
    idata = prb.sample(model=model, random_seed=1)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(x).sum(axis=1)
        return logs + stats.norm(2, 1).logpdf(mu) + stats.halfnorm(scale=0.5).logpdf(sigma)

    grid, weights = on_grid(
        log_posterior, mu=np.linspace(2.2, 2.6, 301), sigma=np.linspace(0.04, 0.3, 301)
    )
    yield from moments(idata.posterior, grid, weights)


@problem
def proposed_runs_of_two_inputs_in_odd_units() -> Differences:
    rng = np.random.default_rng(82)
    a, b = 1e6 * rng.normal(3.0, 0.3, 15), 1e-9 * rng.normal(2.0, 0.2, 15)

    def response(a: Any, b: Any) -> Any:
        return np.stack([a * b * 1e3, np.log(a) - 1e9 * b / 3], axis=-1)

    runs = np.stack([1e6 * rng.uniform(1, 3, 40), 1e-9 * rng.uniform(1, 2, 40)], axis=1)
    for turn in range(3):
        with pm.Model() as model:
            inputs = (
                pm.Normal.dist(pm.Normal("mu_a", 2e6, 1e6), 0.3e6, name="a"),
                pm.Normal.dist(pm.Normal("mu_b", 1.5e-9, 1e-9), 0.2e-9, name="b"),
            )
            columns = {"a": runs[:, 0], "b": runs[:, 1]}
            table = prb.Runs(columns, response(*runs.T))
            prb.Simulator("y", table, *inputs, observed=response(a, b))
        if turn < 2:
            runs = np.concatenate([runs, prb.propose_runs(model, n=25)[["a", "b"]].to_numpy()])
    idata = prb.sample(model=model, random_seed=1)
    for name, x, prior, known in (
        ("mu_a", a, (2e6, 1e6), 0.3e6),
        ("mu_b", b, (1.5e-9, 1e-9), 2e-10),
    ):
        precision = 15 / known**2 + prior[1] ** -2
        mean = (x.sum() / known**2 + prior[0] / prior[1] ** 2) / precision
        draws = idata.posterior[name].values
        sd = precision**-0.5
        yield difference(f"mean of {name}", draws.mean(), mean, 0.1 * sd)
        yield difference(f"sd of {name}", draws.std(), sd, 0.1 * sd)


@problem
def refined_design_under_a_vague_prior() -> Differences:
    x = np.random.default_rng(83).normal(30.0, 0.5, 20)
    response = Counted()
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 20.0), pm.HalfNormal("sigma", 5.0)
        prb.Simulator(
            "y",
            response,
            pm.Normal.dist(mu, sigma),
            0.0,
            metric=prb.AreaMetric(),
            observed=1e6 * np.exp(x),
            propagation=prb.Reweighted(256),
        )
        sizes = prb.refine(model)
        optimum = prb.minimize()
    yield difference("runs", response.count, sizes["y"], 64)
    nodes = stats.norm.ppf((np.arange(4000) + 0.5) / 4000)

    def area(at: Any) -> float:
        return float(
            stats.wasserstein_distance(np.exp(at[0] + np.exp(at[1]) * nodes - 30), np.exp(x - 30))
        )

    exact = minimiser(area, [x.mean(), np.log(x.std())])
    got = [optimum.point["mu"], optimum.point["sigma"]]
    yield difference("optimum", got, exact, 0.1 * x.std() / np.sqrt([20, 40]))
