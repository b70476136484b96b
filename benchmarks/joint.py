"""Several outputs calibrated jointly: errors of hyperparameters, and coverage of their intervals.

Each problem has a true population. Many data sets are drawn from it, and each is calibrated by
separate marginals (a simulator an output), by `MarginalCorrelation` and by `Joint`, each under three
metrics of one output, and by the exact posterior; `Joint` with the default posterior as well. Bandwidths, whitening, epsilon and the adjustment
are chosen from each data set anew. Two things are cheaper than in a user's hands: the design is drawn
near the truth, once for all data sets, and the pseudo-posterior is integrated by importance sampling
around the optimum instead of `sample_smc`.

Errors are those of means in units of the population's spread, of logarithms of standard deviations
and of inverse hyperbolic tangents of correlations. Every data set is stored as it comes, so that an
interrupted study goes on where it stopped; a cell of the table stays as it is until the store has
more data sets of it:

    uv run python -m benchmarks.joint --replicates 200
    uv run python -m benchmarks.joint --only-table
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2, norm, qmc

from benchmarks import record

STORE = record.RESULTS / "joint"
SIZES = (50, 200, 20)
LEVEL = 0.89
METRICS = {"PR": "ProbabilityResidual", "KLD": "KullbackLeibler", "area": "AreaMetric"}
SCHOOLS = ("joint", "correlation", "separate")
METHODS = ("exact", *(f"{school} {metric}" for school in SCHOOLS for metric in METRICS))
ENOUGH = 20  # data sets of a cell that is told of, and pooled with others
_BLOCK = 10  # data sets of a problem before it is the next problem's turn
_FEW = 8  # specimens of the data sets whose estimates are the populations of the design


# -- problems --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """Outputs of specimens with normal inputs, which the outputs tell exactly."""

    mean: Any  # (p,): of the inputs
    covariance: Any  # (p, p)
    # N, and whether marginals are all that is compared -> inputs; priors stand in the model.
    model: Callable[[int, bool], list[Any]]
    response: _Chosen  # (..., p) -> (..., m)
    moments: Callable[[dict[str, Any]], tuple[Any, Any]]  # values -> (P, p), (P, p, p)
    values: Callable[[Any, Any], dict[str, Any]]  # mean, covariance -> values near them
    correlated: bool  # whether there is a correlation among the hyperparameters
    points: int  # of the design, for N = 50
    wider: int = 1  # times as many for N = 20, whose data sets' populations are further apart

    def draw(self, rng: Any, size: int) -> Any:
        """Return inputs of specimens, (size, p)."""
        root = np.linalg.cholesky(self.covariance)
        return self.mean + rng.standard_normal((size, len(root))) @ root.T

    def told(self, values: dict[str, Any]) -> Any:
        """Return the numbers whose errors are told, (P, h): all nearly normal, and without unit."""
        mean, covariance = self.moments(values)
        sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        found = [(mean - self.mean) / np.sqrt(np.diag(self.covariance)), np.log(sd)]
        if self.correlated:
            found.append(np.arctanh(covariance[:, :1, 1] / sd[:, :1] / sd[:, 1:2]))
        return np.concatenate(found, axis=1)


def _covariance(sd: Any, rho: Any, m: int) -> Any:
    """Return a covariance with all correlations the same, (..., m), (...) -> (..., m, m)."""
    matrix = sd[..., :, None] * sd[..., None, :]
    return matrix * (rho + (1 - rho) * np.eye(m))


def _normal(m: int, rho: float, points: int) -> Problem:
    def model(size: int, marginal: bool) -> list[Any]:
        import pymc as pm

        mu = pm.Normal("mu", 0, 3, shape=m)
        sd = pm.HalfNormal("sd", 3, shape=m)
        # Marginals tell nothing of it: there it is known.
        common = rho if marginal else pm.Uniform("rho", -1 / (m - 1), 1)
        return [pm.MvNormal.dist(mu, cov=_covariance(sd, common, m))]

    def moments(values: dict[str, Any]) -> tuple[Any, Any]:
        common = values.get("rho", np.full(len(values["mu"]), rho))
        return values["mu"], _covariance(values["sd"], common[:, None, None], m)

    def values(mean: Any, covariance: Any) -> dict[str, Any]:
        sd = np.sqrt(np.diag(covariance))
        lower = np.tril_indices(m, -1)
        common = (covariance / sd / sd[:, None])[lower].mean()
        return {"mu": mean, "sd": sd, "rho": np.clip(common, -0.9 / (m - 1), 0.998)}

    covariance = _covariance(np.ones(m), np.array(rho), m)
    same = _Chosen()
    return Problem(np.zeros(m), covariance, model, same, moments, values, True, points)


@dataclass(frozen=True)
class _Chosen:
    """The outputs of a response, or one of them."""

    response: Callable[[Any], Any] | None = None
    output: int | None = None

    def __call__(self, *inputs: Any) -> Any:
        """Return the outputs, (..., m), of inputs (..., p) or of p inputs (...)."""
        x = inputs[0] if len(inputs) == 1 else np.stack(inputs, axis=-1)
        outputs = x if self.response is None else self.response(x)
        return outputs if self.output is None else outputs[..., self.output]


def frame(x: Any) -> Any:
    """Return two frequencies and the roof's share of the first mode, of a two-storey shear frame.

    From the stiffnesses of the storeys, masses are one; NaN where a stiffness is not positive.
    """
    lower, upper = np.where((x > 0).all(axis=-1, keepdims=True), x, np.nan).T
    middle, root = (lower + 2 * upper) / 2, np.sqrt(lower**2 + 4 * upper**2) / 2
    low = middle - root
    roof = (lower + upper - low) / upper
    return np.stack(
        [np.sqrt(low) / 2 / np.pi, np.sqrt(middle + root) / 2 / np.pi, roof / (1 + roof)]
    ).T


_STIFFNESS = np.array([1000.0, 800.0])
_SCATTER = np.array([80.0, 60.0])


def _frame() -> Problem:
    def model(size: int, marginal: bool) -> list[Any]:
        import pymc as pm

        # A hundred standard errors, of a mean and of a standard deviation.
        half = 50 * _SCATTER / np.sqrt(size)
        mu = pm.Uniform("mu", _STIFFNESS - half, _STIFFNESS + half, shape=2)
        sd = pm.Uniform("sd", 0.0, 100 * _SCATTER / np.sqrt(2 * size), shape=2)
        return [pm.Normal.dist(mu[0], sd[0]), pm.Normal.dist(mu[1], sd[1])]

    def moments(values: dict[str, Any]) -> tuple[Any, Any]:
        return values["mu"], values["sd"][..., None] ** 2 * np.eye(2)

    def values(mean: Any, covariance: Any) -> dict[str, Any]:
        return {"mu": mean, "sd": np.sqrt(np.diag(covariance))}

    covariance = np.diag(_SCATTER**2)
    response = _Chosen(frame)
    return Problem(_STIFFNESS, covariance, model, response, moments, values, False, 2048)


PROBLEMS = {
    "normal 0": _normal(2, 0.0, 2048),
    "normal .6": _normal(2, 0.6, 2048),
    "normal .95": _normal(2, 0.95, 2048),
    "frame": _frame(),
    "four .9": replace(_normal(4, 0.9, 4096), wider=4),
}


# -- one cell --------------------------------------------------------------------------------------


class Cell:
    """A problem with data sets of one size: evaluators of one and of several simulators."""

    def __init__(self, name: str, size: int) -> None:
        self.name, self.size, self.problem = name, size, PROBLEMS[name]
        rng = np.random.default_rng([size, 1])
        estimates = [self._estimate(self.problem.draw(rng, _FEW)) for _ in range(512)]
        self.near = {key: np.array([e[key] for e in estimates]) for key in estimates[0]}
        self.together = self._evaluator(separate=False)
        self._apart: Any = None
        thetas = self._thetas(self.near)
        # Of the estimate from all specimens, in theta.
        self.spread = np.cov(thetas.T) * _FEW / size
        self.truth = self.problem.told(self._values_of_truth())[0]

    def _estimate(self, x: Any) -> dict[str, Any]:
        return self.problem.values(x.mean(axis=0), np.cov(x.T))

    def _values_of_truth(self) -> dict[str, Any]:
        values = self.problem.values(self.problem.mean, self.problem.covariance)
        return {key: np.asarray(value)[None] for key, value in values.items()}

    @property
    def apart(self) -> Any:
        """The evaluator of a simulator an output, made when it is asked for."""
        if self._apart is None:
            self._apart = self._evaluator(separate=True)
        return self._apart

    def _evaluator(self, *, separate: bool) -> Any:
        """Return an evaluator whose designs are drawn near the truth."""
        import pymc as pm

        import prbayes as prb
        from prbayes.model.evaluator import Evaluator

        p = self.problem
        some = p.response(p.draw(np.random.default_rng(0), self.size))
        n = p.points * (2 if self.size > 50 else p.wider if self.size < 50 else 1)
        stored = prb.Reweighted(16, max_points=n + 16, emulator=None)
        with pm.Model() as model:
            inputs = p.model(self.size, separate)
            if separate:
                for k in range(some.shape[1]):
                    one = _Chosen(p.response.response, k)
                    prb.Simulator(
                        f"y{k}", one, *inputs, metric=prb.AreaMetric(), observed=some[:, k],
                        propagation=stored, specimens=np.arange(self.size),
                    )  # fmt: skip
            else:
                metric = prb.Joint(prb.AreaMetric())
                prb.Simulator(
                    "y", p.response, *inputs, metric=metric, observed=some, propagation=stored
                )
        evaluator = Evaluator.of(model)
        for bound in evaluator.reweighted.values():
            bound.add([self.near[root.name] for root in bound.inputs.parents], n)
        return evaluator

    def _thetas(self, values: dict[str, Any]) -> Any:
        free = [rv.name for rv in self.together.model.free_RVs]
        return self.together.thetas_of([values[name] for name in free])

    def told(self, evaluator: Any, thetas: Any) -> Any:
        """Return the numbers whose errors are told, (P, h)."""
        return self.problem.told(evaluator.hyperparameters.constrained(thetas))

    def data(self, replicate: int) -> Any:
        """Return inputs of a data set, (N, p)."""
        rng = np.random.default_rng([replicate, self.size, sorted(PROBLEMS).index(self.name)])
        return self.problem.draw(rng, self.size)

    def log_likelihood(self, x: Any) -> Callable[[Any], Any]:
        """Return the exact log-likelihood of inputs as a function of thetas."""
        center, scatter = x.mean(axis=0), np.cov(x.T, bias=True)

        def value(thetas: Any) -> Any:
            mean, covariance = self.problem.moments(self.together.constrained(thetas))
            away = center - mean
            total = scatter + away[:, :, None] * away[:, None]
            inverse = np.linalg.inv(covariance)
            trace = np.einsum("pij,pji->p", inverse, total)
            return -0.5 * len(x) * (np.linalg.slogdet(covariance)[1] + trace)

        return value

    def exact(self, x: Any) -> dict[str, Any]:
        """Return the maximum likelihood estimate, and the exact posterior."""
        likelihood = self.log_likelihood(x)
        estimate = {key: np.asarray(v)[None] for key, v in self._estimate(x).items()}
        start = self._thetas(estimate)[0]
        scale = np.sqrt(np.diag(self.spread))
        steps = 1e-4 * np.concatenate([np.zeros((1, scale.size)), np.diag(scale), -np.diag(scale)])

        def objective(z: Any) -> tuple[float, Any]:
            found = -likelihood(start + z * scale + steps)
            up, down = found[1 : 1 + z.size], found[1 + z.size :]
            return float(found[0]), (up - down) / 2e-4

        best = minimize(objective, np.zeros(start.size), jac=True, method="BFGS")
        theta = start + best.x * scale
        thetas, log_q = proposal(theta, 2.0 * self.spread, 4096)
        log_prior = self.together.hyperparameters.log_prior(thetas)
        draws, ess = weighted(log_prior + likelihood(thetas) - log_q, thetas)
        return self._row(self.together, theta, draws, ess)

    def calibrated(self, method: str, x: Any) -> dict[str, Any]:
        """Calibrate one data set; return estimate, posterior and what it cost."""
        from prbayes.optimize.minimize import find_optimum
        from prbayes.optimize.objective import Minimisation
        from prbayes.posterior.sample import draw_posterior
        from prbayes.posterior.smc import SamplingSettings

        evaluator = self._observing(method, self.problem.response(x))
        free = {rv.name for rv in evaluator.model.free_RVs}
        truth = {k: value[0] for k, value in self._values_of_truth().items() if k in free}
        optimum = find_optimum(evaluator, Minimisation(starts=0, refine=False, start=truth))
        asked = SamplingSettings(draws=1000, chains=4, optimum=optimum)
        tree = draw_posterior(evaluator, asked)
        draws = np.asarray(tree["calibration"]["theta"]).reshape(-1, evaluator.hyperparameters.size)
        return self._row(evaluator, optimum.theta, draws, len(draws))

    def _observing(self, method: str, outputs: Any) -> Any:
        import prbayes as prb

        school, name = method.split()
        metric = getattr(prb, METRICS[name])()
        if school == "separate":
            data = {f"y{k}": outputs[:, k] for k in range(outputs.shape[1])}
            return self.apart.observing(data, metric)
        lift = prb.MarginalCorrelation if school == "correlation" else prb.Joint
        return self.together.observing({"y": outputs}, lift(metric))

    def _row(self, evaluator: Any, theta: Any, draws: Any, ess: float) -> dict[str, Any]:
        told = self.told(evaluator, draws)
        return {
            "estimate": _short(self.told(evaluator, theta[None])[0]),
            "below": _short((told < self.truth).mean(axis=0)),
            "mean": _short(told.mean(axis=0)),
            "sd": _short(told.std(axis=0)),
            "ess": round(ess),
        }

    def row(self, method: str, replicate: int) -> dict[str, Any]:
        """Return what a method makes of a data set; a failure is a result."""
        x = self.data(replicate)
        begun = time.process_time()
        try:
            found = self.exact(x) if method == "exact" else self.calibrated(method, x)
        except Exception as error:
            found = {"error": f"{type(error).__name__}: {error}"[:200]}
        seconds = round(time.process_time() - begun, 2)
        return {"replicate": replicate, **found, "seconds": seconds}


def proposal(center: Any, covariance: Any, size: int = 1024) -> tuple[Any, Any]:
    """Return Sobol points of a multivariate t with 5 degrees of freedom, and their log-density."""
    d = len(center)
    u = np.clip(qmc.Sobol(d + 1, rng=np.random.default_rng(0)).random(size), 1e-9, 1 - 1e-9)
    z = norm.ppf(u[:, :d]) / np.sqrt(chi2.ppf(u[:, d:], 5) / 5)
    root = np.linalg.cholesky(covariance)
    log_density = -(5 + d) / 2 * np.log1p((z**2).sum(axis=1) / 5)
    return center + z @ root.T, log_density


def weighted(log_weights: Any, thetas: Any) -> tuple[Any, float]:
    """Resample to equal weights, systematically; return draws and the effective sample size."""
    w = np.exp(log_weights - log_weights.max())
    w /= w.sum()
    index = np.searchsorted(np.cumsum(w), (np.arange(4000) + 0.5) / 4000)
    return thetas[np.minimum(index, len(w) - 1)], float(1 / (w**2).sum())


def _short(values: Any) -> list[float]:
    return [float(f"{value:.5g}") for value in values]


# -- the store -------------------------------------------------------------------------------------


def path_of(store: Path, name: str, size: int, method: str) -> Path:
    """Return where the rows of a cell and method are: JSON, a line a data set."""
    return store / f"{name} {size} {method}.jsonl".replace(" ", "-")


def rows_of(path: Path) -> list[dict[str, Any]]:
    """Return what is stored; a line that was not finished counts as none."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def missing(store: Path, arguments: Any) -> Iterator[tuple[str, int, list[tuple[str, int]]]]:
    """Yield what is to be done for a problem and size next: methods and data sets."""
    for first in range(0, arguments.replicates, _BLOCK):
        block = range(first, min(first + _BLOCK, arguments.replicates))
        for size in arguments.sizes:
            for name in arguments.problems:
                wanted = []
                for method in arguments.methods:
                    path = path_of(store, name, size, method)
                    done = {row["replicate"] for row in rows_of(path)}
                    wanted += [(method, i) for i in block if i not in done]
                if wanted:
                    yield name, size, wanted


