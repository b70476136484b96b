"""Posteriors of many products in one batch: each has a population and specimens of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from prbayes._validate import ArrayPair, Floats, Indices
from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.parameters import variables_at
from prbayes.model.specimen_likelihood import points_by_group
from prbayes.model.specimen_preparation import prepared
from prbayes.numerics.modes import modes_each
from prbayes.posterior.importance import ImportanceSample, importance_samples
from prbayes.posterior.smc import SamplingSettings
from prbayes.posterior.target import specimen_starts
from prbayes.specimens.weighted_points import ProductPoints


@dataclass(frozen=True, eq=False)
class ProductPosteriors:
    """The posteriors of P products in unconstrained space."""

    evaluator: Evaluator
    likelihood: SpecimenLikelihood  # likelihood of the specimens of all products, in their order
    points: ProductPoints

    @classmethod
    def of(
        cls, evaluator: Evaluator, likelihood: SpecimenLikelihood, sizes: Sequence[int]
    ) -> ProductPosteriors | None:
        """Return the posteriors of products with so many specimens.

        None if the log-likelihood is not the sum over points of an exponential family alone.
        """
        has_gross_errors = likelihood.measurements[0].gross_errors is not False
        if has_gross_errors or not likelihood.error_is_known or prepared(likelihood).share:
            return None
        (points,) = points_by_group(likelihood)
        if points.form is None:
            return None
        return cls(evaluator, likelihood, ProductPoints.of(points, sizes))

    def log_densities(self, thetas: Floats, products: Indices) -> ArrayPair:
        """Return log-densities of the posteriors of products (A,), and of the prior, (A, n).

        Thetas are (A, n, d).
        """
        flat = np.ascontiguousarray(thetas.reshape(-1, thetas.shape[2]))
        hyperparameters = self.evaluator.hyperparameters
        log_prior = hyperparameters.log_prior(flat)
        values = variables_at(hyperparameters, flat)
        parents = self.likelihood.parents(values, None, products[:0])
        log_p = self.points.log_likelihoods(parents, products).ravel()
        with np.errstate(invalid="ignore"):
            log_p = log_p + self.evaluator.log_other(flat, ()) + log_prior
        log_p[~np.isfinite(log_p)] = -np.inf
        return log_p.reshape(thetas.shape[:2]), log_prior.reshape(thetas.shape[:2])

    def samples(self, products: Indices, settings: SamplingSettings) -> dict[int, ImportanceSample]:
        """Return draws of the products (A,) with one mode by importance sampling.

        Products are left out where the weights of the first proposal are not even enough.
        """
        try:
            return self._samples(products, settings)
        except (ValueError, np.linalg.LinAlgError):
            if len(products) == 1:
                return {}
        first, second = np.array_split(products, 2)
        return self.samples(first, settings) | self.samples(second, settings)

    def _samples(
        self, products: Indices, settings: SamplingSettings
    ) -> dict[int, ImportanceSample]:
        """Return `samples`; an error of one product is raised for all."""
        hyperparameters = self.evaluator.hyperparameters
        unit = hyperparameters.prior_sd
        thetas = hyperparameters.prior_points(1024, 0)
        log_p, _ = self.log_densities(np.stack([thetas] * len(products)), products)
        starts = [specimen_starts(thetas, row, unit) for row in log_p]

        def log_density(points: Floats, numbers: Indices) -> Floats:
            return self.log_densities(points, products[numbers])[0]

        modes = modes_each(log_density, starts, unit)
        single = np.flatnonzero([len(of_product) == 1 for of_product in modes])
        seed = settings.random_seed or 0
        prior_points = hyperparameters.prior_thetas(settings.draws // 5, seed)
        result = {}
        for block in np.array_split(single, 1 + len(single) // 25) if single.size else ():
            samples = importance_samples(
                partial(self.log_densities, products=products[block]),
                [modes[i][0] for i in block],
                prior_points,
                settings.draws,
                seed,
            )
            for product, sample in zip(products[block].tolist(), samples, strict=True):
                if sample is not None:
                    result[product] = sample
        return result
