"""Make faults and say what came of them: see `tests.faults`."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.faults import crashes, damage, disks, objects, order, others  # noqa: F401  they list their faults
from tests.faults.registry import FAULTS
from tests.faults.world import ROOT, Unshown, World

#: Exit code of a fault that could not be made here.
_UNSHOWN = 77
#: Seconds for one fault in full, whose waits have a limit each.
_LIMIT = 4 * 3600.0


def make(name: str, count: int, seed: int) -> int:
    """Make one fault in this process."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup all that is started would ignore it
    with tempfile.TemporaryDirectory(prefix="stickslip-faults-") as directory:
        try:
            print(FAULTS[name].make(World(Path(directory), seed), count))
        except Unshown as reason:
            print(reason)
            return _UNSHOWN
    return 0


def attempt(name: str, count: int, seed: int, timeout: float) -> tuple[int, str]:
    """Make one fault in a process of its own, which is killed with all it started if it hangs: exit code, words."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.faults", "--make", name, str(count), str(seed)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        words, _ = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return 1, f"still running after {timeout:.0f} s: killed"
    return process.returncode, words.strip()


def main(argv: list[str] | None = None) -> int:
    """Make the faults that are asked for; 0 if all were shown, 1 if not."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.faults",
        description=sys.modules["tests.faults"].__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which, in full: {', '.join(FAULTS)}")
    parser.add_argument("--all", action="store_true", help="all, in full")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments and places")
    parser.add_argument("--make", nargs=3, metavar=("NAME", "COUNT", "SEED"), help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.make:
        return make(arguments.make[0], int(arguments.make[1]), int(arguments.make[2]))
    unknown = sorted(set(arguments.names) - FAULTS.keys())
    if unknown:
        parser.error(f"NAME: expected some of {', '.join(FAULTS)}, got {unknown[0]!r}")
    is_full = arguments.all or bool(arguments.names)
    names = arguments.names or [name for name, fault in FAULTS.items() if is_full or fault.quick]
    start, failed = time.monotonic(), []
    for name in names:
        began = time.monotonic()
        fault = FAULTS[name]
        code, words = attempt(name, fault.full if is_full else fault.quick, arguments.seed, _LIMIT)
        taken = f"{time.monotonic() - began:6.1f} s"
        if code:
            failed.append(name)
            print(f"{name:42} {'NOT SHOWN' if code == _UNSHOWN else 'FAILED':>9} {taken}\n{words}", flush=True)
        else:
            print(f"{name:42} {words.splitlines()[-1]:>9} {taken}", flush=True)
    print(f"{len(names) - len(failed)} of {len(names)} faults shown, {time.monotonic() - start:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
