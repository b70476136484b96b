"""The command line: ``python -m prbayes report results.nc`` and ``python -m prbayes demo``."""

# What a command needs is imported where it is run: help and mistakes are answered at once.

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr

    from prbayes.validation.area_test import ValidityTest

_REPORT = """examples:
  prbayes report results.nc
  prbayes report results.nc optimum.nc validity.nc --title "Crack growth" --out crack.html
  prbayes report results.nc --markdown docs/crack

Files are netCDF: posteriors (sample_smc(...).to_netcdf), optima
(minimize(...).to_datatree().to_netcdf), validity tests (area_test(...).to_dataset().to_netcdf), and
tables of exceedance, sensitivity and plan (.to_netcdf), in any number and order. Nothing in them is
executed. Labels, and pictures that need the model or what was measured in a test, take prb.Report.
"""
_DEMO = """example:
  prbayes demo --out demo

Calibrates Paris' law of crack growth on eleven measured specimens, tests the result on ten others,
and writes results.nc, optimum.nc, validity.nc and report.html. It takes about half a minute.
"""


class UserError(Exception):
    """A mistake on the command line, in one line."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code: 0, or 2 for a mistake in it."""
    given = _parser().parse_args(arguments)
    _log_to_stderr(quiet=given.quiet)
    try:
        written = given.run(given)
    except UserError as error:
        sys.stderr.write(f"prbayes: {error}\n")
        return 2
    sys.stdout.write("".join(f"{path}\n" for path in written))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="prbayes",
        description="Statistical model calibration: reports from saved results, "
        "and a demonstration.",
        epilog="Paths of the files that were written go to stdout, one a line; "
        "everything else to stderr.",
    )
    parser.add_argument("--version", action="version", version=f"prbayes {version('prbayes')}")
    commands = parser.add_subparsers(required=True, metavar="command", title="commands")
    for add in (_add_report, _add_demo):
        command = add(commands)
        command.add_argument("-q", "--quiet", action="store_true", help="warnings only")
    return parser


def _add_report(commands: Any) -> Any:
    report = commands.add_parser(
        "report",
        help="a report from saved results",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_REPORT,
        description="Write a report from saved results, without the model that they came from.",
    )
    add = report.add_argument
    add(
        "files",
        nargs="+",
        type=Path,
        metavar="FILE.nc",
        help="posteriors, optima, validity tests, decisions",
    )
    add("--title", help="by default the name of the first file")
    add("--author", default="", help="below the title")
    add("--date", default="", help="below the title; none is made up")
    add("--out", type=Path, metavar="REPORT.html", help="report.html by default")
    add(
        "--markdown", type=Path, metavar="FOLDER", help="write report.md and pictures into a folder"
    )
    add("--no-pictures", action="store_true", help="text and tables only")
    report.set_defaults(run=_report)
    return report


def _add_demo(commands: Any) -> Any:
    demo = commands.add_parser(
        "demo",
        help="crack growth from end to end",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_DEMO,
        description="Run the crack growth case from end to end.",
    )
    add = demo.add_argument
    folder = Path("prbayes-demo")
    add("--out", type=Path, default=folder, metavar="FOLDER", help="prbayes-demo by default")
    # With fewer draws ArviZ tells no effective sample size.
    add("--draws", type=_at_least(10), default=1000, help="of each chain, 1000 by default")
    add("--chains", type=_at_least(1), default=4, help="4 by default")
    add("--seed", type=_at_least(0), default=1, help="1 by default")
    demo.set_defaults(run=_demo)
    return demo


def _at_least(minimum: int) -> Any:
    def whole(text: str) -> int:
        value = int(text)
        if value < minimum:
            raise argparse.ArgumentTypeError(f"got {value}, expected {minimum} or more")
        return value

    whole.__name__ = "whole number"
    return whole


def _log_to_stderr(*, quiet: bool) -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("prbayes: %(message)s"))
    log = logging.getLogger("prbayes")
    log.handlers[:] = [handler]
    log.propagate = False
    log.setLevel(logging.WARNING if quiet else logging.INFO)


