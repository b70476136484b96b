from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.stats import norm, wasserstein_distance

from prbayes._checks import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Minimum
from prbayes.metrics.density import GaussianKDE, Histogram, likelihood_bandwidth
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.function import FunctionMetric
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.residual import ProbabilityResidual

H, INF, NAN = 0.4, np.inf, np.nan
PYTHON = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")


def make(h: float = H) -> dict[str, Any]:
    return {
        "area": AreaMetric(),
        "pr": ProbabilityResidual(GaussianKDE(h)),
        "pr-bins": ProbabilityResidual(Histogram(7)),
        "kl": KullbackLeibler(GaussianKDE(h)),
        "kl-reverse": KullbackLeibler(GaussianKDE(h), reverse=True),
        "kl-bins": KullbackLeibler(Histogram(7)),
        "ll": LogLikelihood(GaussianKDE(h)),
        "ll-bins": LogLikelihood(Histogram(7)),
    }


METRICS = make()
every = pytest.mark.parametrize("name", METRICS)


def normal(mu: float, sd: float, n: int = 4000) -> Floats:
    return mu + sd * norm.ppf((np.arange(n) + 0.5) / n)  # hardly any tails: hence the tolerances


def draw(seed: int, n: int = 23, n_observed: int = 17) -> tuple[Floats, Floats, Floats, Floats]:
    rng = np.random.default_rng(seed)
    w, u = rng.dirichlet(np.ones(n)), rng.dirichlet(np.ones(n_observed))
    return rng.normal(0.3, 1.2, n), w, rng.normal(size=n_observed), u


