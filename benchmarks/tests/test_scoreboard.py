"""The scoreboard: problems without prbayes, exact references, the score, studies that go on."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.special import gammaln

from benchmarks.scoreboard import exact, study, table
from benchmarks.scoreboard.problem import (
    Input,
    Problem,
    Reference,
    Response,
    capped,
    components,
    half_normal,
    normal,
    statistics,
    truncated,
    uniform,
)
from benchmarks.scoreboard.problems import (
    PROBLEMS,
    contaminated,
    crack_growth,
    folded,
    frame,
    growth,
    linear,
    tension_304l,
    three_masses,
    virkler,
    wrong_family,
)
from benchmarks.scoreboard.score import score, summary

ROOT = Path(__file__).parents[2]
EVERY = pytest.mark.parametrize("name", sorted(PROBLEMS))


def test_problems_need_numpy_and_scipy_alone() -> None:
    code = (
        "import sys; from benchmarks.scoreboard import study, score;"
        "print({'prbayes', 'pymc', 'pytensor', 'arviz', 'xarray', 'pandas'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "set()\n"


@EVERY
def test_a_problem_is_whole(name: str) -> None:
    problem = PROBLEMS[name]
    rng = np.random.default_rng(1)
    drawn = problem.prior_draws(rng, 3)
    told = problem.told(drawn)
    for size in problem.sizes:
        observed = problem.data(size, 0)
        assert len(observed) == size
        assert np.isfinite(observed).all()
        assert np.array_equal(observed, problem.data(size, 0)), "data are the same at every call"
        # Populations are simulated in one call, and a run is a specimen.
        response = Response(problem)
        z = rng.standard_normal((3, size, len(problem.inputs)))
        assert response(*problem.population(drawn, z)).shape == (3, *observed.shape)
        assert response.runs == 3 * size
    reference = problem.reference(problem.sizes[0], 0)
    assert set(reference.center) == set(reference.sd) == set(told)
    assert min(reference.sd.values()) > 0
    if problem.replicates > 1:
        assert problem.truth is not None
        assert set(problem.truth) == set(told)
        assert not np.array_equal(problem.data(size, 0), problem.data(size, 1))
    assert problem.licence


# Of `growth` a reference takes ten seconds; the centre of the wrong family's is the truth.
REPLICATED = [n for n, p in PROBLEMS.items() if p.replicates > 1]
REPLICATED = [name for name in REPLICATED if name not in ("growth", "wrong family")]


@pytest.mark.long
@pytest.mark.parametrize("name", REPLICATED)
def test_the_reference_is_of_the_data(name: str) -> None:
    # Over twenty data sets the exact posterior has the truth within its spread: the mean of squares
    # is 1 with a standard error of .3, twice that for ends of ranges, which are exponential.
    problem = PROBLEMS[name]
    truth = problem.truth
    assert truth is not None
    squares = []
    for replicate in range(20):
        reference = problem.reference(problem.sizes[0], replicate)
        squares += [((reference.center[k] - truth[k]) / reference.sd[k]) ** 2 for k in truth]
    assert 0.3 < np.mean(squares) < 2.5


def test_the_grid_has_the_posterior_of_a_normal_population_in_closed_form() -> None:
    x = np.random.default_rng(1).normal(3, 2, 12)
    priors = {"mu": uniform(-400.0, 400.0), "sigma": uniform(0.0, 400.0)}
    found = exact.posterior(priors, exact.normal_log_likelihood(x))
    n, s = len(x), ((x - x.mean()) ** 2).sum()
    mean = np.sqrt(s / 2) * np.exp(gammaln((n - 3) / 2) - gammaln((n - 2) / 2))
    assert found.center["mu"] == pytest.approx(x.mean(), abs=1e-3)
    assert found.sd["mu"] == pytest.approx(np.sqrt(s / (n * (n - 4))), rel=2e-3)
    assert found.center["sigma"] == pytest.approx(mean, rel=2e-3)
    assert found.sd["sigma"] == pytest.approx(np.sqrt(s / (n - 4) - mean**2), rel=5e-3)


def test_the_posterior_of_the_ends_of_a_range_is_of_lomax() -> None:
    case = three_masses.SEPARATED
    found = three_masses.reference(case, 50, 0)
    springs = three_masses.springs(case, 50, 0)[:, 1]
    width, alpha = np.ptp(springs), 48
    sd = width / (alpha - 1) * np.sqrt(alpha / (alpha - 2))
    assert found.center["low2"] == pytest.approx(springs.min() - width / (alpha - 1), abs=0.06 * sd)
    assert found.center["high2"] == pytest.approx(
        springs.max() + width / (alpha - 1), abs=0.06 * sd
    )
    assert found.sd["low2"] == pytest.approx(sd, rel=0.03)


def test_the_folded_density_integrates_to_one() -> None:
    def density(y: float) -> float:
        log = folded.log_likelihood(np.array([y]), np.array([1.8]), np.array([0.6]))
        return float(np.exp(log[0]) / (2 * np.sqrt(2 * np.pi * y)))

    assert quad(density, 0, 1)[0] + quad(density, 1, 40)[0] == pytest.approx(1, abs=1e-6)
    assert np.allclose(folded.PROBLEM.formula(np, np.array([0.5, 1.5])), 0.25)


@pytest.mark.parametrize("dose", growth.DOSES)
def test_active_receptors_are_those_of_the_rate_equations(dose: float) -> None:
    k1, gain = 1.7, growth.UNBINDING + growth.INTERNALISATION
    # With a constant third state, whose product with the degradation rate is the production.
    rates = [
        [-k1 * dose - growth.DEGRADATION, growth.UNBINDING, growth.DEGRADATION],
        [k1 * dose, -gain, 0.0],
        [0.0, 0.0, 0.0],
    ]
    states = expm(growth.TIME * np.array(rates)) @ [0.0, 0.0, 1.0]
    assert growth.active_share(np, k1, dose) == pytest.approx(states[1], rel=1e-12)
    # Their density integrates to one.
    low, high = 6.5e5 * growth.active_share(np, np.array([0.75, 2.7]), dose)
    y = np.linspace(low, high, 2001)
    log_p = growth.log_density(y, dose, np.array([[6.5e5, 77.0, 1.7, 0.2]]))
    assert np.trapezoid(np.exp(log_p[0]), y) == pytest.approx(1, abs=1e-5)


def test_responses_are_what_they_say() -> None:
    # Paris' law of crack growth is inverted, and a specimen that has failed is infinite.
    c = np.array([2.0, 3.5, 13.0])
    lengths = crack_growth.formula(np, c)
    assert np.allclose(crack_growth.coefficients(lengths[:2]), c[:2])
    assert np.isinf(lengths[2])
    # At 20 mm a crack grows by the rate.
    t = np.array([150.0, 150.001])
    a = virkler.growth(np, -2.0, 3.5, t)
    assert np.diff(a)[0] / 1e-3 == pytest.approx(np.exp(-2.0) * (a[0] / 20) ** 1.75, rel=1e-3)
    # Frequencies and shape of a frame, by its matrix.
    lower, upper = 900.0, 700.0
    values, vectors = np.linalg.eigh([[lower + upper, -upper], [-upper, upper]])
    shape = np.abs(vectors[:, 0])
    first, second, share = frame.formula(np, np.array(lower), np.array(upper))
    assert np.allclose([first, second], np.sqrt(values) / 2 / np.pi)
    assert share == pytest.approx(shape[1] / shape.sum())
    assert np.isnan(frame.formula(np, np.array(-1.0), np.array(upper))[0])


def _by_matrix(case: three_masses.Case, springs: Any) -> Any:
    """Return eigenvalues and the first mode's first component of three masses, by linear algebra."""
    k = dict(case.fixed) | dict(zip(case.uncertain, springs, strict=True))
    stiffness = [
        [k[1] + k[4] + k[6], -k[4], -k[6]],
        [-k[4], k[2] + k[4] + k[5], -k[5]],
        [-k[6], -k[5], k[3] + k[5] + k[6]],
    ]
    root = 1 / np.sqrt(case.masses)
    values, vectors = np.linalg.eigh(np.array(stiffness) * root * root[:, None])
    first = vectors[:, 0] * root
    return [*values, abs(first[0]) / np.linalg.norm(first)]


