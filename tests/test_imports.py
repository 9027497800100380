"""What is loaded and when: modules are counted in fresh interpreters, never seconds."""

import ast
import importlib
import importlib.metadata
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from terminal import INSTALLED

import probcal
from probcal import analysis, inference, plots
from probcal.cli.names import METHODS, PRIORS, SAVE
from probcal.inference.finish import SAVE as SAVE_OF_FITS
from probcal.inference.sampler import Sampler
from probcal.wings import installed

ROOT = Path(__file__).parents[1]
# jax and numpyro by a part of each: ArviZ puts empty ones into sys.modules
HEAVY = ("jax.numpy", "numpy", "pandas", "xarray", "scipy.special", "scipy.stats", "arviz", "arviz_stats",
         "numpyro.infer", "matplotlib", "pyproj", "zarr", "distributed")  # fmt: skip
DATA = ROOT / "tests" / "data"
MODEL, ROWS = DATA / "small.py", DATA / "small.csv"
PLAZA = str(ROOT / "models" / "plaza.py")
ERRORS = [  # of options and arguments, with the end of what is said
    ("fit none.py", "none.py: no such model file"),
    ("fit pyproject.toml", "pyproject.toml is not a Python file; a model file defines problem(data=None)"),
    ("fit {plaza} none.csv", "none.csv: no such file"),
    ("fit {plaza} --method eaa", '--method "eaa" is not known; did you mean "ea"?'),
    ("fit {plaza} --prior gausian", '--prior "gausian" is not known; did you mean "gaussian"?'),
    ("fit {plaza} --prior *.x=gausian", '--prior "gausian" is not known; did you mean "gaussian"?'),
    ("fit {plaza} --prior *.x=flat", "EA does not take the prior Flat; it takes: laplace, ard"),
    (
        "fit {plaza} --prior ard --prior laplace",
        '--prior: give one NAME for all biases, and "PATTERN=NAME" for those of a',
    ),
    (
        "fit {plaza} --prior gaussian",
        "EA does not take the prior Gaussian; it takes: laplace, ard, ard-node, ard-owner",
    ),
    ("fit {plaza} --chains 2", '--chains: "ea" draws no chains; take mcmc, collapsed, nuts, gibbs or svi'),
    ("fit {plaza} --method nuts --resume", "--resume needs --out, the folder of the run to go on with"),
    ("fit {plaza} --overwrite", "--overwrite needs --out, the folder whose run it replaces"),
    ("fit {plaza} README.md CHANGELOG.md", "several recordings need --out, the folder for a fit of each and the table"),
    ("fit {plaza} README.md none.csv --out none", "none.csv: no such file"),
    (
        "fit {plaza} README.md benchmarks/README.md --out none",
        "README.md and benchmarks/README.md would both be fitted into none/README; give them different names",
    ),
    ("fit {plaza} README.md --scheduler local", "--scheduler spreads the fits of several recordings; give more"),
    ("study {plaza} --resume", "study: --resume needs --out DIR, the folder of the fits to go on with"),
    ("study {plaza} --set share=0:1:1e-9", "these are 1000000000 values; give 10000 of them at most"),
    ("fit {plaza} --out pyproject.toml/fit", "pyproject.toml/fit cannot be written: Not a directory"),
    ("fit {plaza} --save state", '--save "state" is not known; give states, predictive or both, separated by a comma'),
    ("sbc {plaza} --resume", "sbc: --resume needs --out DIR, the folder of the runs to go on with"),
    ("sbc {plaza} --method mop", 'sbc: no method is called "mop"; did you mean "map"?'),
    ("study {plaza} --set share", '--set "share": write name=value,value,... or name=first:last:step'),
    ("study {plaza} --set share=1,1", "study: a value of share is given twice; give every value once"),
    ("study {plaza} --methods ea,mop", 'method "mop" is not known; did you mean "map"?'),
    ("track {plaza}", "track needs --calibration DIR, the folder of a fit"),
    ("track {plaza} --calibration tests", "tests/fit.nc is not a fit written by probcal: there is no such file"),
    ("compare a b", "a is not a fit written by probcal: there is no such file"),
    ("compare pyproject.toml", "compare: 1 fit(s) given; give at least two"),
    ("compare pyproject.toml README.md --name a", "compare: 1 names for 2 fits; give each fit a name of its own"),
    ("compare pyproject.toml README.md --pair a", 'the pair "a" must be two labels of biases, LABEL,LABEL'),
    ("report none", "none is not a fit written by probcal: there is no such file"),
    ("check none.py", "none.py: no such model file"),
    ("simulate none.py", "none.py: no such model file"),
]


def fresh(code):
    """What a fresh interpreter prints, line by line; warnings and errors fail."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


LOADED = f"""
import sys
def loaded():
    names = [name for name in {HEAVY} if name in sys.modules]
    return " ".join(names) or "nothing"