@pytest.mark.parametrize("d", [0.0, 0.3, -2.0, 50.0])
@pytest.mark.parametrize("s", [1.0, 0.5, 3.0])
def test_area_between_normals(d: float, s: float) -> None:
    np.testing.assert_allclose(AreaMetric()(normal(d, s), normal(0, s)), abs(d), rtol=1e-12, atol=1e-14)
    expected = abs(s - 1) * np.sqrt(2 / np.pi)
    np.testing.assert_allclose(AreaMetric()(normal(d, s, 3000), normal(d, 1)), expected, rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize("case", [(0, 1, 0, 1.3), (0.5, 1, 0, 1), (-0.8, 0.8, 0.2, 1), (1, 1.2, 0, 1)])
@pytest.mark.parametrize("h", [0.4, 0.6])
@pytest.mark.parametrize("a", [1e-3, 1.0, 70.0])
def test_densities_of_normals(case: tuple[float, ...], h: float, a: float) -> None:
    m, s, mu, sd = case
    x, z = a * normal(m, s, 100_000), a * normal(mu, sd, 99_000)
    h, vp, vq, d = a * h, a**2 * (s**2 + h**2), a**2 * (sd**2 + h**2), a * (m - mu)
    expected = {
        "pr": (vp**-0.5 + vq**-0.5) / np.sqrt(4 * np.pi) - 2 * norm.pdf(d, 0, np.sqrt(vp + vq)),
        "kl": (vq + d**2) / (2 * vp) - 0.5 + np.log(vp / vq) / 2,
        "kl-reverse": (vp + d**2) / (2 * vq) - 0.5 + np.log(vq / vp) / 2,
        "ll": np.log(2 * np.pi * vp) / 2 + (a**2 * sd**2 + d**2) / (2 * vp),
    }
    for name, value in expected.items():
        metric = make(h)[name].against(z)
        result = metric(x) / (metric.scale_factor if name == "pr" else 1)
        np.testing.assert_allclose(result, value, rtol=3e-3, err_msg=name)


@pytest.mark.parametrize("seed", range(5))
def test_area_is_the_first_wasserstein_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        x, w, z, u = draw(int(rng.integers(1 << 30)), *rng.integers(1, 40, 2))
        x[: x.size // 2], z[: z.size // 2] = np.round(x[: x.size // 2]), np.round(z[: z.size // 2])  # ties
        area = AreaMetric()(x, z, weights=5 * w, observed_weights=9 * u)
        np.testing.assert_allclose(area, wasserstein_distance(x, z, w, u), rtol=1e-11)
        np.testing.assert_allclose(AreaMetric()(x, z), wasserstein_distance(x, z), rtol=1e-11)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("h", [0.2, 1.0])
def test_residual_is_a_squared_maximum_mean_discrepancy(seed: int, h: float) -> None:
    x, w, z, u = draw(seed, 5 + 3 * seed, 9)
    x = np.clip(x, z.min() - h / 2, z.max() + h / 2)  # well inside the grid
    y, v = np.r_[x, z], np.r_[w, -u]
    d = make(h)["pr"].against(z, u)
    expected = d.scale_factor * v @ norm.pdf(y, y[:, None], np.sqrt(2) * h) @ v
    np.testing.assert_allclose(d(x, w), expected, rtol=1e-4)


@every
@pytest.mark.parametrize("seed", range(5))
def test_zero_on_itself_and_positive_elsewhere(name: str, seed: int) -> None:
    x, w, z, u = draw(seed)
    d = METRICS[name].against(z, u)
    at_itself = d(z[::-1], u[::-1])
    assert at_itself < d(z + 4, u)
    if not name.startswith("ll"):
        assert at_itself == pytest.approx(0, abs=1e-13)
        assert min(d(x, w), d(z + 0.3, u)) > 1e-4


@every
@pytest.mark.parametrize("shift", [-3.3, 250.0])
@pytest.mark.parametrize("a", [1.0, 0.01, 37.0, -1.0, -2.0])
def test_shift_scale_sign_and_order(name: str, shift: float, a: float) -> None:
    x, w, z, u = draw(2)
    x /= 2  # well inside the grid, whose ends depend on the sign
    i, j = (np.random.default_rng(3).permutation(v.size) for v in (x, z))
    before, after = METRICS[name].against(z, u), make(abs(a) * H)[name].against(a * z[j] + shift, u[j])
    expected = before(x, w)
    rtol = 1e-4 if a < 0 and before.metric.minimum is Minimum.QUADRATIC and "bins" not in name else 1e-8
    if name == "area":
        expected *= abs(a)
    elif name in ("pr", "pr-bins"):
        factor = after.scale_factor / before.scale_factor / abs(a) ** (1 if name == "pr" else 2)
        expected *= factor
        np.testing.assert_allclose(after.scale, before.scale * factor, rtol=rtol)
    elif name in ("ll", "ll-bins"):
        expected += np.log(abs(a))
    np.testing.assert_allclose(after(a * x[i] + shift, w[i]), expected, rtol=rtol)


@pytest.mark.parametrize(("sd", "power"), [(8e-5, 3), (80.0, -3), (0.08, 0), (0.3, 0), (0.03, 1)])
@pytest.mark.parametrize("base", [100.0, 10.0, 1.0])
def test_scale_factor(sd: float, power: int, base: float) -> None:
    z = normal(5, sd)
    d, plain = (ProbabilityResidual(GaussianKDE(sd / 50), scale_base=c).against(z) for c in (base, 1))
    assert 10**power <= d.density.max() < 10 ** (power + 1)
    assert d.scale_factor == pytest.approx(base**-power)
    np.testing.assert_allclose(d(z + sd), plain(z + sd) * base**-power, rtol=1e-12)
    np.testing.assert_allclose(d.scale, d(np.full(3, INF)) - d.scale_factor / d.cells.widths[-1], rtol=1e-10)


@every
@pytest.mark.parametrize("seed", range(3))
def test_integer_weights_are_repetitions(name: str, seed: int) -> None:
    x, _, z, _ = draw(seed)
    k, j = np.arange(x.size) % 4, 1 + np.arange(z.size) % 3
    weighted, repeated = METRICS[name].against(z, j), METRICS[name].against(np.repeat(z, j))
    expected = repeated(np.repeat(x, k))
    np.testing.assert_allclose(weighted(x, k), expected, rtol=1e-9)
    np.testing.assert_allclose(weighted(np.repeat(x, k)), expected, rtol=1e-9)
    np.testing.assert_allclose(repeated(x, k), expected, rtol=1e-9)
    np.testing.assert_allclose(weighted(np.full(50, 0.5)), weighted([0.5]), rtol=1e-11)
    assert repeated.n_effective == pytest.approx(j.sum())
    assert weighted.n_effective == pytest.approx(j.sum() ** 2 / (j**2).sum())


@every
def test_other_observed_values_keep_the_metric_and_additive_ones_are_means_over_them(name: str) -> None:
    x, w, z, u = draw(14)
    d = make(0.3)[name].against(z, u)
    assert d.with_observed(z, u)(x, w) == d(x, w)
    single = [d.with_observed(z[i : i + 1]) for i in range(z.size)]
    means = [u @ [e(x, v) for e in single] for v in (w, None)]
    additive = np.isclose(means[0] - means[1], d(x, w) - d(x), rtol=1e-9)
    assert additive == d.metric.additive == (name not in ("area", "kl-reverse"))


@every
@pytest.mark.parametrize("batch", [(1,), (4,), (2, 3), (0,)])
def test_batches_equal_a_loop(name: str, batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    x, w = rng.normal(size=(*batch, 9)), rng.dirichlet(np.ones(9), batch)
    d = METRICS[name].against(draw(5)[2])
    one = rng.normal(size=9)
    for values, weights in ((x, np.ones(9)), (x, w), (one, w), (x, np.arange(1.0, 10.0))):
        result = d(values, weights)
        xs, ws = np.broadcast_arrays(values, weights)
        assert result.shape == batch
        np.testing.assert_allclose(result.ravel(), [d(xs[i], ws[i]) for i in np.ndindex(*batch)], rtol=1e-10)
    assert type(d(one)) is float


@every
def test_basis_gives_the_same_discrepancy_in_numpy_and_pytensor_with_its_gradient(name: str) -> None:
    y, w, z, u = draw(6)
    y[:2] = -30, 40
    d = METRICS[name].against(z, u)
    basis = d.basis(y)

    def value(weights: Floats) -> Any:
        return d.outer(*d.from_basis(weights, basis, np), xp=np)

    rows = np.random.default_rng(7).dirichlet(np.ones(y.size), (2, 3))
    np.testing.assert_allclose(value(rows), d(y, rows), rtol=1e-10)
    np.testing.assert_allclose(value(0.9 * w), d.outer(*d.features(y, 0.9 * w, np), xp=np), rtol=1e-10)
    v = pt.vector("v")
    graph = d.outer(*d.from_basis(v, basis, pt), xp=pt)
    result, gradient = pytensor.function([v], [graph, pytensor.grad(graph, v)], mode=PYTHON)(w)
    np.testing.assert_allclose(result, d(y, w), rtol=1e-10)
    e = 1e-7 * np.eye(w.size)
    np.testing.assert_allclose(gradient, (value(w + e) - value(w - e)) / 2e-7, rtol=1e-5, atol=1e-6)


def test_area_of_symbolic_values_and_weights() -> None:
    x, w, z, u = draw(8)
    x[3] = INF
    d = AreaMetric().against(z, u)
    y, v = pt.vector("y"), pt.vector("v")
    graph = d.outer(*d.features(y, v, pt), xp=pt)
    area, slope = pytensor.function([y, v], [graph, pytensor.grad(graph, y)], mode=PYTHON)(x, w)
    np.testing.assert_allclose(area, d(x, w), rtol=1e-12)
    e = 1e-7 * np.eye(x.size)
    np.testing.assert_allclose(slope, (d(x + e, w) - d(x - e, w)) / 2e-7, rtol=1e-5, atol=1e-8)


@every
@pytest.mark.parametrize("away", [1e3, -1e3, 1e300, INF])
def test_disjoint_supports_are_finite_bounded_and_worse(name: str, away: float) -> None:
    x, w, z, u = draw(9)
    d = METRICS[name].against(z, u)
    far = d(x + away, w)
    assert d(x, w) < far < np.inf
    if name.startswith("ll"):
        assert far == pytest.approx(np.log(d.cells.widths.sum() / 1e-9))
    elif name.startswith("kl"):
        assert far <= np.log(max(1, d.density.max()) * d.cells.widths.sum() / 1e-9)


@pytest.mark.parametrize("observed", [[0.1], [0.1, 0.1], np.full(6, 0.1)])
def test_equal_observed_values_need_a_bandwidth_or_the_area(observed: Any) -> None:
    x, w, _, _ = draw(11)
    np.testing.assert_allclose(AreaMetric()(x, observed, weights=w), w @ np.abs(x - 0.1), rtol=1e-12)
    assert AreaMetric().against(observed).scale == 1
    expected = -np.log(w @ norm.pdf(x, 0.1, H))
    np.testing.assert_allclose(METRICS["ll"](x, observed, weights=w), expected, rtol=1e-3)
    for metric in (ProbabilityResidual(), KullbackLeibler(), LogLikelihood()):
        with pytest.raises(ValueError, match=r"bandwidth: got 0 .*GaussianKDE\(bandwidth=.*AreaMetric"):
            metric(x, observed)


def test_failed_specimens_count_below_and_their_infinite_interval_is_left_out() -> None:
    # F: 1/4 from 0, 1/2 from 2; S: 1/2 from 1, 1 from 3. |F - S|: 1/4 on (0, 1), 1/4 on (1, 2), 0, then none.
    assert AreaMetric()([0.0, INF, 2.0, INF], [1.0, 3.0]) == pytest.approx(0.5)
    assert AreaMetric()([0.0, INF], [1.0, 3.0], weights=[1, 3]) == pytest.approx(0.25 + 2 * 0.25)
    assert AreaMetric()([INF, INF], [1.0, 3.0, 8.0]) == pytest.approx(8 - 4)


def test_attributes() -> None:
    z = np.array([0.0, 1.0, 5.0])
    assert [AreaMetric().against(z, u).scale for u in (None, [1, 0, 1])] == pytest.approx([2, 2.5])
    assert LogLikelihood().against(z).scale == KullbackLeibler().against(z).scale == 1
    default = (ProbabilityResidual().scale_base, LogLikelihood().density)
    assert default == (100, GaussianKDE(likelihood_bandwidth))
    flags = [(METRICS[name].minimum, METRICS[name].likelihood) for name in ("area", "pr", "kl", "ll")]
    assert flags == [
        (Minimum.ABSOLUTE, False),
        (Minimum.QUADRATIC, False),
        (Minimum.QUADRATIC, True),
        (Minimum.QUADRATIC, True),
    ]


OK = [0.0, 1.0, 3.0]
BAD: dict[str, tuple[str, Any, type[Exception]]] = {
    "observed: got 1 NaN or infinite among 3": ("observed", [0.0, NAN, 1.0], ValueError),
    "observed: got no values": ("observed", [], ValueError),
    r"observed: got an array of shape \(2, 2\)": ("observed", np.ones((2, 2)), ValueError),
    "observed: got an array of dtype <U1": ("observed", ["a", "b"], TypeError),
    r"observed weights: got shape \(2, 3\), expected \(3,\)": ("observed_weights", [OK, OK], ValueError),
    "simulated: got NaN or -inf": ("simulated", [0.0, -INF], ValueError),
    r"weights: got shape \(2,\), expected \(..., 3\)": ("weights", [1, 1], ValueError),
    "weights: got weights that sum to zero": ("weights", [0, 0, 0], ValueError),
}


@every
@pytest.mark.parametrize("match", BAD)
def test_bad_inputs(name: str, match: str) -> None:
    argument, value, error = BAD[match]
    with pytest.raises(error, match=f"^{match}"):
        METRICS[name](**{"simulated": OK, "observed": OK, argument: value})


def mean_difference(simulated: Any, observed: Any, weights: Any = None) -> Any:
    return np.abs(np.average(simulated, axis=-1, weights=weights) - observed.mean())


def test_function_metric() -> None:
    x, _, z, _ = draw(12)
    plain, d = FunctionMetric(mean_difference), FunctionMetric(mean_difference, weighted=True).against(z)
    assert plain(x, z) == pytest.approx(abs(x.mean() - z.mean()))
    rows = np.random.default_rng(13).dirichlet(np.ones(x.size), (2, 3))
    np.testing.assert_allclose(d(x, rows), np.abs(rows @ x - z.mean()), rtol=1e-12)
    np.testing.assert_allclose(d.outer(*d.from_basis(rows, d.basis(x), np), xp=np), d(x, rows), rtol=1e-12)
    assert (plain.minimum, plain.likelihood, d.scale) == (Minimum.UNKNOWN, False, 1.0)


def test_wrong_settings() -> None:
    with pytest.raises(ValueError, match="scale_base: got 0, expected a positive finite number"):
        ProbabilityResidual(scale_base=0)
    with pytest.raises(TypeError, match=r"function: got float, expected f\(simulated, observed\)"):
        FunctionMetric(3.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"shape \(3,\) .*expected \(\); reduce over"):
        FunctionMetric(lambda x, z: x)(OK, OK)
    with pytest.raises(ValueError, match=r"shape \(\) .*expected \(2,\); reduce over"):
        FunctionMetric(lambda x, z: 0.0)([OK, OK], OK)
    with pytest.raises(ValueError, match=r"weights: got unequal .*pass weighted=True"):
        FunctionMetric(mean_difference)(OK, OK, weights=[1, 2, 3])
    with pytest.raises(ValueError, match="observed weights: got unequal"):
        FunctionMetric(mean_difference).against(OK, [1, 2, 3])