@pytest.mark.parametrize("case", [three_masses.SEPARATED, three_masses.CLOSE])
def test_three_masses_are_those_of_their_matrices(case: three_masses.Case) -> None:
    low, high = np.transpose(case.box)
    springs = np.random.default_rng(1).uniform(low, high, (20, 3))
    found = np.stack(three_masses.formula(case, np, *springs.T), axis=-1)
    assert np.allclose(found, [_by_matrix(case, one) for one in springs], rtol=1e-10)


@EVERY
def test_a_formula_takes_pytensor(name: str) -> None:
    import pytensor.tensor as pt

    problem = PROBLEMS[name]
    drawn = problem.prior_draws(np.random.default_rng(1), 1)
    inputs = problem.population(drawn, np.full((1, 1, len(problem.inputs)), 0.2))
    expected = problem.formula(np, *inputs)
    found = problem.formula(pt, *map(pt.as_tensor_variable, inputs))
    if type(expected) is not list:
        found, expected = [found], [expected]
    for one, value in zip(found, expected, strict=True):
        assert np.allclose(one.eval(mode="FAST_COMPILE"), value)


def test_real_data_are_those_of_the_package() -> None:
    from prbayes import datasets

    crack = datasets.crack_growth()
    lengths = crack.crack_length_inch.sel(million_cycles=0.05) / crack.notch_inch
    assert np.allclose(crack_growth.data(21, 0), lengths)
    at = datasets.virkler().half_crack_length_mm.sel(kilocycles=list(virkler.TIMES[:2]))
    assert np.allclose(virkler.data(68, 0)[:, :2], at)
    assert PROBLEMS["thermal"].data(20, 0).std(ddof=1) == pytest.approx(39511, abs=1)