def run(arguments: Any) -> None:
    """Do what is missing, until time is up."""
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    end = time.monotonic() + arguments.seconds
    arguments.store.mkdir(parents=True, exist_ok=True)
    for name, size, wanted in missing(arguments.store, arguments):
        if time.monotonic() > end:
            return
        cell = Cell(name, size)
        for method, replicate in wanted:
            if time.monotonic() > end:
                return
            line = json.dumps(cell.row(method, replicate), separators=(",", ":"))
            with path_of(arguments.store, name, size, method).open("a", encoding="utf-8") as file:
                file.write(line + "\n")


# -- tables ----------------------------------------------------------------------------------------


def summarise(store: Path, name: str, size: int, method: str) -> dict[str, Any] | None:
    """Return errors and coverage of a method, by number told; None where nothing is stored."""
    rows = {row["replicate"]: row for row in rows_of(path_of(store, name, size, method))}
    exact = {row["replicate"]: row for row in rows_of(path_of(store, name, size, "exact"))}
    both = [i for i in rows if i in exact and "error" not in exact[i]]
    good = [i for i in both if "error" not in rows[i]]
    if not good:
        return None
    problem = PROBLEMS[name]
    values = problem.values(problem.mean, problem.covariance)
    truth = problem.told({key: np.asarray(value)[None] for key, value in values.items()})[0]

    def of(found: dict[int, Any], key: str) -> Any:
        return np.array([found[i][key] for i in good])

    def rmse(found: dict[int, Any], key: str) -> Any:
        return np.sqrt(((of(found, key) - truth) ** 2).mean(axis=0))

    # Separate marginals tell nothing of a correlation of inputs that no response mixes.
    told = len(truth) - (problem.correlated and method.startswith("separate"))
    inside = np.abs(of(rows, "below") - 0.5) < LEVEL / 2
    off = (of(rows, "mean") - of(exact, "mean")) / of(exact, "sd")
    figures = {
        "rmse over likelihood": rmse(rows, "estimate") / rmse(exact, "estimate"),
        "rmse over posterior": rmse(rows, "mean") / rmse(exact, "mean"),
        "coverage": inside.mean(axis=0),
        "off": off.mean(axis=0),
        "off error": off.std(axis=0) / np.sqrt(len(good)),
        "sd over exact": np.median(of(rows, "sd") / of(exact, "sd"), axis=0),
    }
    return {
        "data sets": len(good),
        "failed": len(both) - len(good),
        "errors": sorted({rows[i]["error"][:80] for i in both if i not in good}),
        "seconds": float(np.median([rows[i]["seconds"] for i in good])),
        **{key: _short(value[:told]) for key, value in figures.items()},
    }


