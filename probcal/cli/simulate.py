"""`simulate`: the table of a model's scenario, and beside it its true tracks and biases."""

from pathlib import Path

from probcal.cli.models import call, load_model
from probcal.errors import InputError
from probcal.files import Outputs
from probcal.simulate import Simulation


def run(model: Path, seed: int, outputs: Outputs) -> int:
    """Simulate a model's scenario: the table, and beside it its true tracks and biases."""
    module = load_model(model)
    simulation = call(module, model, "scenario", seed)
    if not isinstance(simulation, Simulation):
        raise InputError(f"{model.name}: scenario() returned {type(simulation).__name__}; return probcal.simulate(...)")
    with outputs.writing():
        written = simulation.write(outputs.folder / outputs.names[0])
    print(f"written: {', '.join(str(p) for p in written)} ({len(simulation.table)} rows)")
    return 0
