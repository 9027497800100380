"""The memory needed by the dense form of a problem, and its limit."""

from probcal.errors import InputError
from probcal.model.model import Model

ROOM = 30_000_000  # numbers (240 MB, and some 2 GB with all that is made of them) up to which dense is preferred
MOST = 5  # times that room up to which it is tried where there is no other


def dense_numbers(model: Model) -> int:
    """The size of the dense form: the response of every state to every bias, and three matrices (M, M)."""
    return model.biases * model.state_size + 3 * model.biases**2


def check_room(model: Model) -> None:
    """Raise `InputError` where the dense form does not fit an ordinary machine."""
    if dense_numbers(model) > MOST * ROOM:
        size = 8e-9 * dense_numbers(model)
        raise InputError(
            f"the dense form of {model.biases} biases and {model.state_size} states takes {size:.0f} GB: EA(), MAP(),"
            " EM() and Gibbs() fit a network of this size in sparse form, and the verbs take it; for other methods take"
            " fewer sensors or a shorter time"
        )
