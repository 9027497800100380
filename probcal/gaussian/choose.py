"""The choice of an engine by the size of a model."""

import numpy as np

from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Engine
from probcal.gaussian.joint import missing
from probcal.gaussian.room import ROOM, dense_numbers
from probcal.gaussian.sparse import SparseEngine
from probcal.model.model import Model

MANY, THIN = 500, 0.25  # biases, and the share of them that an epoch sees, from which the sparse form is the faster


def choose(model: Model) -> Engine:
    """Dense where its matrices take at most 240 MB, or where the sparse engine does not take the model."""
    return SparseEngine() if prefers_sparse(model) and not missing(model) else DenseEngine()


def choose_fast(model: Model) -> Engine:
    """The engine that solves fastest under many factors: sparse also where an epoch sees few of many biases."""
    return SparseEngine() if is_thin(model) and not missing(model) else choose(model)


def prefers_sparse(model: Model) -> bool:
    """Whether the matrices of the dense form take more than 240 MB."""
    return dense_numbers(model) > ROOM


def is_thin(model: Model) -> bool:
    """Whether an epoch sees few of many biases: more than 500, less than a quarter of them."""
    if model.biases <= MANY:
        return False
    seen = sum(int(np.sum(np.asarray(data.bias)[np.asarray(data.sensor)] < model.biases)) for data in model.rows)
    epochs = sum(part.drift.shape[0] for part in model.recursions)
    return seen < THIN * epochs * model.biases
