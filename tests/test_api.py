"""Public names and signatures are those of `tests/api.json`, which docs/stability.md promises.

After a change that is wanted, write the file again:

    uv run python tests/test_api.py
"""

from __future__ import annotations

import inspect
import json
import re
from enum import Enum
from pathlib import Path
from typing import Any

import prbayes

FILE = Path(__file__).with_name("api.json")


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


def test_public_names_and_signatures_are_those_that_are_promised() -> None:
    promised = json.loads(FILE.read_text(encoding="utf-8"))
    assert json.loads(as_text()) == promised, (
        "see the docstring of this file, and docs/stability.md"
    )


if __name__ == "__main__":
    FILE.write_text(as_text(), encoding="utf-8")
