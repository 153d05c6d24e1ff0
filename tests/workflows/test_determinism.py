"""A scene gives the same bytes in another process, in which Python's hashes, and so the order of its sets, differ."""

from __future__ import annotations

import os
import random
import subprocess
import sys


def test_two_processes_with_different_hash_seeds_write_the_same_bytes(small_scene, tmp_path):
    """Data, manifest, figures, tables and page: all but the record of times."""
    seeds = random.sample(range(1, 2**32), 2)
    print("hash seeds", seeds)
    written = []
    for seed in seeds:
        here = tmp_path / str(seed)
        here.mkdir()
        command = [sys.executable, "-m", "stickslip", "run", str(small_scene), "--out", "out", "--workers", "1"]
        environment = {**os.environ, "PYTHONHASHSEED": str(seed), "PYTHONPATH": os.getcwd()}
        done = subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        files = [file for file in (here / "out").rglob("*") if file.is_file() and file.name != "timings.jsonl"]
        written.append({str(file.relative_to(here)): file.read_bytes() for file in files})
    one, other = written
    assert "out/report.html" in one
    assert one.keys() == other.keys()
    assert [name for name in one if one[name] != other[name]] == []