FIGURES = ("rmse over likelihood", "rmse over posterior", "coverage", "off", "sd over exact")


def grouped(name: str, values: list[float]) -> list[float]:
    """Return the means of a figure over means, standard deviations and, if told, correlations."""
    p = len(PROBLEMS[name].mean)
    groups = [values[:p], values[p : 2 * p], values[2 * p :]]
    return [float(np.mean(group)) for group in groups if group]


def table(store: Path, before: dict[str, Any]) -> dict[str, Any]:
    """Summarise what is stored, and print it; numbers alike are taken together.

    Cells of ``before`` with more data sets stay.
    """
    cells: dict[str, Any] = {}
    for name in PROBLEMS:
        for size in sorted(SIZES):
            for method in METHODS:
                key = f"{name}/{size}/{method}"
                known = [summarise(store, name, size, method), before.get(key)]
                both = [cell for cell in known if cell is not None]
                if both:
                    cells[key] = max(both, key=lambda cell: cell["data sets"])
    print(
        f"{'problem':10s} {'N':>3s} {'method':16s} {'sets':>4s} {'fail':>4s} {'s':>5s}  rmse/ML, rmse"
        "/posterior (mean, log sd, corr)   coverage 89%   off   sd/exact"
    )
    for key, cell in cells.items():
        name, of, method = key.split("/")
        shown = [
            "/".join(f"{value:.2f}" for value in grouped(name, cell[figure])) for figure in FIGURES
        ]
        print(
            f"{name:10s} {of:>3s} {method:16s} {cell['data sets']:4d} {cell['failed']:4d} "
            f"{cell['seconds']:5.1f}  " + "  ".join(s.rjust(15) for s in shown)
        )
    return {"cells": cells, "pooled": pooled(cells)}