def test_tension_curves_are_fitted_and_thinned(tmp_path: Path) -> None:
    two = np.array([[33.0, 90.0], [30.0, 80.0]])
    curves = np.stack(tension_304l.formula(np, *two.T), axis=-1)
    assert np.allclose(curves[:, 0], two[:, 0]), "the first stress is the yield"
    assert np.allclose(tension_304l.fits(curves), two)
    # The fits are 0.16 ksi off, as the page of the problem says.
    measured = tension_304l.data(8, 0)
    fitted = np.stack(tension_304l.formula(np, *tension_304l.fits(measured).T), axis=-1)
    assert np.sqrt(((fitted - measured) ** 2).mean()) == pytest.approx(0.158, abs=5e-4)
    # A file whose stress is 30 ksi and 100 times the plastic strain, which comes back once.
    plastic = np.array([0, 0.001, 0.0008, 0.01, 0.05, 0.2, 0.3])
    stress = 30 + 100 * plastic
    stress[-1] = 20.0  # behind the largest load
    strain = plastic + stress / tension_304l.MODULUS
    lines = ["{'engineering_strain_rate':0.01 }", "time, engineering_strain, engineering_stress"]
    lines += [f"0,{e!r},{s!r}" for e, s in zip(strain.tolist(), stress.tolist(), strict=True)]
    path = tmp_path / "cleaned_one.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    name, size, rate, *found = tension_304l.thin(path)
    assert (name, size, rate) == ("one", "small", 0.01)
    expected = [30 + 100 * e for e in tension_304l.STRAINS if e < 0.05]
    assert found[: len(expected)] == pytest.approx(expected, abs=2e-3)


def test_the_spread_of_a_predicted_yield() -> None:
    draws = {"mean yield": np.array([31.0, 33.0]), "sd yield": np.array([1.0, 2.0])}
    told = tension_304l.told(draws)
    assert told[tension_304l.PREDICTIVE] == pytest.approx(np.sqrt(2.5 + 1))
    alone = tension_304l.told({"mean yield": 31.0, "sd yield": 1.5})
    assert alone[tension_304l.PREDICTIVE] == pytest.approx(1.5)
    # Where the offset line meets the curve, as the page says.
    center = tension_304l.reference(8, 0).center
    assert center[tension_304l.PREDICTIVE] == pytest.approx(1.07, abs=0.005)


