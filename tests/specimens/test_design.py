"""Runs of a response at the likely inputs of specimens: how many there are, and where."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from normal_populations import NormalDraws

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.propagation.base import DesignError
from prbayes.specimens import design
from prbayes.specimens.coordinates import Coordinates
from prbayes.specimens.design import (
    audited,
    corrected,
    emulate,
    extended,
    first_emulation,
    first_runs,
    most_runs,
)
from prbayes.specimens.emulation import Emulation
from prbayes.specimens.points import (
    Plausible,
    SpecimenData,
    SpecimenOptions,
    SpecimenPoints,
    fit_proposals,
    normal_of,
)
from prbayes.specimens.weighted_points import fit_normal


def draws_around(mean: Floats, sd: Floats, n: int) -> NormalDraws:
    """Return normal populations as n specimens with this mean and deviation determine them."""
    scatter = np.random.default_rng(3).standard_normal((32, 2, len(mean))) / np.sqrt(n)
    return NormalDraws(mean + sd * scatter[:, 0], sd * np.exp(scatter[:, 1] / np.sqrt(2)))


def posterior(z: Floats, log_a: Floats, smoothing: Floats | None, **_: Any) -> NormalDraws:
    """Return populations around the one that fits weighted points best."""
    rows = np.isfinite(log_a).any(axis=1)
    mean, root = fit_normal(z[rows], log_a[rows])
    variance = np.diag(root @ root.T).copy()
    if smoothing is not None:
        variance += np.diag(smoothing)
    return draws_around(mean, np.sqrt(variance), len(z))


def bounded_by(prior: Floats) -> Coordinates:
    """Return coordinates whose specimens lie within the range of the prior's, as in a model."""
    d = prior.shape[1]
    no, one, ends = np.zeros(d, dtype=bool), np.ones(d), np.full((2, d), np.inf)
    bounds = np.stack([prior.min(axis=0), prior.max(axis=0)])
    return Coordinates(((d,),), no, 0 * one, one, bounds, ends * [[-1], [1]], no)


@dataclass
class Recorded:
    """A response that remembers its runs."""

    function: Callable[[Floats], Floats]
    batches: list[Floats] = field(default_factory=list)

    def __call__(self, z: Floats) -> Floats:
        self.batches.append(z)
        return self.function(z)

    @property
    def z(self) -> Floats:
        return np.concatenate(self.batches)


def emulated(
    function: Callable[[Floats], Floats], x: Floats, prior_sd: float = 0.4, **settings: Any
) -> tuple[Recorded, Emulation, SpecimenPoints]:
    """Return the runs for specimens with inputs x, (N, d), the emulation and the points."""
    run, (n, d) = Recorded(function), x.shape
    prior = prior_sd * np.random.default_rng(1).standard_normal((4096, d))
    readings = settings.pop("readings", None) or Readings.exact(function(x))
    settings = {"posterior": posterior, "coordinates": bounded_by(prior)} | settings
    data = SpecimenData(readings, np.full((n, d), np.nan), prior, **settings)
    emulation, points, _, _ = emulate(run, data)
    return run, emulation, points


def population(mean: Any, sd: Any, n: int = 20) -> Floats:
    mean, sd = np.atleast_1d(mean), np.atleast_1d(sd)
    return np.asarray(mean + sd * np.random.default_rng(2).standard_normal((n, len(mean))))


def line(z: Floats) -> Floats:
    return z @ np.array([[1.0, 2.0], [0.5, -1.0]])[: z.shape[1]]


def fold(z: Floats) -> Floats:
    return z**2


def frame(z: Floats) -> Floats:
    """Two stiffnesses of a frame; a mirror frame has the same two outputs."""
    k, g = np.exp(z[:, 0]), np.exp(z[:, 1])
    return np.stack([k + 2 * g, k * g], axis=1)


def underdetermined(z: Floats) -> Floats:
    return np.exp(z[:, :1]) + 0.5 * z[:, 1:]


CASES = [
    (line, population([0.1, -0.1], [0.15, 0.1])),
    (fold, population(0.4, 0.1)),
    (frame, population([0.2, -0.1], [0.1, 0.15])),
]


