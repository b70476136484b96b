"""Findings about an optimum: unidentified directions, other optima, the error of the design."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from prbayes._finding import Finding
from prbayes.inference.checks.identification import confounding_findings, unidentified_findings
from prbayes.inference.checks.prior import prior_end_findings, prior_ends
from prbayes.inference.refits import SamplingDistribution
from prbayes.metrics.multivariate import components_missed
from prbayes.model.description import labelled
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import readable_variables, split_elements, table_elements
from prbayes.optimize.design_refinement import AGREE
from prbayes.optimize.local_optima import Rival
from prbayes.propagation.importance import SIZES


def optimum_findings(
    evaluator: Evaluator,
    sampling: SamplingDistribution | None,
    rivals: Sequence[Rival],
    design_error: float,
) -> tuple[Finding, ...]:
    """Report what the metric leaves out, the design's error, other optima, and identification."""
    missed = {node.name: components_missed(node.target) for node in evaluator.nodes}
    findings = [
        Finding("components-left-out", f"{name}: {text}.") for name, text in missed.items() if text
    ]
    # An estimate from eight blocks is itself uncertain by a quarter.
    if design_error > 1.5 * AGREE:
        findings.append(_design_finding(evaluator, design_error))
    findings += [_second_mode(evaluator, rival) for rival in rivals if rival.comparable]
    if sampling is not None:
        ends = prior_ends(sampling)
        page = "optimum_or_abc.md#few-specimens-and-a-prior-that-knows-something"
        findings += prior_end_findings(ends, page)
        names = {end.name for end in ends}
        findings += unidentified_findings(evaluator, sampling.local, names)
        findings += confounding_findings(evaluator, sampling.local)
    return tuple(findings)


def _design_finding(evaluator: Evaluator, error: float) -> Finding:
    """Report a large error of the optimum by the design."""
    designs = [bound.design for bound in evaluator.reweighted.values()]
    runs = max(design.n_runs for design in designs)
    if min(len(design.emulated or ()) for design in designs) < SIZES.largest:
        advice = f"pass a larger n or max_points to prb.Reweighted (now {runs} runs)"
    else:
        advice = (
            f"between its {runs} runs are {SIZES.largest} emulated points, the most there are: "
            "more runs help as far as the emulator is off, which the message says, and the rest "
            "counts as another error of the optimum"
        )
    return Finding(
        "design-error",
        f"The optimum of another design would differ by about {error:.2f} standard errors, "
        f"expected at most {AGREE}; {advice}.",
        "choose.md#how-many-responses",
    )


def _second_mode(evaluator: Evaluator, rival: Rival) -> Finding:
    """Report another optimum."""
    hyperparameters = evaluator.hyperparameters
    # Beside a second point, so that constants can be recognised.
    points = hyperparameters.constrained(np.stack([rival.theta, hyperparameters.initial]))
    names = readable_variables([str(rv.name) for rv in evaluator.model.free_RVs], points)
    values = labelled(evaluator, {name: points[name] for name in names}, {"point": 2}).data_vars
    elements = split_elements(values)
    place = ", ".join(f"{name} = {elements[name][0]:.4g}" for name in table_elements(values))
    return Finding(
        "second-mode",
        f"The data could as well come from {place}: another optimum, or mirror "
        "solution, whose discrepancy differs by no more than sampling noise; state a prior that "
        "excludes one, or report both.",
        "optimum_or_abc.md#two-answers",
    )
