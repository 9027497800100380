"""The package without its wings: `uv run python tests/without_wings.py` runs quick tests of the core there.

`--all` runs the whole default tests of the core. Arguments after `--` go to pytest.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from probcal.wings import WINGS

ROOT = Path(__file__).parents[1]
QUICK = """
test_cli.py test_display.py test_exact.py test_imports.py test_nodes.py test_plausible.py test_psis.py test_rows.py
test_table.py test_vectors.py test_wings.py
"""  # files of the core: declarations, data, fits, results, the command line


def package_without(folder: Path, *wings: str) -> Path:
    """Copy the package without some wings into a folder: what to put on PYTHONPATH."""
    shutil.copytree(
        ROOT / "probcal", folder / "probcal", ignore=lambda path, _: wings if Path(path) == ROOT / "probcal" else ()
    )
    return folder


def main() -> int:
    """Run tests of the core without any wing."""
    files = ["tests"] if "--all" in sys.argv else [f"tests/{name}" for name in QUICK.split()]
    more = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    with tempfile.TemporaryDirectory() as folder:
        path = package_without(Path(folder), *WINGS)
        environment = os.environ | {"PYTHONPATH": str(path), "PYTHONSAFEPATH": "1"}  # not the package of this folder
        command = [sys.executable, "-m", "pytest", *files, *more]
        return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
