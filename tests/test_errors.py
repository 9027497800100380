"""Every sentence that the package can raise is matched by a test: a walk of the source, and the cases without a home.

A text counts as matched where a string in `tests/` holds a stretch of it (12 characters, or all there is) that no
other error shares. Values that are filled in (`{name}`) are no part of the text.
"""

import ast
from pathlib import Path

import pytest

import probcal

ROOT = Path(probcal.__file__).parent
TESTS = Path(__file__).parent
LENGTH = 12


def constants(node):
    """Constant stretches of a message: of a string, an f-string, a conditional of both."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [node.value]
    if isinstance(node, ast.JoinedStr):
        return [part.value for part in node.values if isinstance(part, ast.Constant)]
    if isinstance(node, ast.IfExp):
        return constants(node.body) + constants(node.orelse)
    if isinstance(node, ast.BinOp):
        return constants(node.left) + constants(node.right)
    return []


def raised(text, name):
    """Messages of one module as (place, stretches); those that carry the text of another error have none."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            if node.exc.func.id in ("InputError", "FitError"):
                stretches = [s.strip(" \"':;,.()") for s in constants(node.exc.args[0])]
                stretches = [s for s in stretches if len(s) > 2]
                yield f"{name}:{node.lineno}", stretches


def strings(text):
    """Strings of a test file, doc strings apart, as a regular expression or a text would read."""
    tree = ast.parse(text)
    docs = {id(n.body[0].value) for n in ast.walk(tree) if isinstance(n, (ast.Module, ast.FunctionDef, ast.ClassDef))
            and n.body and isinstance(n.body[0], ast.Expr)}  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            yield node.value.replace("\\", "").replace("[+]", "+")


def windows(stretches):
    """Every stretch of LENGTH characters, shorter constants whole."""
    return {s[k : k + LENGTH] for s in stretches for k in range(max(1, len(s) - LENGTH + 1))}


def unmatched(messages, said):
    """Messages of which no string in `said` holds a stretch of their own: (place, the longest such stretch)."""
    of = {place: windows(stretches) for place, stretches in messages}
    count = {}
    for found in of.values():
        for window in found:
            count[window] = count.get(window, 0) + 1
    for place, stretches in messages:
        own = {window for window in of[place] if count[window] == 1} or of[place]
        if stretches and not any(window in said for window in own):
            yield place, max(stretches, key=len)


MESSAGES = [
    message
    for path in sorted(ROOT.rglob("*.py"))
    for message in raised(path.read_text(), path.relative_to(ROOT).as_posix())
]
SAID = "\n".join(text for path in sorted(TESTS.glob("test_*.py")) for text in strings(path.read_text()))


def test_every_error_text_is_matched_by_a_test():
    open_ones = [f'{place}: "{text}"' for place, text in unmatched(MESSAGES, SAID)]
    assert not open_ones, "no test matches these texts, write pytest.raises(..., match=...) or add a case below:\n" + (
        "\n".join(open_ones)
    )
