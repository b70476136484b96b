"""A stand-in for an external solver: reads an input file, writes an output file.

Deflection of a simply supported beam under a load at mid-span, w = F L^3 / (48 E I), in
millimetres.
"""

import sys
from pathlib import Path

source, target = map(Path, sys.argv[1:])
values = dict(line.split("=") for line in source.read_text().split())
modulus = float(values["modulus_gpa"]) * 1e9
force = float(values["force_n"])
length = 2.0
inertia = 8.0e-7
target.write_text(f"deflection_mm {1e3 * force * length**3 / (48 * modulus * inertia):.9g}\n")