"""


# without dask, an extra: where it is there xarray loads it, and it much of scipy
COMMANDS = LOADED + "sys.modules['dask'] = None\nimport contextlib, io\nfrom probcal.cli import main\n"


def test_importing_the_package_loads_nothing_heavy():
    code = LOADED + (
        "import probcal\nprint(loaded())\nprobcal.InputError, probcal.analysis, probcal.inference, dir(probcal.plots)\n"
        "print(loaded())\nimport jax\nprint(loaded())"
    )
    assert fresh(code) == ["nothing", "nothing", "jax.numpy numpy"]


def test_the_version_is_that_of_the_installed_package():
    version = importlib.metadata.version("probcal")
    code = COMMANDS + "import probcal\nprint(probcal.__version__)\nsys.argv = ['probcal', '--version']\n"
    assert fresh(code + "try:\n    main()\nfinally:\n    print(loaded())\n") == [
        version, f"probcal {version}", "nothing",
    ]  # fmt: skip


def test_help_and_errors_of_options_load_nothing_heavy():
    errors = [(order.format(plaza=PLAZA), text) for order, text in ERRORS if order.split()[0] in INSTALLED]
    code = COMMANDS + (
        f"for order in {['--help', 'fit --help', 'check --help', *(order for order, _ in errors)]!r}:\n"
        "    sys.argv, said = ['probcal', *order.split()], io.StringIO()\n"
        "    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):\n"
        "        try:\n            main()\n        except SystemExit as end:\n            code = end.code\n"
        "    print(loaded(), code, *said.getvalue().splitlines()[-1:])\n"
    )
    lines = fresh(code)
    assert [line[:9] for line in lines[:3]] == ["nothing 0"] * 3
    for line, (order, text) in zip(lines[3:], errors, strict=True):
        assert line.startswith("nothing 2 probcal: "), order
        assert text in line, order


def order(*arguments):
    """Code that runs a command, its output dropped, and prints its exit code and what is loaded."""
    return (
        f"sys.argv = ['probcal', *{[str(argument) for argument in arguments]!r}]\n"
        "with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):\n"
        "    try:\n        main()\n    except SystemExit as end:\n        code = end.code\n"
        "print(code, loaded())\n"
    )


def test_declaring_a_problem_loads_jax_alone():
    code = "from probcal import EA, NUTS, Bias, Network, Node, Problem, Truth, fit, load, read_nodes, sensor\n"
    assert fresh(LOADED + code + "print(loaded())") == ["jax.numpy numpy"]


@pytest.mark.ci
def test_a_fit_without_assessment_loads_neither_arviz_nor_plots():
    """SciPy has the limits of its innovations, and the filter that widens where they reject the model, as here."""
    run = order("fit", MODEL, ROWS, "--method", "map", "--no-assess")
    assert fresh(COMMANDS + run) == ["0 jax.numpy numpy pandas xarray scipy.special scipy.stats"]


def test_a_report_loads_no_jax(tmp_path):
    shutil.copy(DATA / "ea.nc", tmp_path / "fit.nc")
    assert fresh(COMMANDS + order("report", tmp_path)) == ["0 numpy pandas xarray matplotlib"]


def test_names_on_the_command_line_are_those_of_the_library():
    assert list(PRIORS) == list(probcal.priors.PRIORS)
    assert {name: type(prior).__name__ for name, prior in probcal.priors.PRIORS.items()} == PRIORS
    assert list(METHODS) == list(inference.METHODS)
    for name, (method, prior) in inference.METHODS.items():
        taken = tuple(key for key, value in probcal.priors.PRIORS.items() if method.takes(value))
        assert METHODS[name] == (method.name, isinstance(method, Sampler), taken)
        assert prior is None or method.takes(prior)
    assert SAVE == SAVE_OF_FITS


@pytest.mark.parametrize("package", [probcal, analysis, inference, plots], ids=lambda package: package.__name__)
def test_a_lazy_package_has_all_its_names(package):
    modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
    for name in package.__all__:
        value = getattr(package, name)
        assert isinstance(value, ModuleType) == (
            package is probcal and name in ("motion", "noise", "priors", "sensors")
        ), name
        if name in modules:  # a function and the module it stands in: the name stays the function's
            importlib.import_module(f"{package.__name__}.{name}")
            assert getattr(package, name) is value
    assert set(package.__all__) <= set(dir(package))
    with pytest.raises(AttributeError, match="has no attribute 'nothing_of_the_kind'"):
        package.nothing_of_the_kind  # noqa: B018


@pytest.mark.parametrize("package", [probcal, analysis, inference, plots], ids=lambda package: package.__name__)
def test_type_checkers_see_the_names_that_are_loaded(package):
    block = next(node for node in ast.parse(Path(package.__file__).read_text()).body if isinstance(node, ast.If))
    seen = {alias.name: node.module for node in block.body for alias in node.names}
    assert sorted(name for name, home in seen.items() if installed(home)) == sorted(package.__all__)
    for name, home in package._homes.items():
        assert seen[name] == home


def test_the_import_of_a_module_leaves_its_name_to_the_function():
    code = (
        "import probcal.sensor, probcal.analysis.compare, probcal.analysis.bounds\n"
        "import probcal\nfrom probcal import simulate, linalg\n"
        "from probcal.analysis import bounds, compare\n"
        "found = (probcal.sensor, probcal.analysis.compare, compare, bounds, simulate, linalg, probcal.sensors)\n"
        "print(*(type(value).__name__ for value in found))"
    )
    assert fresh(code) == ["function " * 5 + "module module"]
