"""Progress bars appear for long work only, on stderr, and stay away where they are not wanted."""

import io
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import one_input
from rich.console import Console

import prbayes as prb
import prbayes._progress
from prbayes._progress import _expected, announce, progress, shown


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """A terminal that all bars are drawn on."""
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=120)
    monkeypatch.setattr(prbayes._progress, "CONSOLE", console)
    return text


@pytest.fixture
def impatient(screen: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """A terminal on which bars are drawn at once, however quick the work is."""
    monkeypatch.setattr(prbayes._progress, "_SHOWN_FROM", 0.0)
    return screen


class Clock:
    """A clock that is set by hand, in seconds."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(prbayes._progress, "time", clock)
    return clock


@pytest.mark.parametrize("total", [3, None])
def test_a_bar_appears_when_the_work_turns_out_to_be_long(
    screen: io.StringIO, clock: Clock, total: int | None
) -> None:
    with progress("walking", total) as report:
        assert screen.getvalue() == ""
        for _ in range(3):
            clock.now += 1.5
            report(1, "on foot")
    for text in ("walking", "on foot", "3/3" if total else "3"):
        assert text in screen.getvalue()


@pytest.mark.parametrize("terminal", [True, False])
def test_short_work_shows_nothing(
    screen: io.StringIO, clock: Clock, monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setattr(prbayes._progress, "CONSOLE", Console(file=screen, force_terminal=terminal))
    for total in (100, None):
        with progress("quick", total) as report:
            for _ in range(100):
                clock.now += 0.0199
                report(1, "")
    assert screen.getvalue() == ""


@pytest.fixture
def log(screen: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """No terminal."""
    monkeypatch.setattr(prbayes._progress, "CONSOLE", Console(file=screen, force_terminal=False))
    return screen


def test_where_no_bar_can_move_there_is_a_line_each_minute(
    log: io.StringIO, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    with progress("walking", 3) as report:
        clock.now += 59.0
        report(1, "on foot")
        assert log.getvalue() == ""
        clock.now += 1.0
        report(1, "[on foot]")
        clock.now += 59.0
        report(1, "on foot")
    with progress("looking") as report:
        clock.now += 60.0
        report(1, "")
    said = "walking 2/3 [on foot]\nlooking 1\n"
    assert log.getvalue() == said
    # None where they are not wanted: hidden, or on a page.
    for on_page in (False, True):
        monkeypatch.setattr(prbayes._progress, "_in_kernel", lambda on_page=on_page: on_page)
        with shown(on_page), progress("walking", 2) as report:
            clock.now += 60.0
            report(1, "")
        assert log.getvalue() == said


def test_a_sampler_without_a_terminal_says_where_it_is(
    log: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prbayes._progress, "_LINE_EVERY", 0.0)
    prb.sample_smc(20, chains=2, model=build(), adjustment=None, random_seed=1)
    said = [line for line in log.getvalue().splitlines() if line.startswith("SMC")]
    assert said[-1].endswith(" chain 2 of 2: beta 1 of 1")
    assert said[0].startswith("SMC stages 1 chain 1 of 2: beta 0.")


def test_a_text_is_printed_above_the_bars_or_logged(
    screen: io.StringIO, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", logger="prbayes"):
        announce("[why]", visible=True)
        assert (screen.getvalue(), caplog.messages) == ("[why]\n", [])
        announce("not asked for", visible=False)
        with shown(False):
            announce("hidden", visible=True)
    assert (screen.getvalue(), caplog.messages) == ("[why]\n", ["not asked for", "hidden"])


def test_the_seconds_left_are_those_at_the_pace_so_far() -> None:
    assert _expected(3.0, 1, 4) == 9.0
    assert _expected(3.0, 4, 4) == 0.0
    assert _expected(3.0, 0, 4) == 9.0, "what is under way counts as done"
    assert _expected(3.0, 7, None) == 3.0


def test_what_is_hidden_outside_stays_hidden_inside(screen: io.StringIO, clock: Clock) -> None:
    with shown(False) as outer, shown(True) as inner, progress("hidden", 2) as report:
        clock.now += 3.0
        report(1, "")
        assert not outer
        assert not inner
    assert screen.getvalue() == ""
    with shown(True) as visible:
        assert visible


def test_a_bar_is_taken_away_when_the_work_fails(screen: io.StringIO, clock: Clock) -> None:
    def fail() -> None:
        with progress("failing", 2) as report:
            clock.now += 3.0
            report(1, "")
            raise ValueError("lost")

    with pytest.raises(ValueError, match="lost"):
        fail()
    with progress("next", 2) as report:
        clock.now += 3.0
        report(1, "")
    assert "next" in screen.getvalue()


def build(**settings: Any) -> pm.Model:
    settings = {"propagation": prb.Reweighted(64), "epsilon": 0.1} | settings
    data = {"metric": prb.AreaMetric(), "observed": np.linspace(-1, 3, 20)}
    return one_input(sd=1.0, **data, **settings)


@pytest.mark.parametrize("visible", [True, False])
def test_everything_inside_the_sampler_follows_its_keyword(
    impatient: io.StringIO, visible: bool
) -> None:
    model = build(propagation=prb.Resimulated(16), epsilon=None)
    settings = {"model": model, "adjustment": None, "random_seed": 1}
    prb.sample_smc(20, chains=1, progressbar=visible, **settings)
    for text in ("SMC stages", "evaluations", "discrepancy"):
        assert (text in impatient.getvalue()) == visible
    if not visible:
        assert impatient.getvalue() == ""


def test_a_calibration_of_the_sampler_shows_one_bar(impatient: io.StringIO) -> None:
    prb.simulation_based_calibration(2, model=build(propagation=prb.Reweighted(32)), draws=50)
    assert "data sets" in impatient.getvalue()
    assert not {"SMC", "refits", "evaluations"} & set(impatient.getvalue().split())


def test_a_kernel_without_widgets_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels ask for colours, which rich takes for a terminal."""
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    assert not prbayes._progress._console().is_jupyter
    monkeypatch.undo()

    class ZMQInteractiveShell:
        pass

    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(prbayes._progress, "find_spec", lambda _: None)
    assert prbayes._progress._console().is_terminal
    shell = SimpleNamespace(get_ipython=ZMQInteractiveShell)
    monkeypatch.setitem(sys.modules, "IPython", shell)
    console = prbayes._progress._console()
    assert not console.is_terminal
    assert not console.is_jupyter
