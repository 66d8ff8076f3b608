"""Doors open downward only."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_sap

PACKAGE = Path(sb3_sap.__file__).parent
# From the top. A room may use those below it and its neighbours on the same floor.
FLOORS = (
    {"cli"},
    {"demo", "hub", "card"},
    {"zoo", "benchmark", "evaluation", "normalisation", "plots", "beliefs", "presets", "statistics"},
    {"algorithms"},
    {"exploration", "check", "trials", "quick_classifier"},
    {"learning"},
    {
        "constraints",
        "callbacks",
        "buffers",
        "knowledge",
        "predictor",
        "settings",
        "actor_loss",
        "candidates",
        "prediction",
        "watching",
    },
    {"action_spaces", "vec_envs"},
    {"permissibility", "generators", "files", "errors", "advice", "tensorboard"},
)
ENVS_MAY_USE = {"envs", "permissibility", "generators", "files"}


def rooms():
    """The modules and packages of the house, with their files."""
    found = {path.stem: [path] for path in PACKAGE.glob("*.py") if path.stem != "__init__"}
    return found | {path.parent.name: sorted(path.parent.rglob("*.py")) for path in PACKAGE.glob("*/__init__.py")}


def imports(path):
    """The dotted names that a file imports when it runs, those for type checkers left out."""
    found = []

    def visit(node):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            return
        if isinstance(node, ast.Import):
            found.extend(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = path.relative_to(PACKAGE.parent).with_suffix("").parts[: -node.level] if node.level else ()
            base = ".".join([*start, *(node.module.split(".") if node.module else [])])
            found.extend([base, *(f"{base}.{alias.name}" for alias in node.names)])
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return found


def rooms_used(paths):
    used = {name.split(".")[1] for path in paths for name in imports(path) if name.startswith("sb3_sap.")}
    return used & rooms().keys()


def floor(room):
    return next((number for number, names in enumerate(FLOORS) if room in names), None)


@pytest.mark.parametrize("room", sorted(rooms()))
def test_doors_open_downward_only(room):
    used = rooms_used(rooms()[room]) - {room}
    upward = {other for other in used if None not in (floor(room), floor(other)) and floor(other) < floor(room)}
    assert not upward
    if room != "__main__":
        assert "cli" not in used
    # Below the algorithms nothing knows an environment.
    if floor(room) is not None and floor(room) >= floor("algorithms"):
        assert "envs" not in used


def test_every_room_of_the_method_has_a_floor():
    assert {room for names in FLOORS[3:] for room in names} <= rooms().keys()


def test_environments_know_no_algorithm():
    paths = rooms().get("envs", [])
    assert rooms_used(paths) <= ENVS_MAY_USE
    assert not [name for path in paths for name in imports(path) if name.startswith(("stable_baselines3", "torch"))]


def test_ap_functions_of_tasks_know_what_an_environment_may():
    assert rooms_used(rooms()["tasks"]) - {"tasks"} == {"permissibility"}
    foreign = {name.split(".")[0] for path in rooms()["tasks"] for name in imports(path)} - sys.stdlib_module_names
    assert foreign == {"numpy", "sb3_sap"}


def test_the_ap_function_knows_numpy_and_gymnasium_alone():
    foreign = {name.split(".")[0] for name in imports(PACKAGE / "permissibility.py")} - sys.stdlib_module_names
    assert foreign == {"gymnasium", "numpy"}


def test_the_reader_of_imports_sees_them():
    assert "sb3_sap.exploration.ActionPermissibilityMixin" in imports(PACKAGE / "algorithms.py")
    assert rooms_used([PACKAGE / "algorithms.py"]) == {"constraints", "exploration"}
    assert "exploration" not in rooms_used([PACKAGE / "callbacks.py"])  # for type checkers alone


def test_importing_the_package_brings_no_simulator_and_no_plotting():
    code = """if True:
        import sys
        import stable_baselines3
        before = set(sys.modules)
        import sb3_sap
        print(*sorted(set(sys.modules) - before))
    """
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    new = output.split()
    heavy = ("pygame", "highway_env", "matplotlib", "pandas", "scipy", "PIL", "rl_zoo3", "optuna", "rich", "moviepy")
    assert "sb3_sap.algorithms" in new
    assert [name for name in new if name.split(".")[0] in heavy] == []