@pytest.mark.parametrize(("function", "x"), CASES)
def test_smooth_responses_need_few_runs(function: Callable[[Floats], Floats], x: Floats) -> None:
    run, emulation, points = emulated(function, x)
    d = x.shape[1]
    assert len(run.batches[0]) == first_runs(d) == 6 * d + 4
    assert len(run.z) <= 60
    np.testing.assert_array_equal(emulation.z, run.z)
    np.testing.assert_array_equal(emulation.y, function(run.z))
    assert emulation.bias <= 0.15
    # The points of each specimen have its outputs: within five errors of the comparison.
    assert (np.isfinite(points.log_a).mean(axis=1) > 0.5).all()
    is_point = np.isfinite(points.log_a)
    away = np.abs(points.outputs - function(x)[:, None]) / emulation.error
    assert np.quantile(away[is_point], 0.9) < 5
    # Twice the emulator's error at the specimens' inputs is stated; it is small at mirror inputs.
    misfit = np.abs(function(points.z[is_point]) - points.outputs[is_point])
    assert (misfit.max(axis=0) < 0.01 * function(x).std(axis=0)).all()
    at_inputs = function(x) - emulation.values(x)
    assert (np.sqrt((at_inputs**2).mean(axis=0)) < 2 * emulation.error).all()


def test_fewer_readings_than_inputs_need_few_runs() -> None:
    x = population([0.1, 0.1], [0.1, 0.1], n=10)
    draws = draws_around(x.mean(axis=0), x.std(axis=0), len(x))
    run, emulation, points = emulated(underdetermined, x, posterior=lambda *_, **__: draws)
    assert len(run.z) <= 60
    assert emulation.bias <= 0.15
    # Points are along the inputs that have the reading.
    away = np.abs(underdetermined(points.z.reshape(-1, 2)) - points.outputs.reshape(-1, 1))
    assert np.median(away) < 0.01
    assert (points.z.std(axis=1).min(axis=0) > [0.03, 0.07]).all()


@pytest.mark.parametrize(("mean", "sd"), [(0.3, 0.02), (1.2, 0.1)])
def test_runs_lie_where_the_specimens_are(mean: float, sd: float) -> None:
    """Also if these are three standard deviations of the prior from its middle."""
    x = population(mean, sd)
    run, *_ = emulated(lambda z: np.exp(2 * z), x)
    later = np.concatenate(run.batches[1:])
    assert (np.abs(later - x.mean()) < 4 * x.std()).mean() > 0.5


def test_both_branches_of_a_fold_have_runs() -> None:
    x = population(0.5, 0.05)
    run, _, points = emulated(fold, x)
    later = np.concatenate(run.batches[1:])
    for sign in (-1, 1):
        assert (np.abs(later - sign * 0.5) < 0.15).sum() >= 5
    assert (points.n_roots == 2).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_response_that_fails_in_a_region_keeps_its_runs(bad: float) -> None:
    def failing(z: Floats) -> Floats:
        return np.where(z > 0.5, bad, np.exp(z))

    x = population(0.1, 0.15)
    x = x[x < 0.45][:, None]
    run, emulation, _ = emulated(failing, x)
    assert len(run.z) <= 60
    np.testing.assert_array_equal(emulation.z, run.z)
    assert (~np.isfinite(emulation.y)).any()
    np.testing.assert_array_equal(emulation.y, failing(run.z))
    assert emulation.error[0] < 1e-3 * np.exp(x).std()


def test_more_first_runs_are_made_while_most_of_them_fail() -> None:
    def rare(z: Floats) -> Floats:
        return np.where(np.abs(z - 0.1) > 0.15, np.nan, z)

    x = population(0.1, 0.03)
    run, emulation, _ = emulated(rare, x)
    assert np.isfinite(emulation.y).sum() >= 8
    assert len(emulation.z) == len(run.z)
    with pytest.raises(DesignError, match=r"got 0 runs with a response of 80, expected at least 8"):
        emulated(lambda z: np.full_like(z, np.nan), x, readings=Readings.exact(x))


