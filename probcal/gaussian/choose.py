"""The choice of an engine by the size of a model."""

from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Engine
from probcal.gaussian.joint import too_large
from probcal.gaussian.sparse import SparseEngine
from probcal.model.model import Model


def choose(model: Model) -> Engine:
    """Dense where its matrices take at most 240 MB, or where the sparse engine does not take the model."""
    return SparseEngine() if too_large(model) else DenseEngine()
