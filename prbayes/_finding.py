"""Findings: conditions that a reader of a result should know."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from pathlib import Path

from prbayes._validate import NamedValues, plain_text

_log = logging.getLogger("prbayes")
_unreported: ContextVar[bool] = ContextVar("unreported", default=False)


@dataclass(frozen=True)
class Finding:
    """A condition that a reader of the result should know.

    Parameters
    ----------
    code : str
        Stable identifier, such as ``"rounded-data"``, by which findings are filtered;
        ``prb.help()`` lists all.
    text : str
        One or two sentences for the reader: got, expected, what to do.
    page : str, optional
        Documentation page with details and the heading, such as ``"my_data.md#outliers"``.
        A constant: tests check that page and heading exist, and that `help` shows the section.

    Examples
    --------
    >>> from prbayes._finding import Finding
    >>> finding = Finding("rounded-data", "The data are rounded.", "my_data.md#outliers")
    >>> print(finding)
    The data are rounded; see prb.help("rounded-data").
    """

    code: str
    text: str
    page: str = ""

    def __str__(self) -> str:
        """Return the text, with the call that shows its page before the final period."""
        if not self.page:
            return self.text
        sentence = self.text.removesuffix(".")
        period = self.text[len(sentence) :]
        return f'{sentence}; see prb.help("{self.code}"){period}'


Findings = tuple[Finding, ...]  # findings in the order in which they are reported


def counted(n: int, noun: str, plural: str = "") -> str:
    """Return a number with a noun, in the plural unless the number is one."""
    return f"{n} {noun}" if n == 1 else f"{n} {plural or f'{noun}s'}"


def any_of(*remedies: str) -> str:
    """Return remedies as a text, "a, b, or c"; empty ones are left out."""
    *first, last = [remedy for remedy in remedies if remedy] or [""]
    return f"{', '.join(first)}, or {last}" if first else last


def report(*findings: Finding, level: int = logging.WARNING) -> Findings:
    """Log findings with the logger ``prbayes``, each record with its ``code``; return them."""
    for finding in () if _unreported.get() else findings:
        _log.log(level, "%s", finding, extra={"code": finding.code})
    return findings


@contextmanager
def unreported() -> Iterator[None]:
    """Log no findings, because those of many results are reported together afterwards."""
    token = _unreported.set(True)
    try:
        yield
    finally:
        _unreported.reset(token)


def as_json(findings: Iterable[Finding]) -> str:
    """Return findings as one attribute of a stored result."""
    return json.dumps([asdict(finding) for finding in findings])


def sentences_of(attrs: NamedValues) -> list[str]:
    """Return the findings in the attributes of a stored result as sentences."""
    return [str(finding) for finding in from_json(attrs.get("findings", "[]"))]


def from_json(text: str) -> Findings:
    """Return the findings of an attribute of a stored result, or raise `ValueError`."""
    try:
        records = json.loads(text)
        return tuple(
            Finding(*(str(record[key]) for key in ("code", "text", "page")))
            for record in (records if isinstance(records, list) else [records])
        )
    except (TypeError, KeyError, ValueError):
        raise ValueError(
            f"findings: got {text[:80]!r}, expected a JSON list of records of code, text and page; "
            "the file was changed, or is of another version"
        ) from None


class Help(str):
    """Text that a console shows as it is, and a notebook as Markdown."""

    __slots__ = ()
    __repr__ = str.__str__

    def _repr_markdown_(self) -> str:
        return str(self)


def help(code: str | None = None) -> Help:
    """Explain the code of a finding, or list all codes.

    Parameters
    ----------
    code : str, optional
        Code of a finding, such as ``"rounded-data"``. Without a code, all are listed.

    Returns
    -------
    str
        Markdown: the meaning of the code, what to do, and the sections of the documentation about
        it. A console shows the text without quotes, a notebook shows it formatted.

    Raises
    ------
    TypeError
        If ``code`` is no text.
    ValueError
        If no finding has this code. The message has the nearest codes.

    Examples
    --------
    >>> import prbayes as prb
    >>> prb.help("prior-misfit")
    `prior-misfit`: The data do not fit the population at an optimum with the prior. Look at \
`prb.minimize` without the prior.
    >>> print(prb.help("rounded-data").splitlines()[2])
    ## Rounded data
    """
    rows = dict(re.findall(r"^\| `([\w-]+)` \| (.*) \|$", _page("findings.md"), re.MULTILINE))
    if code is None:
        first = {key: _plain(text).split(". ")[0].rstrip(".") for key, text in rows.items()}
        listed = "".join(f"- `{key}`: {sentence}.\n" for key, sentence in first.items())
        return Help(f'Codes of findings. `prb.help("rounded-data")` explains one.\n\n{listed}')
    if plain_text(code, "code") not in rows:
        near = ", ".join(map(repr, get_close_matches(code, rows, cutoff=0.4)))
        raise ValueError(
            f"code: got {code!r}, expected the code of a finding{near and f', such as {near}'}; "
            "prb.help() lists all"
        )
    text, _, links = rows[code].partition(" See [")
    sections = [_section(link) for link in re.findall(r"\]\((.*?)\)", links)]
    return Help("\n\n".join([f"`{code}`: {_plain(text)}", *sections]))


def _page(name: str) -> str:
    """Return a page of the documentation, from the installed package or from the repository."""
    package = Path(__file__).parent
    folder = package / "docs" if (package / "docs").is_dir() else package.parent / "docs"
    return (folder / name).read_text(encoding="utf-8")


def _section(link: str) -> str:
    """Return the section of a page that a link such as ``"my_data.md#outliers"`` names."""
    name, _, anchor = link.partition("#")
    text = _page(name)
    headings = list(re.finditer(r"^(##+) (.+)$", text, re.MULTILINE))
    # GitHub and the site derive anchors from headings in this way.
    anchors = [re.sub(r"[^\w -]", "", h[2]).lower().replace(" ", "-") for h in headings]
    start = anchors.index(anchor)
    later = (h.start() for h in headings[start + 1 :] if len(h[1]) <= len(headings[start][1]))
    return _plain(text[headings[start].start() : next(later, len(text))])


def _plain(text: str) -> str:
    """Return a part of a page as Markdown without hidden code, directives and relative links."""
    for pattern, replacement in (
        (r"^```\{code-cell\} ipython3\n:tags: \[[^\n]*remove-(?:cell|input).*?^```\n+", ""),
        (r"^```\{code-cell\} ipython3\n(?::tags: [^\n]*\n)?\n*", "```python\n"),
        (r"\{[\w:-]+\}`([^`<]*[^`< ])(?: *<[^`]*>)?`", r"`\1`"),
        (r"(?<!!)\[([^\]]+)\]\((?!http)[^)]*\)", r"\1"),
        (r"^<!--.*?-->\n", ""),
    ):
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE | re.DOTALL)
    return text.strip()