def test_a_response_that_no_emulator_follows_is_refused_at_the_limit() -> None:
    rough = Recorded(lambda z: z + 0.5 * np.sin(1e4 * z))
    x = population(0.1, 0.2)
    options = SpecimenOptions(max_runs=64)
    with pytest.raises(DesignError) as caught:
        emulated(rough, x, options=options)
    message = str(caught.value)
    assert "response: the response is not smooth enough" in message
    assert re.search(r"error of response is .* the largest at specimen \d+,", message)
    assert message.endswith("; narrow the priors")  # without advice that a model accepts
    assert len(message) < 5 * 90
    # A batch is half of the runs so far, and the limit is checked before each.
    assert 64 <= len(rough.z) - len(x) <= 64 * 3 // 2 + 8


def test_the_batch_after_a_failed_audit_is_where_the_audit_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    audits: list[Any] = []
    batches: list[Any] = []

    def failing(run: Any, data: Any, emulation: Any, likely: Any, rng: Any) -> Any:
        result = audited(run, data, emulation, likely, rng)
        audits.append(likely)
        return replace(result, bias=np.inf) if len(audits) == 1 else result

    def recorded(run: Any, data: Any, emulation: Any, likely: Any, *rest: Any) -> Any:
        if audits:
            batches.append(likely)
        return extended(run, data, emulation, likely, *rest)

    monkeypatch.setattr(design, "audited", failing)
    monkeypatch.setattr(design, "extended", recorded)
    emulated(np.exp, population(0.1, 0.15))
    assert batches[0] is audits[0]
    assert len(audits) > 1


def test_first_runs_of_the_user() -> None:
    run, *_ = emulated(np.exp, population(0.1, 0.15), options=SpecimenOptions(n_first=32))
    assert len(run.batches[0]) == 32


def test_limits_grow_with_the_inputs() -> None:
    assert [first_runs(d) for d in (1, 2, 8)] == [10, 16, 52]
    assert [most_runs(d) for d in (1, 2, 4, 8)] == [256, 384, 512, 1920]


def test_an_earlier_emulation_of_the_response_is_extended() -> None:
    """As for a bootstrap sample: its specimens have most of the runs already."""
    x = population(0.1, 0.15)
    run, emulation, _ = emulated(np.exp, x)
    prior = 0.4 * np.random.default_rng(1).standard_normal((4096, 1))
    known = np.full((20, 1), np.nan)
    data = SpecimenData(Readings.exact(np.exp(x[::-1])), known, prior, posterior)
    again = Recorded(np.exp)
    extended, *_ = emulate(again, data, emulation)
    np.testing.assert_array_equal(extended.z[: len(run.z)], run.z)
    assert len(extended.z) == len(run.z) + len(again.z)


@pytest.mark.parametrize("is_wavy", [False, True])
def test_an_emulator_of_some_specimens_is_audited_at_all(is_wavy: bool) -> None:
    """A wave where no specimen of the part is needs more runs; another response does not."""

    def response(z: Floats) -> Floats:
        return np.exp(z) + is_wavy * np.where(z > 0.4, 0.2 * np.sin(15 * (z - 0.4)) ** 2, 0.0)

    rng = np.random.default_rng(2)
    x = rng.normal([[0.0]] * 40 + [[0.7]] * 20, 0.1)
    prior = 0.4 * np.random.default_rng(1).standard_normal((4096, 1))

    def data_of(x: Floats) -> SpecimenData:
        readings, known = Readings.exact(response(x)), np.full(x.shape, np.nan)
        bounds, nothing = np.array([[-1.5], [1.5]]), np.zeros(1, dtype=bool)
        ends = np.inf * bounds
        unit = Coordinates(((),), nothing, np.zeros(1), np.ones(1), bounds, ends, nothing)
        return SpecimenData(
            readings, known, prior, posterior, unit,
            draws=lambda thetas: draws_around(*np.split(thetas.mean(axis=0), 2), len(x)),
        )  # fmt: skip

    run, of_part = Recorded(response), Recorded(response)
    emulate(of_part, data_of(x[:40]))
    _, points, *_ = emulate(run, data_of(x), part=data_of(x[:40]))
    further = len(run.z) - len(of_part.z)
    assert further > 8 if is_wavy else further <= 8
    if not is_wavy:
        assert points.is_exact
        np.testing.assert_allclose(points.z[:, 0], x, atol=1e-4)


