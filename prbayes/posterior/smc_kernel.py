"""The SMC kernel, which evaluates a whole population in one call."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pymc as pm
from pymc.smc.kernels import SMC_KERNEL, systematic_resampling

from prbayes._checks import Floats
from prbayes.model.evaluator import Evaluation, Evaluator
from prbayes.model.node import model_on_context

_MAX_STEPS = 25
_UNCORRELATED = 0.05  # with the particles before the last stage; on the way, six times as much will do


class BatchedKernel(SMC_KERNEL):
    """SMC kernel that computes priors, responses and discrepancies of all particles in one call.

    It mutates by independent proposals from a normal fitted to the particles, which forget the past at
    once, in turn with random-walk proposals, which also move inside separate modes; until the particles
    are uncorrelated with those before, or stop becoming less so. Also usable as
    ``pymc.sample_smc(kernel=prbayes.BatchedKernel)``.

    Parameters
    ----------
    draws : int
        Number of particles.
    start : None
        Particles start from the prior.
    model : pymc.Model, optional
        The one on the context by default.
    random_seed : int, optional
    threshold : float
        Share of the effective sample size that a stage keeps.
    compile_kwargs : dict, optional
        Accepted for PyMC's sake; the populations are evaluated in NumPy.
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
    ) -> None:
        # PyMC's constructor compiles functions of single particles, which this kernel never calls.
        if not 0 < threshold < 1:
            raise ValueError(f"threshold: got {threshold}, expected a number between 0 and 1")
        self.draws = draws
        self.start = start
        self.threshold = threshold
        model = model_on_context(model, "BatchedKernel")
        self.evaluator = evaluator or Evaluator(model)
        unset = [n.name for n, e in zip(self.evaluator.nodes, self.evaluator.epsilon, strict=True) if np.isnan(e)]
        if unset:
            raise ValueError(
                f"{unset[0]}: epsilon is not set; call prb.set_epsilon(model, "
                "prb.calibrate_epsilon(prb.minimize(model))) or use prb.sample_smc, which calibrates it"
            )
        self.variables = model.value_vars
        self.var_info = {n: (s, int(np.prod(s, dtype=int))) for n, s in self.evaluator.shapes.items()}
        self.rng = np.random.default_rng(random_seed)
        self._reset_state()

    def set_rng(self, rng: np.random.Generator) -> None:
        """Take over a chain's generator."""
        self.rng = rng

    def _evaluate(self, thetas: Floats) -> tuple[Floats, Floats, Floats]:
        found: Evaluation = self.evaluator(thetas)
        return found.log_prior, found.log_likelihood(self.evaluator.epsilon), found.discrepancies

    def _initialize_kernel(self) -> None:
        self.tempered_posterior = self.evaluator.prior_thetas(self.draws, int(self.rng.integers(2**31)))
        self.prior_logp, self.likelihood_logp, self.discrepancies = self._evaluate(self.tempered_posterior)
        if not np.isfinite(self.likelihood_logp).any():
            raise ValueError(
                f"model: got no finite discrepancy among {self.draws} draws from the prior, expected some; the "
                "populations of the prior are invalid or far from the design: look at the priors"
            )

    def resample(self) -> None:
        """Resample the particles in proportion to their weights."""
        index = systematic_resampling(self.weights, self.rng)
        self.resampling_indexes = index
        self.tempered_posterior = self.tempered_posterior[index]
        self.prior_logp, self.likelihood_logp = self.prior_logp[index], self.likelihood_logp[index]
        self.discrepancies = self.discrepancies[index]

    def mutate(self) -> None:
        """Move all particles by Metropolis-Hastings steps that leave the tempered posterior as it is."""
        before = self.tempered_posterior.copy()
        mean, d = before.mean(axis=0), before.shape[1]
        covariance = np.atleast_2d(np.cov(before, rowvar=False))
        root = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance) + 1e-300))
        scale, accepted, correlation = 2.38 / np.sqrt(d), [], 1.0
        enough = _UNCORRELATED * (1 if self.beta == 1 else 6)
        for step in range(1, _MAX_STEPS + 1):
            noise = self.rng.standard_normal(before.shape)
            if step % 2:
                moved = mean + noise @ root.T
                now = np.linalg.solve(root, (self.tempered_posterior - mean).T)
                log_ratio = 0.5 * ((noise**2).sum(axis=1) - (now**2).sum(axis=0))
            else:
                moved, log_ratio = self.tempered_posterior + scale * noise @ root.T, np.zeros(len(before))
            rate = self._accept(moved, log_ratio)
            accepted.append(rate)
            if not step % 2:
                scale *= np.exp(rate - 0.3)
                last, correlation = correlation, _correlation(before, self.tempered_posterior)
                if correlation < enough or correlation > last - 0.01:
                    break
        self.accept_rate, self.n_steps = float(np.mean(accepted)), step

    def _accept(self, moved: Floats, log_ratio: Floats) -> float:
        prior, likelihood, discrepancies = self._evaluate(moved)
        with np.errstate(invalid="ignore"):
            gain = prior - self.prior_logp + self.beta * (likelihood - self.likelihood_logp) + log_ratio
        ok = np.log(self.rng.random(len(moved))) < np.nan_to_num(gain, nan=-np.inf)
        self.tempered_posterior[ok] = moved[ok]
        self.prior_logp[ok], self.likelihood_logp[ok] = prior[ok], likelihood[ok]
        self.discrepancies[ok] = discrepancies[ok]
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
        }
        note = {
            "beta": self.beta,
            "evidence": self.log_marginal_likelihood,
            "iteration": self.iteration,
            "generator": self.rng.bit_generator.state,
        }
        return arrays, note

    def restore(self, arrays: dict[str, Floats], note: dict[str, Any]) -> None:
        """Take over a state."""
        self.tempered_posterior, self.discrepancies = arrays["thetas"].copy(), arrays["discrepancies"].copy()
        self.prior_logp, self.likelihood_logp = arrays["prior"].copy(), arrays["likelihood"].copy()
        self.beta, self.log_marginal_likelihood, self.iteration = note["beta"], note["evidence"], note["iteration"]
        self.rng = np.random.default_rng()
        self.rng.bit_generator.state = note["generator"]

    def sample_settings(self) -> dict[str, Any]:
        """Return the settings of the run."""
        return {"_n_draws": self.draws, "threshold": self.threshold, "_n_tune": self.n_steps}


def _correlation(before: Floats, after: Floats) -> float:
    """Return the mean absolute correlation of the particles' coordinates with those before."""
    a, b = before - before.mean(axis=0), after - after.mean(axis=0)
    size = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return float(np.mean(np.abs((a * b).sum(axis=0)) / np.where(size > 0, size, 1.0)))