def _report(given: argparse.Namespace) -> list[Path]:
    from prbayes.reports.report import Report

    try:
        report = Report(
            given.title or given.files[0].stem,
            **_results(given.files),
            author=given.author,
            date=given.date,
            pictures=not given.no_pictures,
        )
    except (TypeError, ValueError, KeyError) as error:
        raise UserError(f"{', '.join(map(str, given.files))}: {_line(error)}") from error
    except UserError:
        raise
    except Exception as error:  # whatever a part of a report makes of a crafted file
        raise UserError(
            f"{', '.join(map(str, given.files))}: got contents that cannot be reported "
            f"({type(error).__name__}: {_line(error)}), expected files as prbayes writes them"
        ) from error
    written = []
    try:
        if given.markdown is not None:
            written.append(report.to_markdown(given.markdown))
        if given.out is not None or given.markdown is None:
            written.append(report.to_html(given.out or Path("report.html")))
    except (OSError, ValueError) as error:
        raise UserError(f"cannot write: {_line(error)}") from error
    return written


def _results(files: Sequence[Path]) -> dict[str, Any]:
    """Return what files hold, as keywords of a report."""
    from prbayes.reports.decision import kind_of_decision

    paths = list(dict.fromkeys(files))
    labels = _labels(paths)
    kinds: dict[str, dict[str, Any]] = {
        **{"posterior": {}, "optimum": {}},
        **{"validity": {}, "decision": {}},
    }
    for path in paths:
        tree = _opened(path)
        if "posterior" in tree:
            kinds["posterior"][labels[path]] = tree
        elif "optimum" in tree:
            kinds["optimum"][labels[path]] = tree
        elif kind_of_decision(tree.to_dataset()) is not None:
            kinds["decision"][labels[path]] = tree.to_dataset()
        else:
            kinds["validity"][labels[path]] = _test_of(path, tree.to_dataset())
    # A decision keeps the name of its file, which says what was asked.
    decisions = kinds.pop("decision") or None
    return {kind: _plain(found, kind) for kind, found in kinds.items()} | {"decision": decisions}


def _demo(given: argparse.Namespace) -> list[Path]:
    try:
        given.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out: cannot write: {_line(error)}") from error
    from prbayes._demo import run_demo

    return run_demo(given.out, draws=given.draws, chains=given.chains, seed=given.seed)


def _labels(paths: list[Path]) -> dict[Path, str]:
    """Return the stems of files, or their whole paths where stems are not different."""
    stems = [p.stem for p in paths]
    return {p: p.stem if stems.count(p.stem) == 1 else str(p) for p in paths}


def _plain(results: dict[str, Any], kind: str) -> dict[str, Any] | None:
    """Call a single result by its kind, and not by its file."""
    return {kind: next(iter(results.values()))} if len(results) == 1 else results or None


def _opened(path: Path) -> xr.DataTree:
    """Read a file whole."""
    if not path.is_file():
        raise UserError(f"{path}: there is no such file")
    import xarray as xr

    from prbayes.reports.decision import kind_of_decision
    from prbayes.reports.schema import complaints

    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            found: xr.DataTree = tree.load()
    except Exception as error:  # whatever a reader makes of bytes that are no netCDF
        raise UserError(
            f"{path}: got no netCDF file that can be read ({_line(error):.100})"
        ) from error
    known = "u" in found.data_vars or kind_of_decision(found.to_dataset()) is not None
    if not known and not {"posterior", "optimum"} & set(found.children):
        raise UserError(
            f"{path}: got groups {sorted(found.children)}, expected results of prbayes: "
            "a group posterior or optimum, a validity test, or a table of a decision"
        )
    complaint = next(complaints(found), None)
    if complaint is not None:
        raise UserError(f"{path}: {complaint}; the file is damaged, or not of prbayes")
    return found


def _test_of(path: Path, dataset: xr.Dataset) -> ValidityTest:
    from prbayes.model.fingerprint import from_attributes
    from prbayes.validation.area_test import ValidityTest

    try:
        return ValidityTest(
            **{
                key: float(dataset[key])
                for key in ("statistic", "critical_value", "p_value", "alpha")
            },
            null=str(dataset.attrs["null"]),
            folded=bool(dataset["folded"]),
            u_values=dataset["u"].values,
            envelope=dataset[["lower", "upper"]].to_array().values,
            conditions=dataset["condition"].values.astype(str),
            specimens=dataset["specimen"].values.astype(str),
            identity=from_attributes(dataset.attrs),
        )
    except KeyError as error:
        raise UserError(
            f"{path}: got no {_line(error)}, expected a validity test saved by to_dataset()"
        ) from error


def _line(error: Exception) -> str:
    from prbayes.reports.report import visible

    # A KeyError puts its message in quotes.
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return visible(" ".join(text.split())) or type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
