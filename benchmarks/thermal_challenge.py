"""The figures of the thermal challenge problem, as its page tells them, and of its conduction.

Run: python -m benchmarks.thermal_challenge
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

from benchmarks import record

EXAMPLE = Path(__file__).parents[1] / "examples" / "thermal_challenge.py"
# Where the series' error is told: flux in W/m^2, thickness in m.
PLACES = {"ensemble": (1000.0, 0.0254), "accreditation": (3000.0, 0.019), "device": (3500.0, 0.019)}
# A slab of about the middle of the population: W/(m C), W/(m C), J/(m^3 C).
MIDDLE = (0.0499, 0.026, 3.93e5)


def example() -> Any:
    """Return the example as a module."""
    spec = importlib.util.spec_from_file_location("thermal_challenge", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def of_conductivity(module: Any) -> dict[str, dict[str, float]]:
    """Return the heated face after 1000 s by three treatments of the conductivity, in C."""
    found = {}
    conductivity, rise, capacity = MIDDLE
    for name, (flux, thickness) in PLACES.items():
        exact = module.differences(*MIDDLE, flux, thickness, 1000.0, cells=80, steps=800)
        mean = module.slab(*MIDDLE, flux, thickness, 1000.0)
        middle = conductivity + module.RISE.value(rise, 500.0)
        constant = module.series(middle, capacity, flux, thickness, 1000.0)
        found[name] = {
            "differences": float(exact),
            "at the mean temperature": float(mean - exact),
            "at 500 C": float(constant - exact),
        }
    return found


def main() -> None:
    """Run the study, print and save what it finds, and draw the picture."""
    module = example()
    found, kept = module.study()
    module.report(found)
    found["conductivity"] = of_conductivity(module)
    print(found["conductivity"])
    record.save(record.RESULTS / "thermal_challenge.json", found)
    module.picture(kept, EXAMPLE.parents[1] / "docs" / "images")


if __name__ == "__main__":
    main()
