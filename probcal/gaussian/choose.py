"""The choice of an engine by the size of a model."""

from __future__ import annotations

import numpy as np

from probcal.gaussian.dense import DenseEngine
from probcal.gaussian.engine import Engine, Expansion
from probcal.gaussian.joint import too_large
from probcal.gaussian.sparse import SparseEngine
from probcal.model.model import Model

WHOLE = 600  # biases up to which a matrix of all of them is made on request: its eigenvalues take 0.2 s there
COLUMNS = 64  # of it at once


def choose(model: Model) -> Engine:
    """Dense where its matrices take at most 240 MB, or where the sparse engine does not take the model."""
    return SparseEngine() if too_large(model) else DenseEngine()


def information_of(at: Expansion) -> np.ndarray | None:
    """Information (M, M) of the data about the biases, None where these are more than `WHOLE`."""
    M = at.model.biases
    if M > WHOLE:
        return None
    unit = np.eye(M)
    found = np.concatenate([np.asarray(at.apply(unit[:, k : k + COLUMNS])) for k in range(0, M, COLUMNS)], 1)
    return 0.5 * (found + found.T)
