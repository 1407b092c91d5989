"""The package's own imports as a graph, for the rules that a reader relies on."""

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "stereo_ore"

Imports = Mapping[str, frozenset[str]]


def module_name(file: Path, package: Path) -> str:
    parts = file.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imports(package: Path = PACKAGE) -> Imports:
    """What each module imports of its own package, wherever in the file it does so."""
    files = {module_name(file, package): file for file in sorted(package.rglob("*.py"))}
    found = {}
    for module, file in files.items():
        names = imported_names(ast.parse(file.read_text(encoding="utf-8")))
        mine = [name for name in names if name.split(".")[0] == package.name]
        owners = (name if name in files else name.rpartition(".")[0] for name in mine)
        found[module] = frozenset(owner for owner in owners if owner in files) - {module}
    return found


def circles(graph: Imports) -> list[list[str]]:
    """Modules that import each other, directly or by way of others (Tarjan's strong components)."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        order[module] = low[module] = len(order)
        stack.append(module)
        for other in sorted(graph[module]):
            if other not in order:
                visit(other)
            if other in stack:
                low[module] = min(low[module], low[other])
        if low[module] == order[module]:
            component = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(component) > 1:
                found.append(sorted(component))

    for module in graph:
        if module not in order:
            visit(module)
    return found


def wing(module: str) -> str:
    """First name below the package; "face" for the package itself and the modules that a user
    imports."""
    parts = module.split(".")
    return FACE if len(parts) == 1 or parts[1] in ("detector", "result", "__main__") else parts[1]


FACE = "face"
CORE = frozenset(
    (
        "chain",
        "installation",
        "losses",
        "types",
        "config",
        "errors",
        "transforms",
        "planes",
        "rays",
        "threads",
        "times",
        "engine",
        "memory",
        "network",
        "stages",
        "version",
    )
)
MAY_IMPORT: Mapping[str, frozenset[str]] = {
    **dict.fromkeys(CORE, CORE),
    "record": CORE,
    "io": CORE | {"record"},
    "draw": CORE | {"io"},
    "calibrate": CORE | {"io", "draw"},
    "report": CORE | {"io", "draw", "calibrate"},
    "export": CORE | {"io", "record"},
    "runs": CORE | {"io", "record", "draw", "report"},
    "plant": CORE | {"io", "runs"},
    "lab": CORE | {"io", "record", "runs", "draw"},
    FACE: CORE | {"io", "record", "runs", "draw", "cli"},
    "cli": CORE | {"io", "runs", "draw", "calibrate", "report", "export", "plant", "lab"},
}
"""What each wing may import beside itself."""
LAB_VERBS = frozenset(f"stereo_ore.cli.{verb}" for verb in ("bench", "synth", "tune", "evaluate"))


def breaches(graph: Imports) -> list[str]:
    """Imports that the rules forbid."""
    found = []
    for module, others in graph.items():
        mine = wing(module)
        for other in sorted(others):
            theirs = wing(other)
            if theirs not in MAY_IMPORT[mine] | {mine}:
                found.append(f"{module} imports {other}")
            elif (
                mine == "cli"
                and theirs == "lab"
                and not any(module.startswith(v) for v in LAB_VERBS)
            ):
                found.append(f"{module}, which is no verb of the laboratory, imports {other}")
    return found


OF_LIKE_MODULES = frozenset(("read", "write", "register", "recognises"))
"""Functions that each module of a table has: formats of files, verbs of the command."""


def public_names(tree: ast.Module) -> Iterator[str]:
    """Names that a module defines itself, and does not mark as its own by an underscore."""
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found = [node.name]
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
        else:
            continue
        yield from (name for name in found if not name.startswith("_"))


def defined_twice(package: Path = PACKAGE) -> dict[str, list[str]]:
    """Public names and the modules that define them, where there are several.

    Verbs of the command line don't count: nobody imports them.
    """
    found: dict[str, list[str]] = {}
    for file in sorted(package.rglob("*.py")):
        module = module_name(file, package)
        if wing(module) != "cli":
            for name in public_names(ast.parse(file.read_text(encoding="utf-8"))):
                found.setdefault(name, []).append(module)
    return {
        name: modules
        for name, modules in found.items()
        if len(modules) > 1 and name not in OF_LIKE_MODULES
    }
