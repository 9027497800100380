"""Every piece of code and every option that a message of the package advises can be typed.

Calls are taken from all string literals but docstrings, looked up, and bound to the signature of what they call. In
an f-string a filled-in value is a name of its own; `...` stands for arguments left out. A call before a colon repeats
what was given ("Mixture(share=2): ..."), so that only its keywords are checked.
"""

import ast
import importlib
import inspect
import re
from functools import cache
from pathlib import Path

import pytest
from typer.main import get_command

import probcal
from probcal import InputError, StudentT
from probcal.cli.commands import app
from probcal.noise import Bernoulli, check_driving
from probcal.results.accessor import Accessor

ROOT = Path(probcal.__file__).parent
FILLED = "FILLED_IN"  # stands for a value of an f-string
OTHERS = {"np": "numpy", "jnp": "jax.numpy", "pd": "pandas"}  # packages
# written by the user, or a method of what the sentence names
HOOKS = ["problem", "scenario", "setting", "truth", "initial", "log_initial", "log_density", "draw", "on"]
HOOKS += ["update", "under", "float", "int"]
VALUES = {"problem": "Problem", "online": "Online", "motion": "Motion", "sensor_type": "SensorType"}  # their class
NOISY = ["ConstantVelocity", "ConstantAcceleration", "CoordinatedTurn", "RandomWalk", "White", "Known"]
CALLED = {  # values that a filled-in name may have
    "type(component).__name__": NOISY, "method.name": ["EA", "MAP"], "name": HOOKS,
    "type(self).__name__": ["Gaussian", "ARD"],
    "type(prior).__name__": ["Horseshoe", "BernoulliGaussian"], "method": ["EA", "MAP"],
}  # fmt: skip


@cache
def written(file):
    """All strings of a file."""
    return list(strings(ast.parse(file.read_text())))


def strings(node, inside=None):
    """Line, text, filled-in expressions and enclosing function of every string, docstrings left out."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.JoinedStr):
            parts = [p.value if isinstance(p, ast.Constant) else None for p in child.values]
            filled = [ast.unparse(p.value) for p in child.values if not isinstance(p, ast.Constant)]
            yield child.lineno, "".join(FILLED if p is None else p for p in parts), filled, inside
        elif isinstance(child, ast.Constant) and isinstance(child.value, str):
            yield child.lineno, child.value, [], inside
        elif not (isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)):
            yield from strings(child, getattr(child, "name", None) or inside)


def fragments(text):
    """Place and text of every call that stands in none other, to its closing parenthesis."""
    end = 0
    for found in re.finditer(r"[A-Za-z_.][\w.]*\(", text):
        if found.start() < end:
            continue
        depth, end = 1, found.end()
        while end < len(text) and depth:
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
        if depth == 0 and text[found.end() : end - 1] not in ("s", "es"):  # bias(es)
            yield found.start(), text[found.start() : end], text[end : end + 1] == ":"


def looked_up(path, module):
    """What a dotted name means to the reader of a message: a name of the package, of the module, or a method."""
    first, *rest = path.removeprefix("tree.").split(".")
    if first == "probcal":
        first, *rest = rest
        homes = [Accessor if path.startswith("tree.") else probcal]
    elif rest and first not in (*VALUES, *dir(probcal)):
        first, *rest, homes = *rest, [importlib.import_module(OTHERS.get(first, first))]
    else:
        homes = [probcal, probcal.noise]
    first = VALUES.get(first, first) if rest else first
    homes += [] if any(hasattr(home, first) for home in homes) else [importlib.import_module(module)]
    value = next((getattr(home, first) for home in homes if hasattr(home, first)), None)
    for name in rest:
        value = getattr(value, name, None)
    return value


def bound(call, value, echo):
    """Bind the arguments of a call to a signature; raises TypeError."""
    if not call.args and not call.keywords and not inspect.isclass(value):
        return  # a function that is named only
    names = [k.arg for k in call.keywords if FILLED not in (k.arg or FILLED)]
    left_out = [a for a in call.args if isinstance(a, ast.Constant) and a.value is ...]
    given = [a for a in call.args if a not in left_out]
    signature, partial = inspect.signature(value), echo or left_out or len(names) < len(call.keywords)
    itself = [None] if next(iter(signature.parameters), "") == "self" else []
    (signature.bind_partial if partial else signature.bind)(*itself, *given, **dict.fromkeys(names))


def wrong(file):
    """What cannot be typed of the calls in one file, and how many can."""
    module, good, bad = ".".join(("probcal", *file.relative_to(ROOT).with_suffix("").parts)), 0, []
    for line, text, filled, inside in written(file):
        for start, source, echo in fragments(text):
            place = f"{file.relative_to(ROOT)}:{line}: {source}"
            try:
                tree = ast.parse(source.lstrip("."), mode="eval")
            except SyntaxError:
                if source[0].isupper() and FILLED + "(" not in source and inside != "__repr__":
                    bad.append(f"{place} is no Python")
                continue
            before = text[:start].count(FILLED)
            for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
                path = ast.unparse(call.func)
                if FILLED in path and (echo or call is not tree.body):
                    continue
                for name in CALLED[filled[before]] if path == FILLED else [path]:
                    if name in HOOKS:
                        continue
                    value = looked_up(name, module)
                    try:
                        assert callable(value), "is not there"
                        bound(call, value, echo)
                        good += 1
                    except (AssertionError, TypeError) as error:
                        bad.append(f"{place}, {name}: {error}")
    return bad, good


def test_code_that_a_message_advises_can_be_typed():
    found = [wrong(file) for file in sorted(ROOT.rglob("*.py"))]
    assert [text for bad, _ in found for text in bad] == []
    assert sum(good for _, good in found) > 150


def test_options_that_a_message_advises_exist():
    command = get_command(app)
    commands = [command, *command.commands.values()]
    options = {name for one in commands for p in one.params for name in (*p.opts, *p.secondary_opts)}
    for file in ROOT.rglob("*.py"):
        for line, text, *_ in written(file):
            for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", text):
                assert option in options, f"{file.relative_to(ROOT)}:{line}: {option}"


def test_noise_that_is_advised_for_a_motion_drives_it():
    with pytest.raises(InputError, match="cannot drive a motion") as refused:
        check_driving(Bernoulli(), "noise")
    advised = [source for _, source, _ in fragments(str(refused.value).partition("give")[2])]
    assert len(advised) > 2
    for source in advised:
        check_driving(
            eval(source, vars(probcal.noise) | {"noise": probcal.noise, "df": 4, "share": 0.1, "scale": 9}), ""
        )


def test_what_follows_a_component_is_another_one():
    """A noise with a memory asks for another declaration than the one that has it, emissions for no motion."""
    components = [getattr(probcal, name) for name in NOISY]
    for component in components:
        assert component.__name__ not in component.next_order
    assert "ConstantAcceleration" in probcal.ConstantVelocity.next_order
    assert "Constant" not in probcal.White.next_order + probcal.RandomWalk.next_order
    assert StudentT(4) == components[-1](([0.0, 1.0], [(0, 0), (1, 1)]), 0.1, noise=StudentT(4)).noise