def test_likely_inputs_are_corrected_by_the_response() -> None:
    """The emulator of the first runs is poor beside a kink; after two rounds its error is small."""

    def kinked(z: Floats) -> Floats:
        return z + 0.8 * np.abs(z - 0.1)

    x, prior = population(0.1, 0.15, 30), 0.4 * np.random.default_rng(1).standard_normal((4096, 1))
    run = Recorded(kinked)
    nothing = np.full(x.shape, np.nan)
    options = SpecimenOptions(n_first=24)
    readings = Readings.exact(kinked(x))
    data = SpecimenData(readings, nothing, prior, posterior, options=options)
    first = first_emulation(run, data)
    emulation = corrected(run, data, first, normal_of(x))
    assert [len(batch) for batch in run.batches[1:]] in ([30, 30], [30, 30, 30])
    assert emulation.offsets is not None
    # The response at a mode is the reading: of the emulator with the offsets, and of itself.
    proposals = fit_proposals(data, emulation, normal_of(x))
    modes = proposals.modes
    z = proposals.residuals.coordinates(modes.specimen, modes.a)
    before = np.median(np.abs(kinked(x) - first.values(x)))
    assert np.median(np.abs(kinked(z) - kinked(x)[modes.specimen])) < 0.2 * before


@pytest.mark.parametrize(
    ("shift", "width", "is_near"), [(0.3, 1.2, True), (2.0, 1.0, False), (0.0, 5.0, False)]
)
def test_another_population_is_not_near(shift: float, width: float, is_near: bool) -> None:
    """In deviations of the earlier one, with any unit and in any direction."""
    mean, sd = np.array([1.0, 2000.0]), np.array([0.1, 300.0])
    draws = draws_around(mean, sd, 50), draws_around(mean + shift * sd, width * sd, 50)
    nothing: Any = None
    earlier, later = (Plausible(d, nothing, nothing, 0, 1) for d in draws)
    assert later.is_near(earlier) is is_near


def test_a_surface_without_values_beyond_its_runs_has_an_error() -> None:
    class Bounded:
        def values(self, z: Floats) -> Floats:
            return np.where(abs(z) <= 1, z, np.nan)

    z = np.linspace(-1, 1, 5)[:, None]
    data = SpecimenData(Readings.exact(z), np.full((5, 1), np.nan), z, posterior)
    least: Any = design._least_error(data, z, Bounded())  # type: ignore[arg-type]
    assert least == pytest.approx(1e-5 * data.readings.spread(), rel=0.1)


def test_specimens_without_any_input_are_refused() -> None:
    """For example where no run with a response is near any specimen."""
    z = np.linspace(-1, 1, 9)[:, None]
    data = SpecimenData(Readings.exact(z), np.full((9, 1), np.nan), z, posterior)
    emulation = first_emulation(lambda z: z, data)
    nowhere = replace(emulation, y=np.full_like(emulation.y, np.inf))
    with pytest.raises(DesignError, match="no input at which the emulator gives the readings"):
        fit_proposals(data, nowhere, normal_of(z))


def test_a_likely_input_without_a_response_is_the_largest_misfit() -> None:
    """A possible input may have none."""
    z = np.linspace(-1, 1, 9)[:, None]
    data = SpecimenData(Readings.exact(z), np.full((9, 1), np.nan), z, posterior)
    misfit = np.array([[0.0], [np.nan], [np.inf]])
    assert design._bias_of_possible(data, misfit) == 0
    assert design._bias_of_possible(data, misfit, 1) > 10 * data.options.bias


def test_distances_of_huge_outputs_are_infinite() -> None:
    """The largest numbers have no square."""
    z = np.array([[0.0], [1e200]])
    squares = design.squared_distances(np.array([[-1e200]]), z, np.ones(1))
    assert np.isinf(squares).all()
