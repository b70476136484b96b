"""Statistical model calibration in PyMC: optimiser and ABC on one model, with one metric."""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from prbayes._public import *  # noqa: F403

__version__ = version("prbayes")


def __getattr__(name: str) -> Any:
    """Load the public names when the first is asked for: the command line answers before."""
    # What Python itself looks for in any module is none of them.
    if name == "__all__" or not name.startswith("_"):
        public = import_module("prbayes._public")
        if hasattr(public, name):
            return getattr(public, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return what there is, for completion."""
    return [*globals(), *__getattr__("__all__")]
