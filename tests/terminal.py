"""The command line, in the process of the tests or in one of its own."""

import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from unittest import mock

import pytest

from probcal import cli

INSTALLED = {command.name for command in cli.app.registered_commands if not command.hidden}  # other wings are missing


def call(*arguments):
    """A command in this process, so that its kernels are shared: exit code, stdout, stderr."""
    out, err = io.StringIO(), io.StringIO()
    typed = mock.patch.object(sys, "argv", ["probcal", *map(str, arguments)])
    with redirect_stdout(out), redirect_stderr(err), typed, pytest.raises(SystemExit) as caught:
        cli.main()
    return caught.value.code or 0, out.getvalue(), err.getvalue()


def run(*arguments, cwd=None):
    """A command as a user starts it, in a process of its own."""
    command = [sys.executable, "-m", "probcal.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=600)
