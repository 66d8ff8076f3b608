"""Imports point downward only, module by module, and in no circle."""

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import sb3_sap

PACKAGE = Path(sb3_sap.__file__).parent
# From the top. A package or module may import its own modules, its own layer's where they form no circle, and those
# below; the environments and their tasks are separate layers, which only the upper layers know.
LAYERS = (
    {"cli"},
    {"comparison"},
    {"zoo", "benchmark"},
    {"plots", "evaluation"},
    {"presets"},
    {"algorithms"},
    {"onpolicy"},
    {"guidance", "check"},
    {"predictor"},
    {"transitions"},
    {"permissibility"},
    {"common"},
)
ENVIRONMENT_LAYERS = ({"tasks"}, {"envs"})
MAY_KNOW_ENVIRONMENTS = {"cli", "comparison", "zoo", "benchmark", "evaluation", "plots"}
# The modules of lower layers that environments and tasks may import: those of NumPy and the standard library alone.
ENVIRONMENTS_MAY_IMPORT = {
    "sb3_sap.common.arrays",
    "sb3_sap.common.errors",
    "sb3_sap.common.files",
    "sb3_sap.common.random",
}


def modules():
    """Every module of the package but its own ``__init__``, by dotted name."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        parts = ("sb3_sap", *path.relative_to(PACKAGE).with_suffix("").parts)
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name != "sb3_sap":
            found[name] = path
    return found


MODULES = modules()


def imports(path):
    """The dotted names that a file imports, also inside functions, but not those for type checkers only."""
    found = []

    def visit(node):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            return
        if isinstance(node, ast.Import):
            found.extend(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            found.extend([node.module, *(f"{node.module}.{alias.name}" for alias in node.names)])
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return found


def used(name):
    """The modules of the package that a module imports: of ``from a.b import c`` a.b.c if it is a module, else a.b."""
    found = {other for other in imports(MODULES[name]) if other in MODULES} - {name}
    return {other for other in found if not any(longer.startswith(f"{other}.") for longer in found)}


def top(name):
    return name.split(".")[1]


def layer(name):
    return next((number for number, names in enumerate(LAYERS) if top(name) in names), None)


def test_every_module_is_in_exactly_one_layer():
    everything = [name for names in (*LAYERS, *ENVIRONMENT_LAYERS) for name in names]
    assert len(everything) == len(set(everything))
    assert {top(name) for name in MODULES} == set(everything)


@pytest.mark.parametrize("name", sorted(name for name in MODULES if layer(name) is not None))
def test_imports_point_downward_only(name):
    others = {other for other in used(name) if top(other) != top(name)}
    assert {other for other in others if layer(other) is not None and layer(other) < layer(name)} == set()
    assert "cli" not in {top(other) for other in others}
    if top(name) not in MAY_KNOW_ENVIRONMENTS:
        assert {other for other in others if layer(other) is None} == set()


@pytest.mark.parametrize("name", sorted(name for name in MODULES if layer(name) is None))
def test_environments_and_tasks_know_no_algorithm(name):
    others = {other for other in used(name) if top(other) != top(name)}
    assert others <= ENVIRONMENTS_MAY_IMPORT
    foreign = {other.split(".")[0] for other in imports(MODULES[name])}
    assert not foreign & {"stable_baselines3", "sb3_contrib", "torch"}


def test_no_module_imports_itself_through_others():
    try:
        list(TopologicalSorter({name: used(name) for name in MODULES}).static_order())
    except CycleError as error:
        pytest.fail(f"a circle: {' -> '.join(error.args[1])}")


def test_tasks_need_numpy_alone():
    foreign = {other.split(".")[0] for name in MODULES if top(name) == "tasks" for other in imports(MODULES[name])}
    assert foreign - sys.stdlib_module_names == {"numpy", "sb3_sap"}


def test_permissibility_needs_numpy_and_gymnasium_alone():
    below = {"sb3_sap.common.arrays", "sb3_sap.common.reward_shaping"}
    assert used("sb3_sap.permissibility") == below
    for name in ("sb3_sap.permissibility", *below):
        foreign = {other.split(".")[0] for other in imports(MODULES[name])} - sys.stdlib_module_names
        assert foreign <= {"gymnasium", "numpy", "sb3_sap"}


def test_imports_are_found_as_they_are_written():
    assert "sb3_sap.guidance.mixin.ActionPermissibilityMixin" in imports(MODULES["sb3_sap.algorithms"])
    assert used("sb3_sap.algorithms") == {
        "sb3_sap.common.errors",
        "sb3_sap.guidance.constrained",
        "sb3_sap.guidance.constraints",
        "sb3_sap.guidance.mixin",
        "sb3_sap.onpolicy.algorithms",
        "sb3_sap.predictor.mixin",
    }
    assert "sb3_sap.envs.viewer" in used("sb3_sap.envs.lane_keeping")  # although only when something is drawn


def test_importing_the_package_loads_no_simulator_and_no_plotting():
    code = """if True:
        import sys
        import stable_baselines3
        before = set(sys.modules)
        import sb3_sap
        print(*sorted(set(sys.modules) - before))
    """
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    new = output.split()
    plotting = ("pygame", "highway_env", "matplotlib", "pandas", "scipy", "PIL", "moviepy")
    heavy = (*plotting, "rl_zoo3", "optuna", "rich", "minari", "pyarrow")
    assert "sb3_sap.algorithms" in new
    assert [name for name in new if name.split(".")[0] in heavy] == []
    # Of the package itself, it loads what training needs, and neither commands nor the benchmark.
    assert {"cli", "zoo", "benchmark", "evaluation", "plots"} & {
        top(n) for n in new if n.startswith("sb3_sap.")
    } == set()
