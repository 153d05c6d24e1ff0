"""A scene gives the same bytes in another process, in which Python's hashes, and so the order of its sets, differ."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


@pytest.mark.long
def test_two_processes_with_different_hash_seeds_write_the_same_bytes(small_scene, dataset, tmp_path, random_seed):
    """Data, manifest, figures, tables and page: all but the record of times. One is this process."""
    command = [sys.executable, "-m", "stickslip", "run", str(small_scene), "--out", "out", "--workers", "1"]
    environment = {**os.environ, "PYTHONHASHSEED": str(max(random_seed, 1)), "PYTHONPATH": os.getcwd()}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    one, other = (
        {
            str(file.relative_to(out)): file.read_bytes()
            for file in out.rglob("*")
            if file.is_file() and file.name != "timings.jsonl"
        }
        for out in (dataset, tmp_path / "out")
    )
    assert "report.html" in one
    assert one.keys() == other.keys()
    assert [name for name in one if one[name] != other[name]] == []
