"""The command with an address instead of a directory, from the first run to the report."""

from __future__ import annotations

import io

import pandas as pd
import pytest

from stickslip.workflows.commands import main
from tests.faults.bucket import ask, bucket
from tests.scenes import COULOMB, ensemble

SOURCE = ensemble(5, 8.0, 2, COULOMB, title="in a bucket", analysis="t_burn = 1.0\ndt = 0.5\nresamples = 2")


@pytest.fixture(scope="module")
def server():
    with bucket() as address:
        yield address


@pytest.mark.long
def test_run_status_verify_query_and_report_at_an_address(here, server, tmp_path, capsys):
    scene, out = tmp_path / "scene.toml", "s3://bucket/deep/out"
    scene.write_text(SOURCE)
    assert main(["run", str(scene), "--out", out, "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert f"data    {out}/data: 2 members" in said
    assert f"report  {out}/report.html" in said
    kept = f"{server}/bucket/deep/out"
    assert b"in a bucket" in ask(f"{kept}/report.html")
    assert ask(f"{kept}/scene.toml").decode() == SOURCE
    assert len(pd.read_parquet(io.BytesIO(ask(f"{kept}/report/law.parquet")))) > 0
    assert main(["status", out]) == 0
    assert "members 2 of 2 done" in capsys.readouterr().out
    assert main(["verify", out]) == 0
    assert capsys.readouterr().out == f"{out}: every shard that is done is as the manifest says\n"
    assert main(["query", out, "SELECT count(*) AS n FROM members", "--format", "csv"]) == 0
    assert capsys.readouterr().out.split() == ['"n"', "2"]
    assert main(["report", out]) == 0


def test_what_the_store_refuses_is_one_line(here, server, tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    scene.write_text(SOURCE)
    assert main(["run", str(scene), "--out", "s3://nowhere/out", "--workers", "1"]) == 1
    err = capsys.readouterr().err
    assert err.startswith(
        "stickslip: s3://nowhere/out/.lock: cannot be written (The specified bucket does not exist)"
    )
    assert err.count("\n") == 1
    ask(f"{server}/_share/0/1/403", "PUT")
    try:
        assert main(["status", "s3://bucket/out"]) == 1
        err = capsys.readouterr().err
        assert err.startswith(
            "stickslip: s3://bucket/out/manifest.json: cannot be read ("
        )  # in the words of the store
        assert err.endswith("); check the address, the credentials and the network\n")
        assert err.count("\n") == 1
    finally:
        ask(f"{server}/_share/0/0/403", "PUT")


@pytest.mark.parametrize("how", ["standard", "ignored"])
def test_a_condition_is_taken_by_its_status_and_a_store_that_ignores_it_is_refused(
    how, here, server, tmp_path, capsys
):
    """Another server than Amazon's answers 412 in words of its own; some answer 200, and overwrite."""
    scene, out = tmp_path / "scene.toml", f"s3://bucket/{how}"
    scene.write_text(SOURCE)
    ask(f"{server}/_conditions/{how}", "PUT")
    try:
        code = main(["run", str(scene), "--out", out, "--workers", "1", "--no-report"])
        said = capsys.readouterr()
        if how == "standard":
            assert code == 0, said.err
            assert main(["verify", out]) == 0
            return
        assert code == 1
        assert said.err.startswith(
            f"stickslip: {out}: expected a store that refuses to create an object where one is"
        )
        assert "it ignores the request's condition (If-None-Match in S3)" in said.err
        assert said.err.count("\n") == 1
        assert b"<Key>" not in ask(f"{server}/bucket?list-type=2&prefix={how}/")
    finally:
        ask(f"{server}/_conditions/amazon", "PUT")


def test_a_store_that_ends_with_the_command_is_refused(small_scene, capsys):
    for address in ("memory://x/y", "simplecache::memory://x/y"):
        assert main(["run", str(small_scene), "--workers", "1", "--out", address]) == 2
        assert f"--out: expected a place that lasts, got {address}, which ends" in capsys.readouterr().err
