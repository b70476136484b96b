"""Share of a population without response, under the log-likelihood by specimen."""

from __future__ import annotations

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.specimen_preparation import prepared
from prbayes.response.distributions import PopulationSampler


def failing_region_findings(
    evaluator: Evaluator, theta: Floats, specimens: int = 4096, lost: float = 0.25
) -> tuple[Finding, ...]:
    """Report populations of which a part has no response; no run is made.

    Where the response is NaN no specimen can be measured: the likelihood is that of the population
    truncated to the other inputs (`prbayes.propagation.response_share`). Where it is +inf specimens
    fail: as none is among the data, a population moves away from there. Regions with an expected
    number of ``lost`` specimens are reported, with the share of both.
    """
    findings = []
    rng = np.random.default_rng(23)
    for k, simulator in enumerate(evaluator.emulated, start=len(evaluator.nodes)):
        likelihood = simulator.likelihood
        emulation = prepared(likelihood).emulation
        if np.isfinite(emulation.y).all():
            continue
        sampler = PopulationSampler(likelihood.inputs)
        drawn, _ = sampler(evaluator.roots(theta[None], k), specimens, rng)
        z = likelihood.coordinates.of([x[0] for x in drawn], 1)
        fails = emulation.fails(np.clip(z, emulation.box[0], emulation.box[1]))
        share = float(fails.mean())
        n = len(simulator.rows)
        if share * n < lost:
            continue
        if prepared(likelihood).share is None:
            meaning = (
                "as no specimen with these inputs is among the data, the population moves away "
                "from there. If such specimens cannot be measured, return NaN"
            )
        else:
            meaning = (
                "the specimens are taken for a sample of the rest, the population truncated to "
                "inputs with a response. If specimens with these inputs were measured, repair the "
                "response; if none would fail unseen, return inf"
            )
        findings.append(
            Finding(
                "failing-region",
                f"{simulator.name}: got no finite response for {share:.1%} of the population, "
                f"expected less than {lost / n:.1%}: {meaning}.",
                "likelihood.md#failing-region",
            )
        )
    return tuple(findings)