def test_data_sets_are_told_by_sorted_outputs_and_failures_stand_above() -> None:
    y = np.array([[3.0, 10.0], [1.0, 30.0], [2.0, 20.0]])
    rho = np.sqrt(3) * np.corrcoef(y.T)[0, 1]
    assert statistics(y) == pytest.approx([1, 2, 3, 10, 20, 30, rho])
    assert statistics(np.stack([y, -y]))[1] == pytest.approx([-3, -2, -1, -30, -20, -10, rho])
    simulated = np.array([[2.0, np.nan], [np.inf, 5.0], [-1.0, 1e9]])
    assert capped(simulated, y).tolist() == [[2, 300], [30, 5], [-1, 300]]


def test_components_of_the_data_have_unit_spread_and_no_correlation() -> None:
    problem = frame.PROBLEM
    y = problem.data(50, 0)
    parts = components(problem, y)
    assert parts(y).shape == (50, 2)
    assert np.cov(parts(y).T, bias=True) == pytest.approx(np.eye(2), abs=1e-9)
    assert parts(y).mean(axis=0) == pytest.approx(0, abs=1e-9)
    assert np.allclose(parts(np.stack([y, 2 * y]))[1], parts(2 * y))


def test_gross_values_are_in_the_data_and_not_in_the_reference() -> None:
    dirty, clean = contaminated.data(100, 3), contaminated.clean(100, 3)
    assert (dirty != clean).sum() == 5
    assert (dirty[-5:] == 18).all()
    expected = exact.posterior(linear.PRIORS, exact.normal_log_likelihood(clean))
    assert contaminated.reference(100, 3) == expected


def test_quantiles_of_the_wrong_family() -> None:
    told = wrong_family.told({"mu": np.array([9.0]), "sigma": np.array([2.0])})
    assert told["95%"][0] == pytest.approx(9 + 2 * 1.644854)
    assert wrong_family.TRUE.mean() == pytest.approx(10)
    assert wrong_family.TRUE.std() == pytest.approx(1)


def test_a_population_has_the_moments_and_the_correlation_that_it_is_given() -> None:
    problem = virkler.PROBLEM
    values = {"mean rate": -2.0, "sd rate": 0.1, "mean m": 3.0, "sd m": 0.5, "correlation": -0.6}
    z = np.random.default_rng(1).standard_normal((40_000, 2))
    rate, m = problem.population(values, z)
    assert [rate.mean(), m.mean()] == pytest.approx([-2.0, 3.0], abs=0.01)
    assert [rate.std(), m.std()] == pytest.approx([0.1, 0.5], rel=0.02)
    assert np.corrcoef(rate, m)[0, 1] == pytest.approx(-0.6, abs=0.02)


# -- the score -------------------------------------------------------------------------------------


def _problem(truth: dict[str, float] | None = None) -> Problem:
    return Problem(
        name="toy", what="", licence="", priors={"a": normal(0, 1)}, sizes=(4,),
        inputs=(Input("normal", "a", 1.0),), formula=lambda xp, x: 2 * x,
        data=lambda size, replicate: np.arange(size) + float(replicate),
        reference=lambda size, replicate: Reference("truth", {"a": float(replicate)}, {"a": 0.5}),
        replicates=3, truth=truth,
    )  # fmt: skip


def _row(replicate: int, mean: float, sd: float | None) -> dict[str, Any]:
    ends = (None, None) if sd is None else (mean - sd, mean + sd)
    value = {"mean": mean, "sd": sd, "low": ends[0], "high": ends[1]}
    costs = {"runs": 10 * (replicate + 1), "cpu": 1.0}
    return {"size": 4, "replicate": replicate, "values": {"a": value}, **costs}


