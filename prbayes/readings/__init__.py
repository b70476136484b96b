"""Distributions of readings about the response: counts, and errors with two parts."""

from prbayes.readings.base import Count, ReadingDistribution
from prbayes.readings.binomial import Binomial
from prbayes.readings.combined import Combined
from prbayes.readings.negative_binomial import NegativeBinomial
from prbayes.readings.poisson import Poisson

# Distributions of counts by their code in `prbayes.metrics.readings`; zero is a normal error.
COUNTS: dict[int, type[Count]] = {1: Poisson, 2: NegativeBinomial, 3: Binomial}

__all__ = ["Binomial", "Combined", "NegativeBinomial", "Poisson", "ReadingDistribution"]
