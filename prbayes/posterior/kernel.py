"""The SMC kernel, which evaluates a whole population in one call."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pymc as pm
from pymc.smc.kernels import SMC_KERNEL, systematic_resampling
from scipy.special import logsumexp

from prbayes._validate import Floats, positive_integer, share
from prbayes.model.evaluator import Evaluation, Evaluator
from prbayes.posterior.importance import LogDensity
from prbayes.posterior.initial_particles import starting_thetas
from prbayes.response.inputs import model_on_context

# Mean absolute correlation with the particles before a stage at which they count as new draws;
# among 500 particles that share nothing it is .036. On the way to the posterior six times as much
# will do: later stages forget the rest. Half or twice of either moves a mean by an eighth of a
# standard deviation, of 400 draws, as another seed does (docs/constants.md).
_UNCORRELATED = 0.05
_ON_THE_WAY = 6
# Share of the particles that have to carry the weight where another evaluator weighs them, by
# judgement: they move afterwards until they forget where they were.
_SERVE = 0.2


class BatchedKernel(SMC_KERNEL):
    """SMC kernel that computes priors, responses and discrepancies of all particles in one call.

    It mutates by independent proposals from a normal fitted to the particles, which forget the past
    at once, in turn with random-walk proposals, which also move inside separate modes; until the
    particles are uncorrelated with those before, or stop becoming less so. Also usable as
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
        Accepted for PyMC's sake; the populations are evaluated in NumPy.
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
        # PyMC's constructor compiles functions of single particles, which this kernel never calls.
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
        self.var_info = {}
        for name, shape in self.evaluator.hyperparameters.shapes.items():
            size = int(np.prod(shape, dtype=int))
            self.var_info[name] = (shape, size)
        self.rng = np.random.default_rng(random_seed)
        # Whether the evaluator is a coarser one, that `go_over` is to follow.
        self.roughly = False
        self._reset_state()

    def set_rng(self, rng: np.random.Generator) -> None:
        """Take over a chain's generator."""
        self.rng = rng

    def _evaluate(self, thetas: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        if self.log_likelihood is not None:
            log_prior = self.evaluator.hyperparameters.log_prior(thetas)
            unknown = np.full((len(thetas), len(self.evaluator.nodes)), np.nan)
            return log_prior, self.log_likelihood(thetas), unknown, unknown.copy()
        found: Evaluation = self.evaluator(thetas)
        likelihood = found.log_likelihood(self.evaluator.epsilon)
        return found.log_prior, likelihood, found.discrepancies, found.lost

    def _initialize_kernel(self) -> None:
        seed = int(self.rng.integers(2**31))
        if self.start is None:
            self.tempered_posterior = self.evaluator.hyperparameters.prior_thetas(self.draws, seed)
        else:
            self.tempered_posterior = self._started()
        found = self._evaluate(self.tempered_posterior)
        self.prior_logp, self.likelihood_logp, self.discrepancies, self.lost = found
        if not np.isfinite(self.likelihood_logp).any():
            raise ValueError(
                f"model: got no finite discrepancy among {self.draws} draws from the prior, "
                "expected some; the populations of the prior are invalid or far from the design: "
                "look at the priors"
            )

    def _started(self) -> Floats:
        """Return the particles that were given: thetas, or values by the names of variables."""
        if isinstance(self.start, np.ndarray):
            return self.start.copy()
        return starting_thetas(self.evaluator.hyperparameters, self.start, self.draws)

    def resample(self) -> None:
        """Resample the particles in proportion to their weights."""
        index = systematic_resampling(self.weights, self.rng)
        self.resampling_indexes = index
        self.tempered_posterior = self.tempered_posterior[index]
        self.prior_logp = self.prior_logp[index]
        self.likelihood_logp = self.likelihood_logp[index]
        self.discrepancies = self.discrepancies[index]
        self.lost = self.lost[index]

    def go_over(self, evaluator: Evaluator) -> bool:
        """Weigh the particles by another evaluator, for the next step; return whether they serve.

        They do not where few of them would carry the weight.
        """
        self.evaluator = evaluator
        self.roughly = False
        before = self.likelihood_logp
        found = self._evaluate(self.tempered_posterior)
        self.prior_logp, self.likelihood_logp, self.discrepancies, self.lost = found
        with np.errstate(invalid="ignore"):
            log_weights = np.nan_to_num(self.likelihood_logp - before, nan=-np.inf)
        total = logsumexp(log_weights)
        if not np.isfinite(total):
            return False
        self.weights = np.exp(log_weights - total)
        self.log_marginal_likelihood += total - np.log(self.draws)
        return bool(1 / np.square(self.weights).sum() > _SERVE * self.draws)

    def mutate(self) -> None:
        """Move all particles by Metropolis-Hastings steps that keep the tempered posterior."""
        before = self.tempered_posterior.copy()
        fitted = Normal.of(before)
        at_the_end = self.beta == 1 and not self.roughly
        enough = _UNCORRELATED if at_the_end else _UNCORRELATED * _ON_THE_WAY
        # The scale that is best for normal targets, steered to an acceptance rate between those for
        # many dimensions and for one: Roberts, Gelman and Gilks (1997),
        # doi:10.1214/aoap/1034625254.
        scale = 2.38 / np.sqrt(before.shape[1])
        remembered = 1.0
        accepted = []
        # A bound on the cost where particles do not forget. Beside the hard ends of a uniform
        # population 25 steps leave posteriors a tenth too wide.
        for step in range(1, 60 + 1):
            # In turn: new places at once, and steps from where each particle is
            noise = self.rng.standard_normal(before.shape)
            if step % 2:
                accepted.append(self._jump(fitted, noise))
                continue
            rate = self._walk(fitted, scale * noise)
            accepted.append(rate)
            scale *= np.exp(rate - 0.3)

            # Terminate when the particles have forgotten, or stop forgetting
            last = remembered
            remembered = correlation(before, self.tempered_posterior)
            has_stalled = step > 20 and remembered > last - 0.001
            if remembered < enough or has_stalled:
                break
        self.accept_rate = float(np.mean(accepted))
        self.n_steps = step

    def _jump(self, fitted: Normal, noise: Floats) -> float:
        """Propose independent draws of the fitted normal; return the rate of acceptance."""
        return self._accept(*fitted.independent(self.tempered_posterior, noise))

    def _walk(self, fitted: Normal, noise: Floats) -> float:
        """Propose a step from each particle; return the rate of acceptance."""
        proposed = self.tempered_posterior + noise @ fitted.root.T
        return self._accept(proposed, np.zeros(len(proposed)))

    def _accept(self, proposed: Floats, log_ratio: Floats) -> float:
        """Accept or reject by Metropolis and Hastings.

        ``log_ratio`` is that of the proposal's densities.
        """
        prior, likelihood, discrepancies, lost = self._evaluate(proposed)
        with np.errstate(invalid="ignore"):
            tempered = self.beta * (likelihood - self.likelihood_logp)
            gain = prior - self.prior_logp + tempered + log_ratio
        log_uniform = np.log(self.rng.random(len(proposed)))
        ok = log_uniform < np.nan_to_num(gain, nan=-np.inf)
        self.tempered_posterior[ok] = proposed[ok]
        self.prior_logp[ok] = prior[ok]
        self.likelihood_logp[ok] = likelihood[ok]
        self.discrepancies[ok] = discrepancies[ok]
        self.lost[ok] = lost[ok]
        return float(ok.mean())

    def sample_stats(self) -> dict[str, Any]:
        """Return the statistics of a stage."""
        return {
            "log_marginal_likelihood": self.log_marginal_likelihood if self.beta == 1 else np.nan,
            "beta": self.beta,
            "accept_rate": self.accept_rate,
            "n_steps": self.n_steps,
        }

    def state(self) -> tuple[dict[str, Floats], dict[str, Any]]:
        """Return all that the next stage depends on: arrays, and what goes into JSON."""
        arrays = {
            "thetas": self.tempered_posterior,
            "prior": self.prior_logp,
            "likelihood": self.likelihood_logp,
            "discrepancies": self.discrepancies,
            "lost": self.lost,
        }
        note = {
            "roughly": self.roughly,
            "beta": self.beta,
            "evidence": self.log_marginal_likelihood,
            "iteration": self.iteration,
            "generator": self.rng.bit_generator.state,
        }
        return arrays, note

    def restore(self, arrays: dict[str, Floats], note: dict[str, Any]) -> None:
        """Take over a state."""
        self.tempered_posterior = arrays["thetas"].copy()
        self.prior_logp = arrays["prior"].copy()
        self.likelihood_logp = arrays["likelihood"].copy()
        self.discrepancies = arrays["discrepancies"].copy()
        self.lost = arrays["lost"].copy()
        self.roughly = note.get("roughly", False)  # of an earlier version
        self.beta = note["beta"]
        self.log_marginal_likelihood = note["evidence"]
        self.iteration = note["iteration"]
        self.rng = np.random.default_rng()
        self.rng.bit_generator.state = note["generator"]

    def sample_settings(self) -> dict[str, Any]:
        """Return the settings of the run."""
        return {"_n_draws": self.draws, "threshold": self.threshold, "_n_tune": self.n_steps}


@dataclass(frozen=True, eq=False)
class Normal:
    """A normal distribution fitted to particles.

    Mean, shape (d,), and Cholesky factor, shape (d, d).
    """

    mean: Floats
    root: Floats

    @classmethod
    def of(cls, particles: Floats) -> Normal:
        """Return the one with the particles' mean and covariance."""
        covariance = np.atleast_2d(np.cov(particles, rowvar=False))
        # Makes the covariance of identical particles a proper one.
        jitter = 1e-12 * np.diag(np.diag(covariance) + 1e-300)
        return cls(particles.mean(axis=0), np.linalg.cholesky(covariance + jitter))

    def independent(self, particles: Floats, noise: Floats) -> tuple[Floats, Floats]:
        """Return draws of it, (n, d), and the log ratio of densities that a proposal counts.

        That is its log-density at the present places less that at the proposed ones, shape (n,).
        """
        proposed = self.mean + noise @ self.root.T
        from_mean = particles - self.mean
        here = np.linalg.solve(self.root, from_mean.T)
        squared_there = (noise**2).sum(axis=1)
        squared_here = (here**2).sum(axis=0)
        return proposed, 0.5 * (squared_there - squared_here)


def correlation(before: Floats, after: Floats) -> float:
    """Return the mean absolute correlation of the particles' coordinates with those before."""
    a = before - before.mean(axis=0)
    b = after - after.mean(axis=0)
    in_a = (a**2).sum(axis=0)
    in_b = (b**2).sum(axis=0)
    size = np.sqrt(in_a * in_b)
    size = np.where(size > 0, size, 1.0)
    product = (a * b).sum(axis=0)
    each = np.abs(product) / size
    return float(np.mean(each))
