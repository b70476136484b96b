"""The kernel of sequential Monte Carlo, and its state on disk.

The kernel tempers and makes Metropolis-Hastings steps in batches. A run that was killed goes on
from the state on disk.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pymc as pm
import xarray as xr
from pymc.smc.kernels import SMC_KERNEL, systematic_resampling

from prbayes._stats import positive_scale
from prbayes._validate import (
    FORMAT,
    Floats,
    NamedArrays,
    StrPath,
    complete_rows,
    positive_integer,
    real_array,
    require_format,
    share,
    wrong_value,
)
from prbayes.model.evaluator import Evaluator, epsilons
from prbayes.model.fingerprint import Identity, Level, as_text, from_text, problem_differences
from prbayes.model.parameters import Hyperparameters, in_support, value_shapes
from prbayes.numerics.modes import LogDensity
from prbayes.response.budget import BudgetError
from prbayes.response.inputs import event_shape, model_on_context
from prbayes.response.store import StoreError, replace_files


@dataclass(frozen=True)
class KernelOptions:
    """Limits of the mutation."""

    # Mean absolute correlation with the previous particles below which particles count as new. It
    # is .036 for 500 independent ones.
    correlation: float = 0.05
    # same limit before the last stage, because later stages remove the rest
    tempered_correlation: float = 0.3
    # Largest number of steps. With 25 steps posteriors at the hard ends of a uniform population are
    # a tenth too wide.
    steps: int = 60


_OPTIONS = KernelOptions()

# Names of the attributes of the kernel that belong to its state
_STATE = ("stages", "beta", "log_marginal_likelihood", "iteration")

Stages = dict[str, list[float]]  # statistics of a chain by name, a value for each stage
State = tuple[NamedArrays, dict[str, Any]]  # arrays of particles, and a note for JSON


class Particles(NamedTuple):
    """Particles with their densities."""

    thetas: Floats  # (n, d)
    log_prior: Floats  # (n,)
    log_likelihood: Floats  # (n,)
    discrepancies: Floats  # (n, k)
    lost: Floats  # (n, k): share of the population without response; NaN if not known


class BatchedKernel(SMC_KERNEL):
    """SMC kernel that computes priors, responses and discrepancies of all particles in one call.

    Independent proposals from a normal fitted to the particles alternate with random-walk
    proposals, which also move inside separate modes. They stop when the particles are uncorrelated
    with the previous ones, or their correlation stops falling. Also usable as
    ``pymc.sample_smc(kernel=prbayes.posterior.BatchedKernel)``.

    Parameters
    ----------
    draws : int
        Number of particles.
    start : mapping, optional
        Particles to begin with, as for `sample_smc`; draws of the prior by default.
    model : pymc.Model, optional
        The one on the context by default.
    random_seed : int, optional
    threshold : float
        Share of the effective sample size that a stage keeps.
    compile_kwargs : dict, optional
        Ignored: PyMC passes it.
    evaluator : Evaluator, optional
        Of the model.
    log_likelihood : callable, optional
        Density of the data in place of exp(-sum of d_k / epsilon_k), (S, d) -> (S,).
    """

    stats_dtypes_shapes: ClassVar[dict[str, tuple[type, list[Any]]]] = {
        "log_marginal_likelihood": (float, []),
        "beta": (float, []),
        "accept_rate": (float, []),
        "n_steps": (int, []),
    }

    def __init__(
        self,
        draws: int = 2000,
        start: Any = None,
        model: pm.Model | None = None,
        random_seed: int | None = None,
        threshold: float = 0.5,
        compile_kwargs: dict[str, Any] | None = None,
        evaluator: Evaluator | None = None,
        log_likelihood: LogDensity | None = None,
    ) -> None:
        # PyMC's constructor is not called, because it compiles functions of single particles.
        self.draws = positive_integer(draws, "draws")
        if random_seed is not None:
            positive_integer(random_seed, "random_seed", minimum=0)
        self.start = start
        self.threshold = share(threshold, "threshold")
        model = model_on_context(model, "BatchedKernel")
        self.evaluator = evaluator or Evaluator.of(model)
        self.log_likelihood = log_likelihood
        unset = [n.name for n in self.evaluator.nodes if np.isnan(n.epsilon_value)]
        if unset and log_likelihood is None:
            raise ValueError(
                f"{unset[0]}: epsilon is not set; call prb.set_epsilon(model, "
                "prb.calibrate_epsilon(prb.minimize(model))) or use prb.sample_smc, "
                "which calibrates it"
            )
        self.variables = model.value_vars
        shapes = value_shapes(self.evaluator.hyperparameters).items()
        self.var_info = {name: (shape, int(np.prod(shape, dtype=int))) for name, shape in shapes}
        self.rng = np.random.default_rng(random_seed)
        self.stages: Stages = {}
        self._reset_state()

    def _take(self, particles: Particles) -> None:
        """Replace the particles, and the attributes that PyMC reads."""
        self.particles = particles
        self.tempered_posterior = particles.thetas
        self.prior_logp = particles.log_prior
        self.likelihood_logp = particles.log_likelihood

    def set_rng(self, rng: np.random.Generator) -> None:
        """Take over a chain's generator."""
        self.rng = rng

    def _evaluate(self, thetas: Floats) -> Particles:
        if self.log_likelihood is not None:
            log_prior = self.evaluator.hyperparameters.log_prior(thetas)
            unknown = np.full((len(thetas), len(self.evaluator.nodes)), np.nan)
            return Particles(
                thetas, log_prior, self.log_likelihood(thetas), unknown, unknown.copy()
            )
        evaluation = self.evaluator(thetas)
        log_likelihood = evaluation.log_likelihood(epsilons(self.evaluator))
        return Particles(
            thetas, evaluation.log_prior, log_likelihood, evaluation.discrepancies, evaluation.lost
        )

    def _initialize_kernel(self) -> None:
        seed = int(self.rng.integers(2**31))
        if self.start is None:
            thetas = self.evaluator.hyperparameters.prior_thetas(self.draws, seed)
        elif isinstance(self.start, np.ndarray):
            thetas = self.start
        else:
            thetas = starting_thetas(self.evaluator.hyperparameters, self.start, self.draws)
        self.stages = {name: [] for name in self.stats_dtypes_shapes}
        self._take(self._evaluate(thetas))
        if not np.isfinite(self.particles.log_likelihood).any():
            raise ValueError(
                f"model: got no finite discrepancy among {self.draws} draws from the prior, "
                "expected some; the populations of the prior are invalid or far from the design: "
                "look at the priors"
            )

    def resample(self) -> None:
        """Resample the particles in proportion to their weights."""
        self.resampling_indexes = systematic_resampling(self.weights, self.rng)
        self._take(Particles(*[array[self.resampling_indexes] for array in self.particles]))

    def tempered(self, max_stages: int | None = None) -> Iterator[None]:
        """Do the remaining stages, and yield after each."""
        while self.beta < 1:
            if len(self.stages["beta"]) == max_stages:
                raise BudgetError(
                    f"max_stages = {max_stages} was reached (beta {self.beta:.3g}, of 1)"
                )
            self.update_beta_and_weights()
            for name, value in self.step().items():
                self.stages[name].append(value)
            yield

    def mutate(self) -> None:
        """Move all particles by Metropolis-Hastings steps that preserve the tempered posterior."""
        start = self.particles.thetas
        # Fit a normal distribution to the particles. The jitter keeps the covariance of identical
        # particles positive definite.
        mean = start.mean(axis=0)
        covariance = np.atleast_2d(np.cov(start, rowvar=False))
        jitter = 1e-12 * np.diag(np.diag(covariance) + 1e-300)
        root = np.linalg.cholesky(covariance + jitter)
        limit = _OPTIONS.correlation if self.beta == 1 else _OPTIONS.tempered_correlation
        # Begin with the best scale for normal targets, and adapt it to an acceptance rate between
        # those for many dimensions and for one (Roberts, Gelman and Gilks 1997,
        # doi:10.1214/aoap/1034625254).
        scale = 2.38 / np.sqrt(start.shape[1])
        remaining = 1.0
        rates = []
        for step in range(1, _OPTIONS.steps + 1):
            noise = self.rng.standard_normal(start.shape)
            if step % 2:  # odd steps have independent proposals
                standard = np.linalg.solve(root, (self.particles.thetas - mean).T)
                log_ratio = 0.5 * ((noise**2).sum(axis=1) - (standard**2).sum(axis=0))
                rates.append(self._accept(mean + noise @ root.T, log_ratio))
                continue
            # Even steps have random-walk proposals, which are symmetric.
            moved = self.particles.thetas + scale * noise @ root.T
            rate = self._accept(moved, np.zeros(len(noise)))
            rates.append(rate)
            scale *= np.exp(rate - 0.3)
            previous = remaining
            remaining = correlation(start, self.particles.thetas)
            has_stalled = step > 20 and remaining > previous - 0.001
            if remaining < limit or has_stalled:
                break
        self.accept_rate = float(np.mean(rates))
        self.n_steps = step

    def _accept(self, thetas: Floats, log_ratio: Floats) -> float:
        """Accept or reject, given the log ratio of the proposal's densities in both directions."""
        current, proposed = self.particles, self._evaluate(thetas)
        with np.errstate(invalid="ignore"):
            tempered = self.beta * (proposed.log_likelihood - current.log_likelihood)
            gain = proposed.log_prior - current.log_prior + tempered + log_ratio
        log_uniform = np.log(self.rng.random(len(thetas)))
        is_accepted = log_uniform < np.nan_to_num(gain, nan=-np.inf)
        merged = Particles(*[array.copy() for array in current])
        for array, new in zip(merged, proposed, strict=True):
            array[is_accepted] = new[is_accepted]
        self._take(merged)
        return float(is_accepted.mean())

    def sample_stats(self) -> dict[str, Any]:
        """Return the statistics of a stage."""
        return {
            "log_marginal_likelihood": self.log_marginal_likelihood if self.beta == 1 else np.nan,
            "beta": self.beta,
            "accept_rate": self.accept_rate,
            "n_steps": self.n_steps,
        }

    def sample_settings(self) -> dict[str, Any]:
        """Return the settings of the run."""
        return {"_n_draws": self.draws, "threshold": self.threshold, "_n_tune": self.n_steps}

    def state(self) -> State:
        """Return the state that the next stage depends on."""
        note = {name: getattr(self, name) for name in _STATE}
        note["generator"] = self.rng.bit_generator.state
        # Random responses depend on the number of evaluations so far.
        note["evaluations"] = [node.bound.draws for node in self.evaluator.nodes]
        return self.particles._asdict(), note

    def restore(self, arrays: NamedArrays, note: dict[str, Any]) -> None:
        """Take over a state."""
        self._take(Particles(**arrays))
        for name in _STATE:
            setattr(self, name, note[name])
        self.rng = np.random.default_rng()
        self.rng.bit_generator.state = note["generator"]
        for node, draws in zip(self.evaluator.nodes, note["evaluations"], strict=True):
            node.bound.draws = draws


