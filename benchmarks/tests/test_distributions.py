"""Each of PyMC's univariate distributions as an input: right under a propagation, or refused."""

from __future__ import annotations

import pytest

from benchmarks import distributions

STORED = {name: row for name, (row,) in distributions.STUDY.stored()["rows"].items()}
# One for each way that an input is told apart.
TELLING = {
    "Gamma": ("Reweighted", "Resimulated", "Fresh"),
    "Poisson": ("Reweighted", "Resimulated"),
    "Uniform": ("Reweighted",),
    "Censored": ("Reweighted",),
    "DiracDelta": ("Reweighted", "Fresh"),
    "CustomDist, by draws alone": ("Reweighted", "Fresh"),
    "CustomDist, without draws": ("Reweighted", "Fresh"),
    "Mixture, of a moving point": ("Reweighted",),
}


def test_the_table_has_every_distribution_that_pymc_exports() -> None:
    assert distributions.unknown() == set()
    assert STORED.keys() == distributions.CASES.keys()


def test_none_is_wrong_or_ends_in_an_error_of_another() -> None:
    verdicts = {each["verdict"] for row in STORED.values() for each in row.values()}
    assert verdicts == {"works", "refused"}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "propagation"), [(name, each) for name, kinds in TELLING.items() for each in kinds]
)
def test_an_input_has_the_discrepancies_of_other_draws_or_is_refused(
    name: str, propagation: str
) -> None:
    case = distributions.CASES[name]
    found = distributions.trial(case, distributions.PROPAGATIONS[propagation], search=False)
    assert found["verdict"] == STORED[name][propagation]["verdict"], found
