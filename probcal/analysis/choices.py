"""The arguments of a comparison other than its fits: their number, their names, pairs of biases."""

from collections.abc import Sequence

from probcal.errors import InputError
from probcal.labels import check_name


def check_count(count: int) -> None:
    """Raise `InputError` for fewer than two fits."""
    if count < 2:
        raise InputError(f"compare: {count} fit(s) given; give at least two")


def check_names(names: Sequence[str], count: int) -> None:
    """Raise `InputError` where the names do not name each of `count` fits, or cannot name a group of a file."""
    if len(names) != count or len(set(names)) < len(names):
        raise InputError(f"compare: {len(names)} names for {count} fits; give each fit a name of its own")
    for name in names:
        check_name("compare: a fit", name)
        if not name.strip(".") or "/" in name:
            raise InputError(f'compare: a fit cannot be called "{name}"; give a name of letters, without "/"')


def split_pair(labels: Sequence[str]) -> tuple[str, str]:
    """Two different labels; raises `InputError` for anything else."""
    pair = [str(label).strip() for label in labels]
    if len(pair) != 2 or pair[0] == pair[1]:
        raise InputError(f'the pair "{",".join(pair)}" must be two labels of biases, LABEL,LABEL')
    return pair[0], pair[1]