def test_the_score_of_known_rows() -> None:
    rows = [_row(0, 0.5, 1.0), _row(1, 2.5, 2.0), _row(2, 2.0, 1.0)]
    rows.append({"size": 4, "replicate": 3, "error": "no", "runs": 0, "cpu": 0.0})
    rows.append(_row(0, 99.0, 1.0) | {"size": 8})
    found = score(_problem({"a": 1.0}), 4, rows)
    # Off by 1, 3 and 0 reference sds; 2, 4 and 2 times as wide; intervals have 1, 1 and 1.
    assert found["a"]["bias"] == pytest.approx(4 / 3)
    assert found["a"]["rms"] == pytest.approx(np.sqrt(10 / 3))
    assert found["a"]["width"] == 2
    assert found["a"]["coverage"] == 1
    assert (found["data sets"], found["failures"], found["runs"]) == (4, 1, 20)
    assert score(_problem({"a": 2.8}), 4, rows)["a"]["coverage"] == pytest.approx(2 / 3)
    assert score(_problem(), 4, rows)["a"]["coverage"] is None
    assert score(_problem(), 4, rows[3:4])["failures"] == 1


def test_draws_of_the_reference_score_zero_and_one() -> None:
    problem, x = linear.PROBLEM, np.random.default_rng(1).standard_normal(100_000)
    reference = problem.reference(50, 0)
    draws = {k: reference.center[k] + reference.sd[k] * x for k in problem.priors}
    row = {"size": 50, "replicate": 0, "values": summary(draws), "runs": 1, "cpu": 1.0}
    found = score(problem, 50, [row])
    for name in problem.priors:
        assert found[name]["bias"] == pytest.approx(0, abs=0.02)
        assert found[name]["width"] == pytest.approx(1, abs=0.01)
    low = row["values"]["mu"]["low"]  # type: ignore[index]
    assert low == pytest.approx(reference.center["mu"] - 1.5982 * reference.sd["mu"], abs=0.01)


def test_a_single_number_has_no_width_and_no_number_is_an_error() -> None:
    assert summary({"a": 2.0})["a"] == {"mean": 2.0, "sd": None, "low": None, "high": None}
    found = score(_problem({"a": 1.0}), 4, [_row(0, 0.5, None)])
    assert found["a"] == {"bias": 1.0, "rms": 1.0, "width": None, "coverage": None}
    for bad in (np.array([1.0, np.nan]), np.array([])):
        with pytest.raises(ValueError, match="a has draws that are no finite numbers"):
            summary({"a": bad})


# -- studies --------------------------------------------------------------------------------------


def test_a_study_goes_on_where_it_stopped_and_keeps_failures(tmp_path: Path) -> None:
    seeds = []

    def calibrate(task: study.Task, settings: dict[str, Any]) -> dict[str, Any]:
        seeds.append(task.seed)
        if task.seed == 1:
            raise RuntimeError("lost")
        task.response(task.observed)
        return {"a": np.array([1.0, 2.0])}

    rival = study.Rival("some one", ("numpy",), {"draws": 2}, calibrate)
    study.study(rival, _problem(), [4], 2, tmp_path)
    study.study(rival, _problem(), [4], 9, tmp_path)
    assert seeds == [0, 1, 2]
    path = study.path_of(tmp_path, "some one", "toy")
    whole = json.loads(path.read_text(encoding="utf-8"))
    rows = whole["found"]["rows"]
    assert [row["runs"] for row in rows] == [4, 0, 4]
    assert rows[1]["error"] == "RuntimeError: lost"
    assert whole["found"]["settings"] == {"draws": 2}
    assert set(whole["run"]["versions"]) == {"python", "numpy"}
    other = study.Rival("some one", ("numpy",), {"draws": 3}, calibrate)
    with pytest.raises(SystemExit, match="has other settings"):
        study.study(other, _problem(), [4], 2, tmp_path)


def test_a_rival_that_cannot_says_why_in_its_cell(tmp_path: Path) -> None:
    def cannot(task: study.Task, settings: dict[str, Any]) -> dict[str, Any]:
        raise study.CannotError("one output only")

    def calibrate(task: study.Task, settings: dict[str, Any]) -> dict[str, Any]:
        return {"mu": np.array([10.0, 10.2]), "sigma": np.array([1.0, 1.1])}

    for name, function in (("one", cannot), ("two", calibrate)):
        rival = study.Rival(name, ("numpy",), {}, function)
        study.study(rival, linear.PROBLEM, [20], 2, tmp_path)
    found = table.scores(tmp_path)
    assert found["linear"]["20"]["two"]["data sets"] == 2
    assert found["linear"]["20"]["one"] == {"cannot": "one output only"}


