"""The floors of the design: a module imports from its own floor or a lower one; only `linalg` factorises."""

import ast
import sys
from functools import cache
from pathlib import Path

import pytest
from mutations import MUTATIONS, places

import probcal
from probcal.inference.methods import METHODS as BY_NAME
from probcal.wings import WINGS

ROOT = Path(probcal.__file__).parent
FLOORS = {
    0: (
        "linalg", "devices", "geometry", "types", "errors", "labels", "lazy", "kernels", "fingerprint", "files",
        "resampling", "status", "wings",
    ),
    1: ("sensor", "motion", "priors", "noise", "detection", "clocks"),
    2: ("sensors",),
    3: ("geodesy", "misfit", "network", "table", "nodes", "plausible"),
    4: ("model", "problem", "scans", "simulate"),
    5: ("gaussian", "modes"),
    6: ("identifiability", "results"),
    7: ("inference",),
    8: ("analysis",),
    9: ("cli", "report", "plots", "diagnostics"),
    10: WINGS,
}  # fmt: skip
FLOOR = {name: floor for floor, names in FLOORS.items() for name in names}
METHODS = (  # algorithms
    "inference.ea", "inference.em", "inference.collapsed", "inference.nuts", "tracking.selfconfig",
    "inference.joint_gibbs", "inference.svi", "particles.gibbs",
)  # fmt: skip
CHOOSES = "inference.mcmc"  # among them
SHARED = tuple(
    f"inference.{name}"
    for name in (
        "run", "ending", "sampler", "sampling", "chains", "posterior", "hierarchy", "posed", "pose", "gibbs",
        "coordinates", "guides", "psis", "leaps", "sides", "mixed",
    )
)  # fmt: skip  # what they share: it knows none of them
LATER = {"pandas", "xarray"}  # loaded where a name of them is first used
OUTSIDE = {"models", "tests", "benchmarks"}
LOW = {"jax", "numpy", "filelock", "platformdirs"}  # third parties of floor 0, besides the standard library
FACTORISE = {
    "cho_factor", "cho_solve", "cholesky", "eigh", "eig", "eigvalsh", "inv", "lu", "lu_factor", "lu_solve",
    "lstsq", "matrix_rank", "pinv", "qr", "slogdet", "svd", "solve_triangular", "triangular_solve",
}  # fmt: skip
SPARED = {"norm", "LinAlgError"}  # of a module linalg, but no factorisation
FILES = sorted(path for path in ROOT.rglob("*.py") if "__pycache__" not in path.parts)


def dotted(path):
    """Module name inside the package: `gaussian.mode`, `inference`, or empty for the package itself."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {dotted(path): path for path in FILES}


@cache
def parsed(path):
    return ast.parse(path.read_text())


def imports(tree, module, package):
    """Absolute names of everything imported anywhere in a module, with `name` of `from ... import name`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                here = ["probcal", *(module.split(".") if module else [])]
                here = here if package else here[:-1]
                base = ".".join([*here[: len(here) - node.level + 1], *([base] if base else [])])
            yield from ((f"{base}.{alias.name}", node.lineno) for alias in node.names)


def own(module, path):
    """Modules of probcal that a module imports, with the line."""
    for name, line in imports(parsed(path), module, path.name == "__init__.py"):
        if name.split(".")[0] != "probcal":
            continue
        parts = name.split(".")[1:]
        while len(parts) > 1 and ".".join(parts) not in MODULES:
            parts = parts[:-1]
        known = parts and (".".join(parts) in MODULES or parts[0] in FLOOR)  # else a name of probcal/__init__
        yield ".".join(parts) if known else "", line


def floor(module):
    return FLOOR.get(module.split(".")[0])


def test_the_walk_finds_the_package():
    assert {"linalg", "model.rows", "gaussian.mode", "inference.fit", "inference"} <= set(MODULES)
    found = {name for name, _ in own("gaussian.mode", MODULES["gaussian.mode"])}
    assert {"linalg", "model.model", "gaussian.recursion"} <= found


def test_imports_inside_functions_and_relative_ones_are_seen():
    text = "def f():\n    from ..problem import Epochs\n    import probcal.cli\n    from . import mode\n"
    found = [name for name, _ in imports(ast.parse(text), "gaussian.start", False)]
    assert found == ["probcal.problem.Epochs", "probcal.cli", "probcal.gaussian.mode"]


def test_every_module_has_a_floor():
    without = [module for module in MODULES if module and floor(module) is None]
    assert not without, f"{without} are on no floor: add them to FLOORS in tests/test_floors.py (design, section 4)"


def test_imports_keep_the_floors():
    high = [
        f"{module} (floor {floor(module)}), line {line}: imports {name or 'probcal'} (floor {floor(name)})"
        for module in filter(None, MODULES)
        for name, line in own(module, MODULES[module])
        if not name or (floor(name) is not None and floor(name) > floor(module) and not wing(name))  # wings: below
    ]
    assert not high, "\n".join(high)


def wing(module):
    return module.split(".")[0] if module.split(".")[0] in WINGS else ""


def wings_of(module):
    """Wings of which a module imports or names something, with the line."""
    found = {(wing(module), wing(name), line) for name, line in own(module, MODULES[module]) if wing(name)}
    if module in ("", "plots"):
        block = next(node for node in parsed(MODULES[module]).body if isinstance(node, ast.If))
        assert ast.unparse(block.test) == "TYPE_CHECKING"
        found = {one for one in found if not block.lineno <= one[2] <= block.end_lineno}
    if module != "wings":
        texts = [(node.value, node.lineno) for node in ast.walk(parsed(MODULES[module]))
                 if isinstance(node, ast.Constant) and str(node.value).removeprefix("probcal.") in MODULES]  # fmt: skip
        found |= {(wing(module), wing(name[8:]), line) for name, line in texts if wing(name[8:])}
    return [f"{module or 'probcal'}, line {line}: {other}" for here, other, line in found if here != other]


