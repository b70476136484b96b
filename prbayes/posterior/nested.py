"""Nested families: the posterior where populations are restricted to a family that theirs contains.

An operation of a distribution may declare ``nested``: the name of the simpler family, and the
values of its parameters at which it is this family, by position. Under the restriction these
hyperparameters are fixed. The points of the specimens serve both families, and no run is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, epsilons
from prbayes.model.parameters import log_posterior, log_prior_terms
from prbayes.numerics.modes import far_apart
from prbayes.posterior.importance import ImportanceOptions, importance_sample
from prbayes.posterior.target import modes_of
from prbayes.response.inputs import aleatory_names


@dataclass(frozen=True)
class NestedFamily:
    """Families that the families of a model's inputs contain."""

    families: Mapping[str, tuple[str, str]]  # name of the family and of the nested one, by input
    fixed: Mapping[str, float]  # hyperparameters that restrict the family, with their values
    unchanged: frozenset[str]  # names of the other inputs

    @classmethod
    def of(cls, evaluator: Evaluator) -> NestedFamily | None:
        """Return the nested families of a model; None if no input has one.

        Parameters that are no scalar variables of the model do not restrict a family.
        """
        names = evaluator.hyperparameters.readable_names
        families = {}
        fixed: dict[str, float] = {}
        all_labels = set()
        for simulator in evaluator.simulators:
            inputs = simulator.inputs
            labels = aleatory_names(inputs, simulator.responses.function)
            all_labels.update(labels)
            for label, dist in zip(labels, inputs.aleatory, strict=True):
                op = dist.owner.op
                nested, values = getattr(op, "nested", ("", {}))
                parameters = op.dist_params(dist.owner) if values else ()
                at = {str(parameters[place].name): value for place, value in values.items()}
                if at and set(at) <= set(names):
                    families[label] = op.name.replace("_", "-"), nested
                    fixed |= at
        unchanged = frozenset(all_labels - families.keys())
        return cls(families, fixed, unchanged) if families else None

    def describe(self, place: int) -> str:
        """Return the names of the families (place 0), or of the nested ones (place 1)."""
        return ", ".join(dict.fromkeys(names[place] for names in self.families.values()))


@dataclass(frozen=True, eq=False)
class NestedPosterior:
    """Draws under nested families, and the posterior probability of these."""

    family: NestedFamily
    thetas: Floats  # (k, d): draws of the restricted posterior, with the fixed elements
    # probability of the nested families given the data, if it is one half before them
    probability: float


def nested_posterior(
    evaluator: Evaluator, family: NestedFamily, draws: Floats, seed: int = 0
) -> NestedPosterior | None:
    """Return as many draws as those given, (k, d), under nested families; None if unreliable.

    ``draws`` are those of the unrestricted posterior, where the search for modes begins.
    """
    nested = _restricted(evaluator, family.fixed, draws, seed)
    whole = _restricted(evaluator, {}, draws, seed)
    if nested is None or whole is None:
        return None
    thetas, log_evidence = nested
    return NestedPosterior(family, thetas, float(expit(log_evidence - whole[1])))


def _restricted(
    evaluator: Evaluator, fixed: Mapping[str, float], draws: Floats, seed: int
) -> tuple[Floats, float] | None:
    """Return draws, (k, d), and log evidence of a model with fixed variables; None if unreliable.

    The prior of the other variables is conditional on the fixed ones.
    """
    hyperparameters = evaluator.hyperparameters
    values = hyperparameters.constrained(draws.mean(axis=0)[None])
    point = values | {name: np.array([value]) for name, value in fixed.items()}
    (theta,) = hyperparameters.thetas_of([point[str(rv.name)] for rv in evaluator.model.free_RVs])
    if not np.isfinite(theta).all():
        return None  # because a fixed value is outside the support of the prior
    is_free = ~np.isin(hyperparameters.readable_names, list(fixed))
    # The Jacobian of the transforms of the fixed variables, by differences
    step = 1e-4 * np.eye(theta.size)[~is_free]
    log_jacobian = 0.0
    for name, shift in zip(np.array(hyperparameters.readable_names)[~is_free], step, strict=True):
        ends = hyperparameters.constrained(np.array([theta - shift, theta + shift]))[name]
        log_jacobian += float(np.log(np.diff(ends)[0] / 2e-4))

    def whole(free: Floats) -> Floats:
        thetas = np.tile(theta, (len(free), 1))
        thetas[:, is_free] = free
        return thetas

    def log_likelihood(thetas: Floats) -> Floats:
        return evaluator(thetas).log_likelihood(epsilons(evaluator))

    def log_prior_of_fixed(thetas: Floats) -> Floats:
        terms = log_prior_terms(hyperparameters, thetas) if fixed else {}
        return log_jacobian + sum((terms[name] for name in fixed), np.zeros(len(thetas)))

    def log_density(free: Floats) -> Floats:
        thetas = whole(free)
        return log_posterior(hyperparameters, thetas, log_likelihood) - log_prior_of_fixed(thetas)

    def log_prior(free: Floats) -> Floats:
        thetas = whole(free)
        return hyperparameters.log_prior(thetas) - log_prior_of_fixed(thetas)

    def prior_draws(size: int, seed: int) -> Floats:
        return hyperparameters.prior_thetas(size, seed)[:, is_free]

    scale = hyperparameters.prior_sd[is_free]
    modes = modes_of(log_density, far_apart(draws[:, is_free], 8, scale), scale)
    if modes is None:
        return None
    options = ImportanceOptions()
    prior = prior_draws, log_prior
    sample = importance_sample(log_density, modes, len(draws), seed, options, prior)
    return (whole(sample.draws), sample.log_evidence) if sample.is_reliable else None
