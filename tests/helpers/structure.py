"""Figures of the structure of the code, computed from its syntax trees.

Print all figures, with the places that contribute most:

    uv run python tests/helpers/structure.py

`tests/test_house.py` compares most of them with the ceilings in `tests/structure_ceilings.json`.
Paths are relative to the root of the repository.
"""

from __future__ import annotations

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
_VAGUE = """
found own here there one other others each some those told seen said kept every both known left
these them theirs given wanted asked chosen made done before after
"""
# Pronouns, participles and adverbs, which are no nouns of the field.
VAGUE_NAMES = frozenset(_VAGUE.split())
_CONCRETE = """
ReweightedBound FreshBound ResimulatedBound FunctionMetric AreaMetric ProbabilityResidual KullbackLeibler
LogLikelihood Reweighted Resimulated Fresh
"""
# Classes of metrics and propagations that code outside their files must not test for.
CONCRETE_CLASSES = frozenset(_CONCRETE.split())
# Number of places that a figure lists.
MAX_PLACES = 5

type Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Module:
    """A module with its dotted name, its path in the repository and its syntax tree."""

    name: str
    path: str
    tree: ast.Module
    nodes: tuple[ast.AST, ...]  # of the tree, in the order of `ast.walk`


@dataclass(frozen=True)
class Figure:
    """A figure, and the places that contribute most to it, largest first."""

    value: float
    places: tuple[str, ...] = ()


@cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a file, which several tests read."""
    return ast.parse(path.read_text(encoding="utf-8"))


def read(package: Path) -> list[Module]:
    """Return the modules of a package, sorted by path."""
    modules = []
    for path in sorted(package.rglob("*.py")):
        relative = path.relative_to(package.parent)
        name = ".".join(relative.with_suffix("").parts).removesuffix(".__init__")
        tree = parsed(path)
        modules.append(Module(name, relative.as_posix(), tree, tuple(ast.walk(tree))))
    return modules


def functions(module: Module) -> Iterator[Function]:
    """Yield all functions and methods of a module, nested ones included."""
    for node in module.nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def largest(sizes: Iterable[tuple[float, str]]) -> tuple[str, ...]:
    """Return the places with the largest sizes, as text."""
    ordered = sorted(sizes, reverse=True)[:MAX_PLACES]
    return tuple(f"{place} ({size:.4g})" for size, place in ordered if size)


def vague_names(modules: Sequence[Module]) -> Figure:
    """Return the percentage of assigned variable names that are vague words."""
    n_assigned = 0
    by_name: Counter[str] = Counter()
    by_file: Counter[str] = Counter()
    for module in modules:
        for node in module.nodes:
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                n_assigned += 1
                if node.id in VAGUE_NAMES:
                    by_name[node.id] += 1
                    by_file[module.path] += 1
    share = 100 * by_name.total() / max(n_assigned, 1)
    words = largest((count, name) for name, count in by_name.items())
    files = largest((count, path) for path, count in by_file.items())
    return Figure(round(share, 2), words + files)


def called_names(function: Function) -> set[str]:
    """Return the names of the functions and methods that a function calls."""
    calls = [node.func for node in ast.walk(function) if isinstance(node, ast.Call)]
    names = {called.id for called in calls if isinstance(called, ast.Name)}
    return names | {called.attr for called in calls if isinstance(called, ast.Attribute)}


def longest_call_chain(modules: Sequence[Module]) -> Figure:
    """Return the length of the longest static chain of calls inside the package.

    A lower bound: the chain has only functions whose name is defined once in the package, and a
    recursive call ends it.
    """
    n_definitions: Counter[str] = Counter()
    calls: dict[str, set[str]] = defaultdict(set)
    for module in modules:
        for function in functions(module):
            n_definitions[function.name] += 1
            calls[function.name] |= called_names(function)
    unique = {n for n, count in n_definitions.items() if count == 1 and not n.startswith("__")}
    graph = {name: sorted((calls[name] & unique) - {name}) for name in sorted(unique)}
    chains: dict[str, tuple[str, ...]] = {}

    def chain_from(name: str, callers: frozenset[str]) -> tuple[str, ...]:
        if name in callers:
            return ()
        if name not in chains:
            tails = [chain_from(callee, callers | {name}) for callee in graph[name]]
            chains[name] = (name, *max(tails, key=len, default=()))
        return chains[name]

    chain = max((chain_from(name, frozenset()) for name in graph), key=len, default=())
    return Figure(len(chain), (" > ".join(chain),))


def is_numeric_constant(statement: ast.stmt) -> bool:
    """Return whether a statement assigns numbers to a name in capitals."""
    if isinstance(statement, ast.Assign):
        target, value = statement.targets[0], statement.value
    elif isinstance(statement, ast.AnnAssign | ast.AugAssign) and statement.value is not None:
        target, value = statement.target, statement.value
    else:
        return False
    if not (isinstance(target, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", target.id)):
        return False
    literals = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    # Not isinstance: True and False are integers for it.
    has_numbers = any(type(literal) in (int, float) for literal in literals)
    return has_numbers and not any(isinstance(literal, str) for literal in literals)


def numeric_constants(modules: Sequence[Module]) -> Figure:
    """Return the number of numeric constants at the top of modules."""
    counts = [(sum(map(is_numeric_constant, m.tree.body)), m.path) for m in modules]
    return Figure(sum(count for count, _ in counts), largest(counts))


def largest_class(modules: Sequence[Module]) -> Figure:
    """Return the number of methods, properties and fields of the largest class."""
    sizes = []
    for module in modules:
        for node in module.nodes:
            if isinstance(node, ast.ClassDef):
                names = {
                    member.name
                    for member in node.body
                    if isinstance(member, ast.FunctionDef | ast.AsyncFunctionDef)
                }
                names |= {
                    member.target.id
                    for member in node.body
                    if isinstance(member, ast.AnnAssign) and isinstance(member.target, ast.Name)
                }
                n_members = sum(not name.startswith("__") for name in names)
                sizes.append((n_members, f"{module.path}:{node.name}"))
    return Figure(max(sizes, default=(0, ""))[0], largest(sizes))


def body_without_docstring(function: Function) -> list[ast.stmt]:
    """Return the statements of a function that are no plain text."""
    return [
        statement
        for statement in function.body
        if not (
            isinstance(statement, ast.Expr)
            and isinstance(statement.value, ast.Constant)
            and isinstance(statement.value.value, str)
        )
    ]


def nodes_and_lines(function: Function) -> tuple[int, int]:
    """Return the number of syntax nodes of a function body, and of the lines where nodes start."""
    nodes = [node for part in body_without_docstring(function) for node in ast.walk(part)]
    lines = {node.lineno for node in nodes if hasattr(node, "lineno")}
    return len(nodes), len(lines)


def density(modules: Sequence[Module]) -> Figure:
    """Return the number of syntax nodes per code line of function bodies."""
    n_nodes = n_lines = 0
    by_file = []
    for module in modules:
        counts = [nodes_and_lines(function) for function in functions(module)]
        nodes = sum(count for count, _ in counts)
        lines = sum(count for _, count in counts)
        n_nodes += nodes
        n_lines += lines
        by_file.append((nodes / max(lines, 1), module.path))
    return Figure(round(n_nodes / max(n_lines, 1), 1), largest(by_file))


def longest_function(modules: Sequence[Module]) -> Figure:
    """Return the number of lines of the longest function body, its docstring excluded."""
    sizes = []
    for module in modules:
        for function in functions(module):
            body = body_without_docstring(function)
            if body:
                n_lines = (body[-1].end_lineno or 0) - body[0].lineno + 1
                sizes.append((n_lines, f"{module.path}:{function.name}"))
    return Figure(max(sizes, default=(0, ""))[0], largest(sizes))


def most_parameters(modules: Sequence[Module]) -> Figure:
    """Return the largest number of parameters of a function, ``*args`` and ``**kwargs`` excluded."""
    sizes = []
    for module in modules:
        for function in functions(module):
            arguments = function.args
            parameters = arguments.posonlyargs + arguments.args + arguments.kwonlyargs
            sizes.append((len(parameters), f"{module.path}:{function.name}"))
    return Figure(max(sizes, default=(0, ""))[0], largest(sizes))


def private_functions(modules: Sequence[Module]) -> Figure:
    """Return the number of private functions per public function, special methods excluded."""
    n_private = n_public = 0
    by_file = []
    for module in modules:
        names = [f.name for f in functions(module) if not f.name.startswith("__")]
        private = sum(name.startswith("_") for name in names)
        n_private += private
        n_public += len(names) - private
        by_file.append((private, module.path))
    return Figure(round(n_private / max(n_public, 1), 2), largest(by_file))


def imported_modules(module: Module, names: set[str]) -> set[str]:
    """Return the modules of the package, out of ``names``, that a module imports."""
    imported: set[str] = set()
    for node in module.nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                imported.add(submodule if submodule in names else node.module)
        elif isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
    return imported & names


def import_circles(modules: Sequence[Module]) -> Figure:
    """Return the number of groups of modules that import each other.

    The top-level package is no part of a circle: it loads its public names lazily.
    """
    names = {module.name for module in modules}
    top = {name for name in names if "." not in name}
    imports = {module.name: imported_modules(module, names) - top for module in modules}

    def reachable(start: str) -> set[str]:
        visited: set[str] = set()
        pending = [start]
        while pending:
            new = imports[pending.pop()] - visited
            visited |= new
            pending += new
        return visited

    reach = {name: reachable(name) for name in names}
    circles = {
        frozenset(member for member in reach[name] if name in reach[member])
        for name in names
        if name in reach[name]
    }
    return Figure(len(circles), tuple(sorted(", ".join(sorted(circle)) for circle in circles)))


def type_switches(modules: Sequence[Module]) -> Figure:
    """Return the number of ``isinstance`` calls on a concrete class outside its file."""
    places = []
    for module in modules:
        defined = {node.name for node in module.tree.body if isinstance(node, ast.ClassDef)}
        for node in module.nodes:
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
                continue
            if node.func.id == "isinstance" and len(node.args) > 1:
                types = {n.id for n in ast.walk(node.args[1]) if isinstance(n, ast.Name)}
                if (types & CONCRETE_CLASSES) - defined:
                    places.append(f"{module.path}:{node.lineno}")
    return Figure(len(places), tuple(places))


def limited_figures(package: Path) -> dict[str, Figure]:
    """Return the figures of a package that have a ceiling, by name."""
    modules = read(package)
    return {
        "vague names among assignments, %": vague_names(modules),
        "longest static chain of calls": longest_call_chain(modules),
        "module-level numeric constants": numeric_constants(modules),
        "members of the largest class": largest_class(modules),
        "syntax nodes per code line": density(modules),
        "longest function body, lines": longest_function(modules),
        "most parameters": most_parameters(modules),
        "private functions per public function": private_functions(modules),
        "import circles": import_circles(modules),
        "type switches outside their file": type_switches(modules),
    }


def n_lines(folder: Path) -> int:
    """Return the number of lines of all Python files in a folder."""
    return sum(len(p.read_text(encoding="utf-8").splitlines()) for p in folder.rglob("*.py"))


def figures(root: Path = ROOT) -> dict[str, Figure]:
    """Return all figures of the repository by name, sizes without a ceiling last."""
    package = root / "prbayes"
    sizes = {"modules": Figure(len(list(package.rglob("*.py"))))}
    for folder in ("prbayes", "tests", "benchmarks"):
        sizes[f"lines of {folder}/"] = Figure(n_lines(root / folder))
    words = (root / "CHANGELOG.md").read_text(encoding="utf-8").split()
    return limited_figures(package) | sizes | {"words of CHANGELOG.md": Figure(len(words))}


def slack(ceiling: float) -> float:
    """Return how far a figure may be below its ceiling: 2 % of it, but at least 0.05."""
    return max(0.02 * ceiling, 0.05)


def ceiling_error(name: str, figure: Figure, ceiling: float) -> str:
    """Return why a figure and its ceiling do not agree, or an empty text."""
    if figure.value > ceiling:
        places = "\n  ".join(figure.places)
        return f"{name}: got {figure.value:g}, expected at most {ceiling:g}; largest:\n  {places}"
    if figure.value < ceiling - slack(ceiling):
        return f"{name}: lower the ceiling to {figure.value:g} (now {ceiling:g})"
    return ""


def print_table() -> None:
    """Print all figures with the places that contribute most."""
    for name, figure in figures().items():
        print(f"{name:40} {figure.value:>8g}   {'; '.join(figure.places)[:180]}")


if __name__ == "__main__":
    print_table()
