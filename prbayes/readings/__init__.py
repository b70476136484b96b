"""Distributions of readings about the response: counts, and errors with two parts."""

from prbayes.readings.base import Count, ReadingDistribution
from prbayes.readings.binomial import Binomial
from prbayes.readings.combined import Combined
from prbayes.readings.negative_binomial import NegativeBinomial
from prbayes.readings.poisson import Poisson

# Distributions of counts; `prbayes.metrics.readings` stores their index.
COUNTS: tuple[type[Count], ...] = (Poisson, NegativeBinomial, Binomial)

__all__ = ["Binomial", "Combined", "NegativeBinomial", "Poisson", "ReadingDistribution"]