def correlation(start: Floats, end: Floats) -> float:
    """Return the mean absolute correlation of the coordinates of particles, (n, d) each."""
    a = start - start.mean(axis=0)
    b = end - end.mean(axis=0)
    size = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    correlations = np.abs((a * b).sum(axis=0)) / positive_scale(size)
    return float(np.mean(correlations))


def starting_thetas(hyperparameters: Hyperparameters, start: Any, draws: int) -> Floats:
    """Return thetas, (draws, d), of particles by names of variables or of transformed values."""
    if not isinstance(start, Mapping):
        raise wrong_value(
            start,
            "start",
            "a dict of arrays by the names of variables, or a list of these, one for each chain",
        )
    free_rvs = hyperparameters.model.free_RVs
    rv_shapes = {str(rv.name): event_shape(rv) for rv in free_rvs}
    rv_names = dict(zip(value_shapes(hyperparameters), rv_shapes, strict=True))
    is_complete = all(len({*pair} & set(start)) == 1 for pair in rv_names.items())
    if not is_complete or not set(start) <= {*rv_names, *rv_shapes}:
        raise KeyError(
            f"start: got {sorted(map(str, start))}, expected values for each of {sorted(rv_shapes)}"
        )
    shapes = rv_shapes | value_shapes(hyperparameters)
    values = {name: real_array(value, f"start: {name}") for name, value in start.items()}
    for name, value in values.items():
        expected = (draws, *shapes[name])
        if value.shape != expected:
            raise ValueError(
                f"start: {name}: got shape {value.shape}, expected {expected}, a value for each "
                "particle"
            )
    # Transform the variables in their own units first. The initial point stands for those that are
    # given as transformed values.
    initial = hyperparameters.constrained(hyperparameters.initial[None])
    own_units = [
        np.broadcast_to(values.get(name, initial[name]), (draws, *shape))
        for name, shape in rv_shapes.items()
    ]
    with np.errstate(all="ignore"):  # because values outside the support are refused below
        thetas = hyperparameters.thetas_of(own_units)
    first = 0
    for name, shape in value_shapes(hyperparameters).items():
        size = int(np.prod(shape, dtype=int))
        if rv_names[name] not in start:
            thetas[:, first : first + size] = values[name].reshape(draws, size)
        first += size
    finite = complete_rows(thetas)
    outside = ~(finite & in_support(hyperparameters, np.where(finite[:, None], thetas, 0.0)))
    if outside.any():
        raise ValueError(
            f"start: got {int(outside.sum())} of {draws} points outside the support of the priors, "
            "expected none; draw them from the prior"
        )
    return thetas