def _cell(*values: tuple[float, float | None], sets: int = 1, failures: int = 0) -> dict[str, Any]:
    names = [f"h{k}" for k in range(len(values))]
    told = {
        name: {"bias": -rms, "rms": rms, "width": width, "coverage": 0.8}
        for name, (rms, width) in zip(names, values, strict=True)
    }
    return told | {"data sets": sets, "failures": failures, "runs": 1024.0, "cpu": 2.345}


def test_the_tables_tell_the_worst_hyperparameter() -> None:
    found = {
        "linear": {
            "20": {
                "prbayes PR": _cell((0.1, 1.2), (0.5, 0.5), sets=3, failures=1),
                "mud": _cell((0.3, None)),
                "sbi": _cell(sets=2, failures=2) | {"runs": None, "cpu": None},
                "stock PyMC": {"cannot": "why"},
            },
            "50": {"prbayes PR": _cell((0.7, 1.0), sets=20)},
        }
    }
    cells = dict(table.matrix(found, several=False))
    assert (cells["prbayes PR"], cells["mud"]) == (".50, .50 (2)", ".30 (1)")
    assert cells["*specimens*"] == "20"
    assert cells["stock PyMC"] == "cannot"
    assert cells["sbi"] == "fails"
    assert "pyABC adaptive" not in cells, "it was not run"
    told = list(table.rows(found, "linear"))
    assert [row[:2] for row in told] == [
        ["20", "prbayes PR"], ["20", "sbi"], ["20", "mud"], ["50", "prbayes PR"]
    ]  # fmt: skip
    assert told[0][2:] == ["-.10, -.50", ".50", "1.20, .50", "", "1,000", "2.3", "3, 1 failed"]
    assert told[-1][5] == ".80", "coverage is told from twenty data sets on"


def test_the_scores_are_those_of_the_stored_results() -> None:
    scores = json.loads(study.STORE.with_suffix(".json").read_text(encoding="utf-8"))["found"]
    for one in table.stored(study.STORE):
        assert one["rival"] in table.RIVALS
        for size in {row["size"] for row in one["rows"]}:
            count = sum(row["size"] == size for row in one["rows"])
            told = scores[one["problem"]][str(size)][one["rival"]]
            assert told["data sets"] == count, "run python -m benchmarks.scoreboard.table"


# -- rivals ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("prior", "at"),
    [
        (normal(1.0, 2.0), 0.3),
        (half_normal(2.0), 0.7),
        (uniform(-1.0, 3.0), 0.5),
        (truncated(2.0, 1.5, low=1.0), 1.7),
    ],
)
def test_priors_are_the_same_in_pymc(prior: Any, at: float) -> None:
    import pymc as pm

    from benchmarks.scoreboard import in_pymc

    problem = _problem()
    with pm.Model() as model:
        variable = in_pymc.hyperparameters(Problem(**{**vars(problem), "priors": {"a": prior}}))[
            "a"
        ]
    logp = pm.logp(variable, at).eval(mode="FAST_COMPILE")
    assert float(logp) == pytest.approx(float(prior.distribution().logpdf(at)))
    assert [v.name for v in model.free_RVs] == ["a"]


def test_the_density_of_nelder_mead_is_that_of_gaussian_kernels() -> None:
    from benchmarks.scoreboard.rivals.nelder_mead import density

    x = np.random.default_rng(1).normal(size=60)
    edges = np.linspace(-5, 5, 513)
    low, high = np.quantile(x, [0.25, 0.75])
    h = 0.9 * min(x.std(ddof=1), (high - low) / 1.349) * 60**-0.2
    middles = (edges[1:] + edges[:-1]) / 2
    kernels = np.exp(-(((middles[:, None] - x) / h) ** 2) / 2) / (h * np.sqrt(2 * np.pi))
    assert np.allclose(density(x, edges), kernels.mean(axis=1), atol=0.005)
