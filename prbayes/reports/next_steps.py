"""What to do after a report: the steps that its results call for, the most urgent first."""

from __future__ import annotations

from prbayes.plots.validity import in_directions
from prbayes.reports.material import Material
from prbayes.reports.schema import kind_of_decision

# More steps than these are a plan, which nobody carries out from a summary: by judgement.
_MOST_NEXT = 4


def next_steps(m: Material) -> list[str]:
    """Return sentences that say what to do, and by which function; none without a result."""
    if not m.results:
        return []
    steps = [*_of_problems(m), *_of_validity(m), *_of_answers(m), *_of_decision(m)]
    return [f"{i}. {step}" for i, step in enumerate(steps[:_MOST_NEXT], 1)]


def _of_problems(m: Material) -> list[str]:
    """Say to remove what the diagnostics found, before anything else."""
    if all(found is None or found.ok for found in m.diagnoses.values()):
        return []
    return ["Remove the problems under Diagnostics: each sentence there says what to do."]


def _of_validity(m: Material) -> list[str]:
    """Say what follows from the tests, or that there is none."""
    if not m.tests:
        return [
            "Test the calibrated model on specimens that were not used for it: prb.predict for "
            "their condition, then prb.area_test. With few specimens, prb.cross_validate."
        ]
    if m.rejected:
        return [
            "Do not use the model beyond the data of its calibration. See under Validity whether "
            "the measured responses lie beside the predicted ones or are scattered more widely; "
            "correct the response, let another input vary, or calibrate what the response leaves "
            "out (prb.response.Additive, prb.response.Multiplicative)."
        ]
    # In directions of several outputs the area of |2u - 1| is a part of the statistic.
    if any(test.folded or in_directions(test) for test in m.tests.values()):
        return []
    return [
        "Test the spread as well: prb.area_test(..., folded=True), each of the two tests at half "
        "the level."
    ]


def _of_answers(m: Material) -> list[str]:
    """Ask for the posterior where there is none."""
    if m.posteriors:
        return []
    return ["Find the uncertainty of the hyperparameters: prb.sample_smc(optimum=optimum)."]


def _of_decision(m: Material) -> list[str]:
    """Name the questions of a decision that were not asked; none of a model that is rejected."""
    if m.rejected:
        return []
    asked = {kind_of_decision(table) for table in m.decisions.values()}
    steps = []
    if any(table.attrs.get("verdict") == "not decided" for table in m.decisions.values()):
        steps.append(
            "A requirement is not decided, as too little is known of the probability: make as many "
            "more specimens as prb.plan says, with prb.decision.Exceedance as its quantity."
        )
    if "risk" not in asked:
        steps.append("Ask for the probability that a response is beyond its limit: prb.exceedance.")
    if "plan" not in asked:
        steps.append("Ask what more specimens would change, before they are made: prb.plan.")
    return steps