def pooled(cells: dict[str, Any]) -> dict[str, Any]:
    """Return coverage over all hyperparameters and cells, and the worst figures, by method."""
    found: dict[str, Any] = {}
    print("\npooled over hyperparameters and problems")
    for method in METHODS:
        for size in sorted(SIZES):
            chosen = [
                cell
                for key, cell in cells.items()
                if key.endswith(f"/{size}/{method}") and cell["data sets"] >= ENOUGH
            ]
            if not chosen:
                continue
            weights = [cell["data sets"] for cell in chosen for _ in cell["coverage"]]

            def every(figure: str, chosen: list[Any] = chosen) -> Any:
                return np.concatenate([cell[figure] for cell in chosen])

            found[f"{method}/{size}"] = {
                "data sets": sum(cell["data sets"] for cell in chosen),
                "coverage": float(np.average(every("coverage"), weights=weights)),
                "worst rmse over likelihood": float(every("rmse over likelihood").max()),
                "worst rmse over posterior": float(every("rmse over posterior").max()),
                "worst off": float(np.abs(every("off")).max()),
                "mean sd over exact": float(np.average(every("sd over exact"), weights=weights)),
            }
            row = "  ".join(f"{k} {v:.3f}" for k, v in found[f"{method}/{size}"].items())
            print(f"{method:16s} N = {size:3d}  {row}")
    return found


def main() -> None:
    """Run what is missing, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=200)
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES))
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--seconds", type=float, default=1e9, help="after which nothing is begun")
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "joint.json")
    parser.add_argument("--only-table", action="store_true")
    arguments = parser.parse_args()
    if not arguments.only_table:
        run(arguments)
    before = record.load(arguments.out, {}).get("cells", {})
    record.save(arguments.out, table(arguments.store, before))


if __name__ == "__main__":
    main()
