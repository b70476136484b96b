"""Public names and signatures are those of `tests/api.json`, which docs/stability.md promises.

After names or keywords were added, write the file again:

    uv run python tests/test_api.py

It refuses what version 1 does not allow: names and parameters that are gone, moved or have other
defaults, and new parameters that are positional or have no default. Only version 2 may remove a
name, one that has raised a FutureWarning before.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
from enum import Enum
from pathlib import Path
from typing import Any

import pytest
from typing_extensions import deprecated  # in Python 3.13 `warnings.deprecated`

import prbayes

FILE = Path(__file__).with_name("api.json")
TEMPLATE = FILE.parents[1] / "docs/_templates/autosummary/class.rst"
# Names that docs/stability.md lists as experimental.
EXPERIMENTAL = re.compile(
    r"Metric$|metrics$|propagation$|families$|calibrate_each$|fmu$"
    r"|response\.(Additive|Multiplicative|Smooth)$"
)


def signature(value: Any) -> str:
    """Return parameters with their kinds and defaults, without annotations."""
    try:
        parameters = inspect.signature(value).parameters.values()
    except ValueError:  # of built-in exceptions
        return "(...)"
    plain = [p.replace(annotation=inspect.Parameter.empty) for p in parameters]
    # A default that is a function has an address.
    return re.sub(r" at 0x[0-9a-f]+", "", str(inspect.Signature(plain)))


def members(cls: type) -> dict[str, str]:
    """Return the public attributes that a class of this package defines, with signatures."""
    result: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not base.__module__.startswith("prbayes"):
            continue
        fields = [name for name in vars(base).get("__annotations__", {}) if name[0] != "_"]
        result |= dict.fromkeys(fields, "attribute")
        for name, value in vars(base).items():
            if name.startswith("_") or name in fields:
                continue
            inner = getattr(value, "__func__", value)
            result[name] = signature(inner) if inspect.isfunction(inner) else "attribute"
    return result


def public(module: Any) -> dict[str, Any]:
    """Return the public names of a module, with signatures, and those of its namespaces."""
    result: dict[str, Any] = {}
    for name in module.__all__:
        value = getattr(module, name)
        if inspect.ismodule(value):
            result[name] = public(value)
        elif inspect.isclass(value):
            call = "enumeration" if issubclass(value, Enum) else signature(value)
            result[name] = {"()": call} | members(value)
        else:
            result[name] = signature(value) if callable(value) else type(value).__name__
    return result


def as_text() -> str:
    """Return the public names as the file has them."""
    return json.dumps(public(prbayes), indent=1, sort_keys=True) + "\n"


def extends(promised: str, signature: str) -> bool:
    """Return whether a signature adds nothing but keywords with defaults."""
    if "(" not in promised or "(" not in signature:
        return False
    (old, old_keywords), (new, keywords) = map(parameters, (promised, signature))
    added = keywords.keys() - old_keywords.keys()
    kept = old_keywords.items() <= keywords.items()
    return old == new and kept and None not in {keywords[name] for name in added}


def parameters(signature: str) -> tuple[list[Any], dict[str, str | None]]:
    """Return positional parameters in order, and keywords, with their defaults."""
    (function,) = ast.parse(f"def f{signature}: ...").body
    assert isinstance(function, ast.FunctionDef)
    found = function.args
    positional = [ast.dump(x) for x in (*found.posonlyargs, *found.args, *found.defaults)]
    pairs = zip(found.kwonlyargs, found.kw_defaults, strict=True)
    return [*positional, found.vararg and found.vararg.arg, found.kwarg and found.kwarg.arg], {
        name.arg: default and ast.dump(default) for name, default in pairs
    }


def broken(promised: dict[str, Any], names: dict[str, Any], path: str = "") -> list[str]:
    """Return the promises on names and signatures that a version does not keep."""
    problems = []
    template = TEMPLATE.read_text(encoding="utf-8")
    for name, old in promised.items():
        where = f"{path}{name}"
        new = names.get(name)
        if EXPERIMENTAL.match(where) or old == new:
            continue
        if isinstance(old, dict) and "()" in old and f'"{name}"' not in template:
            old = {"()": old["()"]}  # the reference shows no methods of this class
        if isinstance(old, dict) and isinstance(new, dict):
            problems += broken(old, new, f"{where}.")
        elif not (isinstance(new, str) and extends(old, new)):
            problems.append(f"{where}: got {new}, promised {old}")
    return problems


@pytest.mark.parametrize(
    ("signature", "is_kept"),
    [
        ("(x, y=1, *, z=2)", True),
        ("(x, y=1, *, new=None, z=2)", True),
        ("(x, y=1, *, new, z=2)", False),
        ("(x, y=1, new=0, *, z=2)", False),
        ("(x, y=2, *, z=2)", False),
        ("(x, y=1, *, z=3)", False),
        ("(y, x=1, *, z=2)", False),
        ("(x, y=1)", False),
        ("attribute", False),
    ],
)
def test_only_keywords_with_defaults_may_be_added(signature: str, is_kept: bool) -> None:
    promised = {"space": {"f": "(x, y=1, *, z=2)"}}
    assert (broken(promised, {"space": {"f": signature, "g": "()"}}) == []) is is_kept
    assert broken(promised, {"space": {}}) == ["space.f: got None, promised (x, y=1, *, z=2)"]
    assert broken({"fmu": "(x)"}, {}) == []


def test_what_is_experimental_is_in_the_documentation() -> None:
    page = (FILE.parents[1] / "docs/stability.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.*) \|.*\|$", page.partition("## Experimental")[2], re.MULTILINE)
    names = re.findall(r"`(?:prb\.)?([\w.]+)`", "\n".join(rows))
    names = [f"response.{name}" if name in prbayes.response.__all__ else name for name in names]
    assert len(names) == 6
    assert all(EXPERIMENTAL.match(name) for name in names)


def calls(names: dict[str, Any], path: str = "") -> dict[str, str]:
    """Return the signatures of functions, classes and methods by their dotted names."""
    result: dict[str, str] = {}
    for name, value in names.items():
        where = f"{path}{name}"
        result |= calls(value, f"{where}.") if isinstance(value, dict) else {where: value}
    return {name: value for name, value in result.items() if value.startswith("(")}


@pytest.mark.parametrize(
    ("parameter", "owners"),
    [
        ("alpha", r"area_test|calibrate_each|validation\.|readings\.NegativeBinomial\.\(\)"),
        (
            "n",
            r"(Fresh|Resimulated|Reweighted)\.\(\)|Surrogate\.fit|propose_runs"  # responses
            r"|Summary\.\(\)|LogLikelihood\.of_frequencies|validation\.ExactModel"  # a sample
            r"|readings\.Binomial\.\(\)",
        ),
        ("target", r"\w+\.(for_inputs|bind|check_simulator)$|propagation\."),
    ],
)
def test_symbols_have_the_meanings_that_are_documented(parameter: str, owners: str) -> None:
    taking = [
        name
        for name, signature in calls(public(prbayes)).items()
        if re.search(rf"[( ]{parameter}[=,)]", signature)
    ]
    assert len(taking) > 3
    assert not [name for name in taking if not re.match(owners, name)]


def test_a_deprecated_name_warns_with_its_replacement_and_keeps_its_promise() -> None:
    @deprecated("prb.old is removed in 2.0: use prb.new", category=FutureWarning)
    def old(x: float, *, scale: float = 1.0) -> float:
        return scale * x

    class Old:
        # Decorating the class itself would hide its signature.
        @deprecated("prb.Old is removed in 2.0: use prb.New", category=FutureWarning)
        def __init__(self, x: float) -> None:
            self.x = x

    with pytest.warns(FutureWarning, match="use prb.new") as caught:
        assert old(2.0, scale=3.0) == 6.0
    assert caught[0].filename == __file__  # the line of the user
    with pytest.warns(FutureWarning, match="use prb.New"):
        assert Old(2.0).x == 2.0
    assert signature(old) == "(x, *, scale=1.0)"
    assert signature(Old) == "(x)"


def test_public_names_and_signatures_are_those_that_are_promised() -> None:
    promised = json.loads(FILE.read_text(encoding="utf-8"))
    assert json.loads(as_text()) == promised, (
        "see the docstring of this file, and docs/stability.md"
    )


if __name__ == "__main__":
    if problems := broken(json.loads(FILE.read_text(encoding="utf-8")), public(prbayes)):
        sys.exit("\n".join(problems))
    FILE.write_text(as_text(), encoding="utf-8")
