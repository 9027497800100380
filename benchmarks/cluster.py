"""The study of Paper B on separate worker processes of dask, a worker and the client killed midway.

    uv run --extra cluster python benchmarks/cluster.py --runs 250
    uv run --extra cluster python benchmarks/cluster.py --runs 10 --shares 0:1:0.5

First whole on threads of one process, then with a scheduler and a worker for each processor: at a third of the fits a
worker is killed (another takes its place), at half of them the client, which is started again with --resume. Prints
seconds of both, what was kept, and whether all numbers are the same, bit for bit; exits with 1 where they are not.
"""

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from probcal import InputError, load_study

MODEL = Path(__file__).parents[1] / "models" / "radars.py"
SERVER = (sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--no-dashboard")
WORKER = (sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard")


def client(out: Path, given: list[str], *more: str) -> subprocess.Popen[str]:
    """`probcal study` as a process of its own."""
    order = [sys.executable, "-m", "probcal.cli", "study", str(MODEL), *given, "--out", str(out), *more]
    return subprocess.Popen(order, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True)


def finished(out: Path) -> int:
    """Fits that are kept."""
    with contextlib.suppress(InputError):
        return int((load_study(out)["status"] != "").sum())
    return 0


def wait(process: subprocess.Popen[str], out: Path, count: int) -> None:
    """Wait until so many fits are kept."""
    while finished(out) < count:
        if process.poll() is not None:
            sys.exit(f"the study ended with {process.returncode}, {finished(out)} fits kept")
        time.sleep(1.0)


def ended(process: subprocess.Popen[str]) -> None:
    """Wait for a study to end well."""
    if process.wait():
        sys.exit(f"the study ended with {process.returncode}")


def killed(folder: Path, out: Path, given: list[str], total: int) -> int:
    """Run the study on workers, of which one is killed, and then the client; what was kept by then."""
    with socket.socket() as free, contextlib.ExitStack() as stack:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        log = stack.enter_context((folder / "dask.log").open("w"))

        def start(*order: str) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(order, stdout=log, stderr=log, cwd=folder)
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        address = f"tcp://127.0.0.1:{port}"
        start(*SERVER, "--port", str(port))
        workers = [start(*WORKER, address) for _ in range(os.cpu_count() or 1)]
        first = client(out, given, "--scheduler", address)
        wait(first, out, total // 3)
        workers[0].send_signal(signal.SIGKILL)
        start(*WORKER, address)
        wait(first, out, total // 2)
        first.send_signal(signal.SIGKILL)
        first.wait()
        kept = finished(out)
        ended(client(out, given, "--scheduler", address, "--resume"))
        return kept


def main() -> None:
    """Run both and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=250)
    parser.add_argument("--shares", default="0:1:0.05")
    chosen = parser.parse_args()
    given = ["--set", "scenario=B", "--set", f"share={chosen.shares}", "--methods", "ml,oracle,ea-printed"]
    given += ["--runs", str(chosen.runs)]
    with tempfile.TemporaryDirectory() as folder:
        whole, parted = Path(folder) / "whole", Path(folder) / "parted"
        begun = time.perf_counter()
        ended(client(whole, given))
        alone = time.perf_counter() - begun
        wanted = load_study(whole)
        begun = time.perf_counter()
        kept = killed(Path(folder), parted, given, int(wanted["status"].size))
        spread = time.perf_counter() - begun
        same = load_study(parted).identical(wanted)
    print(f"{wanted['status'].size} fits on threads of one process: {alone:.0f} s")
    print(f"on {os.cpu_count()} workers, one killed, the client killed with {kept} fits kept: {spread:.0f} s in all")
    print("identical, bit for bit" if same else "NOT identical")
    sys.exit(not same)


if __name__ == "__main__":
    main()
