"""Share of a population without response, under the log-likelihood by specimen."""

from __future__ import annotations

import numpy as np

from prbayes._checks import Floats
from prbayes._finding import Finding
from prbayes.model.evaluator import Evaluator
from prbayes.response.distributions import PopulationSampler

# Simulated specimens of a population, and the number of lost specimens that is reported.
_SPECIMENS, _LOST = 4096, 0.25


def failing_region_findings(evaluator: Evaluator, theta: Floats) -> tuple[Finding, ...]:
    """Report populations of which a part has no response; no run is made.

    The likelihood of a specimen integrates over inputs with a response. The density elsewhere is
    probability where no specimen can be measured, so that a population moves away from there.
    Where as much as a quarter of a specimen is expected there, among the observed number, a
    finding ``failing-region`` has the share.

    Parameters
    ----------
    evaluator : Evaluator
    theta : ndarray, shape (d,)
        In unconstrained space.
    """
    findings = []
    rng = np.random.default_rng(23)
    for k, simulator in enumerate(evaluator.emulated, start=len(evaluator.nodes)):
        likelihood = simulator.likelihood
        emulation = likelihood.emulation
        if np.isfinite(emulation.y).all():
            continue
        sampler = PopulationSampler(likelihood.inputs)
        drawn, _ = sampler(evaluator.roots(theta[None], k), _SPECIMENS, rng)
        z = likelihood.coordinates.of([x[0] for x in drawn], 1)
        fails = emulation.fails(np.clip(z, emulation.box[0], emulation.box[1]))
        share = float(fails.mean())
        n = len(simulator.rows)
        if share * n < _LOST:
            continue
        findings.append(
            Finding(
                "failing-region",
                f"{simulator.name}: got no response (NaN) for {share:.1%} of the population, "
                f"expected less than {_LOST / n:.1%}: the likelihood takes it for inputs with "
                "which no specimen is measured, and the population moves away from there. If "
                "specimens with these inputs were measured, repair the response; if they were "
                "discarded, give the inputs a truncated distribution (pm.Truncated)",
            )
        )
    return tuple(findings)