def test_no_wing_is_imported_by_the_core_nor_by_another():
    """Imports in functions and for type checkers count, and modules that are named in a text.

    The public names of two packages state those of wings for type checkers.
    """
    others = [text for module in MODULES for text in wings_of(module)]
    assert not others, f"a wing is imported: reach it by name (probcal/wings.py)\n{'\n'.join(others)}"


def test_algorithms_do_not_import_each_other_nor_does_what_they_share():
    others = [
        (module, name)
        for module in METHODS + SHARED
        if module in MODULES
        for name, _ in own(module, MODULES[module])
        if name in METHODS and name != module
    ]
    assert not others, f"{others}: move what they share to a module of its own"


def test_every_method_is_listed():
    """A new algorithm joins the rule above."""
    listed = {name for name in METHODS if name in MODULES}
    homes = {type(method).__module__.removeprefix("probcal.") for method, _ in BY_NAME.values()}
    assert homes == listed | {CHOOSES}


def roots(path, module=""):
    """First names of what a file imports."""
    return {name.split(".")[0] for name, _ in imports(parsed(path), module, False)}


def test_the_ground_floor_needs_jax_and_numpy_only():
    third = {
        module: roots(MODULES[module], module) - sys.stdlib_module_names - LOW - {"probcal"} for module in FLOORS[0]
    }
    assert third.pop("lazy") == LATER
    assert not any(third.values()), third


def test_models_are_never_imported():
    assert not [module for module in filter(None, MODULES) if roots(MODULES[module], module) & OUTSIDE]


def test_no_test_module_is_imported():
    """What tests share stands in modules of its own: worlds, contracts, reference and the like."""
    found = {path.stem: roots(path) for path in Path(__file__).parent.glob("*.py")}
    assert not {name for name, used in found.items() if any(root.startswith("test_") for root in used)}


def test_the_catalogue_uses_the_public_declaration_only():
    assert {name for name, _ in own("sensors", MODULES["sensors"])} <= {"sensor", "geometry", "noise"}


def chain(node):
    """`a.b.c` of nested attributes, or an empty text."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        before = chain(node.value)
        return f"{before}.{node.attr}" if before else ""
    return ""


def factorisations(text):
    """Uses of a factorisation: `np.linalg.*`, `jnp.linalg.*`, `jax.scipy.linalg.*`, `lax.linalg.*`, by any alias."""
    tree = ast.parse(text)
    aliases = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                root = alias.name.split(".")[0]
                aliases[alias.asname or root] = alias.name if alias.asname else root
        elif isinstance(node, ast.ImportFrom) and not node.level:
            aliases |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jax"):
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                if "linalg" in name:
                    found.add((name, node.lineno))
        elif isinstance(node, ast.Attribute):
            head, _, rest = chain(node).partition(".")
            name = f"{aliases.get(head, head)}.{rest}"
            last = name.split(".")[-1]
            if name.startswith(("jax", "numpy")) and last not in SPARED and (".linalg." in name or last in FACTORISE):
                found.add((name, node.lineno))
    return sorted(found, key=lambda pair: pair[1])


@pytest.mark.parametrize(
    "text",
    [
        "import jax.numpy as jnp\nx = jnp.linalg.solve(a, b)",
        "import numpy as np\nnp.linalg.eigh(a)",
        "import jax\nx = jax.scipy.linalg.cho_solve(a, b)",
        "from jax.scipy.linalg import solve_triangular",
        "from jax.numpy import linalg as la\nx = la.qr(a)",
        "def f():\n    from jax import numpy as n\n    return n.linalg.qr(a)",
        "from jax.lax import linalg",
    ],
)
def test_the_search_for_factorisations_sees(text):
    assert factorisations(text)


@pytest.mark.parametrize(
    "text", ["import numpy as np\nnp.linalg.norm(a)", "from probcal import linalg\nlinalg.spectrum(a)"]
)
def test_the_search_for_factorisations_spares(text):
    assert not factorisations(text)


def test_only_linalg_factorises():
    """By NumPy `gaussian/` does too, and what a report loads, which does without jax."""
    found = [
        f"{module}, line {line}: {name}"
        for module in MODULES
        if module != "linalg"
        for name, line in factorisations(MODULES[module].read_text())
        if not (name.startswith("numpy") and module.startswith(("gaussian.", "results.")))
    ]
    assert not found, f"factorisations belong into linalg.py\n{'\n'.join(found)}"


@pytest.mark.needs(*WINGS)
def test_every_mutation_still_has_its_line():
    """The table of `mutations.py` follows the code: each old text stands in the package once."""
    lost = [m.old for m in MUTATIONS if len(places(m)) != 1]
    assert not lost


BY_MODULE = {  # names that a reader meets behind their module: `rows.predict`, `cli.fit.run`
    "log_likelihood", "predict", "run", "slopes",
}  # fmt: skip


def test_a_public_name_is_defined_once():
    """One word, one meaning: a second class or function of a name needs another name, or a line in `BY_MODULE`."""
    found = dict[str, list[str]]()
    for path in sorted(ROOT.rglob("*.py")):
        for node in parsed(path).body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(path.stem)
    assert {name for name, files in found.items() if len(files) > 1} == BY_MODULE
    assert not BY_MODULE & set(probcal.__all__)
