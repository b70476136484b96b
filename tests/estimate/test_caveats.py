"""What is said of an optimum, and when two populations differ."""

from prbayes.estimate.caveats import breakdown


def test_what_breaks_down_is_said_by_name_and_only_then() -> None:
    assert breakdown((), ()) == []
    (line,) = breakdown(("sigma", "tau"), ())
    assert line.startswith("sigma, tau ran to the edge of the support")
    (line,) = breakdown((), ("y",))
    assert line.startswith("y: points lose their response at the optimum")
    assert len(breakdown(("sigma",), ("y",))) == 2