_DIGEST = hashlib.sha256


class Checkpoint:
    """Arrays and a JSON note in one netCDF file, which each save replaces at once.

    The draws depend on the problem and on ``settings``. An ``entropy`` of None is replaced by that
    of the file, or by a new one. A file that cannot be read, or of another problem or settings,
    raises StoreError and remains as it is.
    """

    def __init__(self, path: StrPath, problem: Identity, settings: dict[str, Any]) -> None:
        self.path = Path(path)
        self.problem = problem
        self.settings = dict(settings)
        self.arrays: NamedArrays = {}
        self.note: dict[str, Any] = {}
        self.digest = b""  # digest of the file as this run has read or written it last
        if self.path.exists():
            self._read()
        if self.settings.get("entropy", "") is None:
            self.settings["entropy"] = str(np.random.SeedSequence().entropy)

    def save(self, arrays: NamedArrays, note: dict[str, Any]) -> None:
        """Replace the file; it is safe on disk when this returns."""
        variables = {}
        for name, array in arrays.items():
            dims = [f"{name}_{i}" for i in range(np.ndim(array))]
            variables[name] = (dims, np.asarray(array))
        attributes = {
            "prbayes_format": FORMAT,
            "problem": as_text(self.problem),
            "settings": json.dumps(self.settings),
            "note": json.dumps(note),
        }
        data = xr.Dataset(variables, attrs=attributes)
        # Build the file in memory, because HDF5 may end the process if the disk is full.
        content = bytes(data.to_netcdf(engine="h5netcdf"))
        digest = _DIGEST(content).digest()
        if self.path.exists() and self.path.read_bytes()[-len(digest) :] != self.digest:
            raise StoreError(self._refusal("belongs to another run, which is writing to it"))
        try:
            # The digest follows the netCDF data, whose readers ignore bytes after its end.
            replace_files({self.path: content + digest}, "checkpoint")
        except OSError as error:
            raise StoreError(error.strerror) from error
        self.arrays, self.note, self.digest = arrays, note, digest

    def _read(self) -> None:
        try:
            sealed = self.path.read_bytes()
            size = len(sealed) - _DIGEST().digest_size
            content = sealed[: max(size, 0)]
            # Compare the digest before reading, because HDF5 may hang on a damaged file.
            if _DIGEST(content).digest() != sealed[len(content) :]:
                raise ValueError("it is damaged, or of another version: no digest at its end")
            with xr.open_dataset(io.BytesIO(content), engine="h5netcdf") as file:
                data = file.load()
            require_format(data.attrs.get("prbayes_format"))
            problem = from_text(data.attrs["problem"])
            settings, note = (json.loads(data.attrs[key]) for key in ("settings", "note"))
        except Exception as error:
            reason = f"cannot be read ({type(error).__name__}: {error})"
            raise StoreError(self._refusal(reason)) from error
        if self.settings.get("entropy", "") is None:
            self.settings["entropy"] = settings["entropy"]
        reasons = problem_differences(problem, self.problem, Level.RUN)
        for key in sorted({*settings, *self.settings}):
            got, expected = settings.get(key), self.settings.get(key)
            if got != expected:
                reasons.append(f"{key}: got {got}, expected {expected}")
        if reasons:
            raise StoreError(self._refusal(f"belongs to another run: {'; '.join(reasons)}"))
        self.arrays = {str(name): a.values for name, a in data.data_vars.items()}
        self.note = note
        self.digest = _DIGEST(content).digest()

    def _refusal(self, reason: str) -> str:
        return (
            f"checkpoint: {self.path} {reason}; nothing was changed: move it away, "
            "or pass another path"
        )
