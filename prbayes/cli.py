"""The command line: ``python -m prbayes report results.nc``."""

# Heavy modules are imported in functions, so that help and errors appear at once.

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

_EXAMPLES = """examples:
  prbayes report results.nc
  prbayes report results.nc optimum.nc validity.nc --title "Crack growth" --out crack.html
  prbayes report results.nc --markdown docs/crack

Files are netCDF: posteriors (sample_smc(...).to_netcdf), optima
(minimize(...).to_datatree().to_netcdf), validity tests (area_test(...).to_dataset().to_netcdf), and
tables of exceedance, sensitivity and plan (.to_netcdf), in any number and order. Nothing in them is
executed. Labels, and pictures that need the model or what was measured in a test, take prb.Report.
"""


class UserError(Exception):
    """A mistake on the command line, in one line."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code: 0, or 2 for a mistake in it."""
    options = _parser().parse_args(arguments)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("prbayes: %(message)s"))
    log = logging.getLogger("prbayes")
    log.handlers[:] = [handler]
    log.propagate = False
    log.setLevel(logging.WARNING if options.quiet else logging.INFO)
    try:
        paths = _report(options)
    except UserError as error:
        sys.stderr.write(f"prbayes: {error}\n")
        return 2
    sys.stdout.write("".join(f"{path}\n" for path in paths))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="prbayes",
        description="Statistical model calibration: reports from saved results.",
        epilog="Paths of the files that were written go to stdout, one a line; "
        "everything else to stderr.",
    )
    parser.add_argument("--version", action="version", version=f"prbayes {version('prbayes')}")
    commands = parser.add_subparsers(required=True, metavar="command", title="commands")
    report = commands.add_parser(
        "report",
        help="a report from saved results",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_EXAMPLES,
        description="Write a report from saved results, without the model that they came from.",
    )
    add = report.add_argument
    kinds = "posteriors, optima, validity tests, decisions"
    add("files", nargs="+", type=Path, metavar="FILE.nc", help=kinds)
    add("--title", help="by default the name of the first file")
    add("--author", default="", help="below the title")
    add("--date", help="below the title; that of the results by default")
    add("--out", type=Path, metavar="REPORT.html", help="report.html by default")
    add("--force", action="store_true", help="replace files that exist")
    pictures = "write report.md and pictures into a folder"
    add("--markdown", type=Path, metavar="FOLDER", help=pictures)
    add("--no-pictures", action="store_true", help="text and tables only")
    add("-q", "--quiet", action="store_true", help="warnings only")
    return parser


def _report(options: argparse.Namespace) -> list[Path]:
    """Write the documents that the options name; return their paths."""
    from prbayes.reports.document import Report

    files = ", ".join(map(str, options.files))
    html = options.out or (None if options.markdown is not None else Path("report.html"))
    _refuse_to_replace(options, html)
    try:
        report = Report(
            options.title or options.files[0].stem,
            **_results(options.files),
            author=options.author,
            date=options.date,
            pictures=not options.no_pictures,
        )
    except UserError:
        raise
    except (TypeError, ValueError, KeyError) as error:
        raise UserError(f"{files}: {_line(error)}") from error
    except Exception as error:  # a damaged file may cause any exception in a report
        raise UserError(
            f"{files}: got contents that cannot be reported ({type(error).__name__}: "
            f"{_line(error)}), expected files as prbayes writes them"
        ) from error
    paths = []
    try:
        if options.markdown is not None:
            paths.append(report.to_markdown(options.markdown))
        if html is not None:
            paths.append(report.to_html(html))
    except (OSError, ValueError) as error:
        raise UserError(f"cannot write: {_line(error)}") from error
    return paths


def _refuse_to_replace(options: argparse.Namespace, html: Path | None) -> None:
    """Raise if the documents would replace the results, or (without --force) any other file."""
    if html is not None and any(html.resolve() == path.resolve() for path in options.files):
        raise UserError(f"{html}: got the path of results, expected another path for the report")
    if options.force:
        return
    taken = [html] if html is not None and html.is_file() else []
    if options.markdown is not None and options.markdown.is_dir():
        for pattern in ("report.md", "[0-9][0-9]-*.*g"):  # pictures: svg, png, jpg
            taken += sorted(options.markdown.glob(pattern))
    if taken:
        raise UserError(
            f"{taken[0]}: got a file that exists, expected a new one; pass --out or --markdown "
            "with another path, or --force to replace it"
        )


def _results(files: Sequence[Path]) -> dict[str, Any]:
    """Return the contents of files as keywords of a report."""
    from prbayes.reports.material import kind_of_decision

    paths = list(dict.fromkeys(files))
    stems = [path.stem for path in paths]
    results: dict[str, dict[str, Any]] = {}
    for path in paths:
        tree = _opened(path)
        dataset = tree.to_dataset()
        value: Any
        if "posterior" in tree or "optimum" in tree:
            kind = "posterior" if "posterior" in tree else "optimum"
            value = tree
        elif kind_of_decision(dataset) is not None:
            kind, value = "decision", dataset
        else:
            kind = "validity"
            value = _validity_test(path, dataset)
        label = path.stem if stems.count(path.stem) == 1 else str(path)
        results.setdefault(kind, {})[label] = value
    # A decision keeps the name of its file, because that describes it. Any other single result is
    # named by its kind.
    for kind, by_label in results.items():
        if len(by_label) == 1 and kind != "decision":
            results[kind] = {kind: next(iter(by_label.values()))}
    return dict(results)


def _opened(path: Path) -> xr.DataTree:
    """Return the contents of a file, or raise if they are not results of prbayes."""
    if not path.is_file():
        raise UserError(f"{path}: got no such file, expected saved results")
    import xarray as xr

    from prbayes.reports.material import kind_of_decision

    try:
        with xr.open_datatree(path, engine="h5netcdf") as stored:
            tree = stored.load()
    except Exception as error:  # a reader may raise anything for a file that is no netCDF
        raise UserError(
            f"{path}: got no netCDF file that can be read ({_line(error):.100})"
        ) from error
    is_table = "u" in tree.data_vars or kind_of_decision(tree.to_dataset()) is not None
    if not is_table and not {"posterior", "optimum"} & set(tree.children):
        raise UserError(
            f"{path}: got groups {sorted(tree.children)}, expected results of prbayes: "
            "a group posterior or optimum, a validity test, or a table of a decision"
        )
    return tree


def _validity_test(path: Path, dataset: xr.Dataset) -> ValidityTest:
    from prbayes.model.fingerprint import identity_from_attributes
    from prbayes.validation.area_test import ValidityTest

    numbers = ("statistic", "critical_value", "p_value", "alpha")
    try:
        return ValidityTest(
            **{key: float(dataset[key]) for key in numbers},
            null=str(dataset.attrs["null"]),
            folded=bool(dataset["folded"]),
            u_values=dataset["u"].values,
            envelope=dataset[["lower", "upper"]].to_array().values,
            conditions=dataset["condition"].values.astype(str),
            specimens=dataset["specimen"].values.astype(str),
            identity=identity_from_attributes(dataset.attrs),
        )
    except KeyError as error:
        raise UserError(
            f"{path}: got no {_line(error)}, expected a validity test saved by to_dataset()"
        ) from error


def _line(error: Exception) -> str:
    """Return the message of an error in one line."""
    from prbayes.reports.document import visible

    # A KeyError puts its message in quotes.
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return visible(" ".join(text.split())) or type(error).__name__
