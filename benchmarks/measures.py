"""Measures of the package's code: sizes, long lines, names defined twice, forks by type, docstrings with examples.

uv run python benchmarks/measures.py [ROOT]
"""

import ast
import statistics
import sys
from collections import Counter
from pathlib import Path


def main():
    """Print one line a measure."""
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1]
    texts = {path: path.read_text() for path in sorted((root / "probcal").rglob("*.py"))}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    files = [len(text.splitlines()) for text in texts.values()]
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    functions = [node.end_lineno - node.lineno + 1 for node in nodes if isinstance(node, ast.FunctionDef)]
    top = [node for tree in trees.values() for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    twice = [name for name, count in Counter(node.name for node in top).items() if count > 1]
    called = [node.func.id for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    any_ = sum(isinstance(node, ast.Name) and node.id == "Any" for node in nodes)
    long = sum(len(line) > 100 for text in texts.values() for line in text.splitlines())
    shown = sum(">>>" in (ast.get_docstring(node) or "") for node in top if node.name[0] != "_")
    print(f"files {len(files)}, lines {sum(files)}, median {statistics.median(files)}, longest {max(files)}")
    print(f"files over 350 lines {sum(size > 350 for size in files)}; lines over 100 characters {long}")
    print(f"functions: median {statistics.median(functions)}, longest {max(functions)}, ", end="")
    print(f"over 40 lines {sum(size > 40 for size in functions)}; Any a function {any_ / len(functions):.2f}")
    print(f"defined twice {len(twice)}, public {sum(name[0] != '_' for name in twice)}; ", end="")
    print(f"isinstance {called.count('isinstance')}; docstrings with an example {shown}")


if __name__ == "__main__":
    main()
