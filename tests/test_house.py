"""Lower floors of the package know nothing of higher ones; lazy and typing-only imports count."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
BELOW = (
    "_assets",
    "_commands",
    "_extras",
    "_headless",
    "body",
    "config",
    "episode",
)  # modules that all may use
FLOORS = ("kernels", "encoders", "memory", "model", "robot", "sim", "data", "evaluation", "touch",
          "ros", "lerobot", "apps", "__init__")  # fmt: skip
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "hasm_torch").rglob("*.py"))
}


def imported(module: str) -> set[str]:
    """Modules that a module imports, wherever in its text."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in MODULES else str(node.module) for name in names}
    return found


IMPORTS = {module: imported(module) for module in MODULES}
INSIDE = {module: imports & MODULES.keys() for module, imports in IMPORTS.items()}


def floor(module: str) -> int:
    name = [*module.split("."), "__init__"][1]
    assert name in (*BELOW, *FLOORS), f"{module} has no place in the house"
    return 0 if name in BELOW else 1 + FLOORS.index(name)


def test_floors_import_lower_floors_only():
    upward = [(m, n) for m in MODULES for n in INSIDE[m] if floor(n) > floor(m)]
    assert not upward, "\n".join(f"{module} imports {higher}" for module, higher in upward)


def test_nothing_imports_in_a_circle():
    list(TopologicalSorter(INSIDE).static_order())

    def package(module: str) -> str:
        return module if MODULES[module].stem == "__init__" else module.rpartition(".")[0]

    pairs = {(package(m), package(n)) for m in MODULES for n in INSIDE[m]}
    both = {(a, b) for a, b in pairs if a < b and (b, a) in pairs and "hasm_torch" not in (a, b)}
    assert not both, "\n".join(f"{a} and {b} import each other" for a, b in sorted(both))


def test_lerobot_is_used_in_one_place():
    """Its classes in one folder; the writer of datasets takes its dataset class besides."""
    users = {m for m in MODULES for name in IMPORTS[m] if name.split(".")[0] == "lerobot"}
    others = {m for m in users if not m.startswith("hasm_torch.lerobot")}
    assert others <= {"hasm_torch.data.recording"}
