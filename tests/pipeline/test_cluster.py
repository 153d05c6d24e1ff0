"""Who may have a run's workers do something: nobody else on the machine; and what an address has to be."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import multiprocessing
import os
import resource
import socket
import stat
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import dask
import pytest
from distributed import Client, Nanny, Security
from distributed.core import rpc
from distributed.utils import LoopRunner

from stickslip.pipeline import AddressError, ScheduleError, run_ensemble, status
from stickslip.pipeline.running import cluster
from tests.processes import dask_by_hand, listening


def processes_of(client):
    return [os.getpid(), *client.run(os.getpid).values()]


def test_nothing_listens_but_on_the_loopback_and_who_has_not_the_certificate_is_not_answered():
    async def ask(address, security):
        connection = security.get_connection_args("client")
        async with rpc(address, timeout=500, connection_args=connection) as server:
            return await asyncio.wait_for(server.identity(), 60)

    before = listening([os.getpid()])
    with cluster.local(1) as client:
        opened = sorted(listening(processes_of(client)) - before)
        own = client.security
        assert len(opened) == 3  # the scheduler; a worker, and who watches it
        assert not client.dashboard_link
        for host, port in opened:
            assert host == "127.0.0.1"
            assert "id" in LoopRunner().run_sync(ask, f"tls://{host}:{port}", own)
            for scheme, security in (("tcp", Security()), ("tls", Security.temporary())):
                with pytest.raises(OSError):  # closed at once
                    LoopRunner().run_sync(ask, f"{scheme}://{host}:{port}", security)
    assert listening([os.getpid()]) == before


def test_a_web_server_that_is_asked_for_is_on_the_loopback_too():
    before = listening([os.getpid()])
    with cluster.local(1, dashboard=True) as client:
        opened = listening(processes_of(client)) - before
        assert {host for host, _ in opened} == {"127.0.0.1"}
        assert len(opened) == 4
        assert client.dashboard_link
    assert listening([os.getpid()]) == before


def test_dask_looks_for_modules_where_nobody_else_writes(tmp_path):
    """Dask puts its directory first on the path of modules: in /tmp it would be whoever's made it first."""
    with dask.config.set({"temporary-directory": str(tmp_path)}), cluster.local(1) as client:
        (directory,) = client.run(lambda dask_worker: dask_worker.local_directory).values()
        (own,) = tmp_path.iterdir()
        assert Path(directory).resolve().is_relative_to(own)
        assert stat.S_IMODE(own.stat().st_mode) == 0o700
    with contextlib.suppress(FileNotFoundError):  # as a worker does that starts too late
        os.makedirs(directory)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("moment", ["__init__", "instantiate"])
def test_nothing_of_a_start_goes_on_once_it_is_broken_off(moment, monkeypatch, tmp_path):
    """It would go on with dask's own configuration: in TMPDIR, and with other processes."""
    begun, act = threading.Event(), getattr(Nanny, moment)

    def slow(*arguments, **settings):
        begun.set()
        time.sleep(0.3)  # the loop's thread, while this one leaves
        return act(*arguments, **settings)

    def broken_off(*_):
        assert begun.wait(60.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(Nanny, moment, slow)
    monkeypatch.setattr(cluster, "_wait_for", broken_off)
    with dask.config.set({"temporary-directory": str(tmp_path)}), pytest.raises(KeyboardInterrupt), cluster.local(2):
        pass
    assert multiprocessing.active_children() == []
    assert not {thread.name for thread in threading.enumerate()} & {"IO loop"}
    assert list(tmp_path.iterdir()) == []


def test_certificates_of_dasks_configuration_open_an_address(scene, finished, content, tmp_path):
    with cluster.local(1) as client:
        names = {"ca-file": "tls_ca_file", "client.cert": "tls_client_cert", "client.key": "tls_client_key"}
        tls = {f"distributed.comm.tls.{key}": getattr(client.security, name) for key, name in names.items()}
        with dask.config.set(tls):
            run_ensemble(scene, tmp_path / "out", scheduler=client.scheduler.address)
        with pytest.raises(AddressError, match=r"certificates in dask's configuration, distributed\.comm\.tls"):
            run_ensemble(scene, tmp_path / "other", scheduler=client.scheduler.address)
        foreign = Security.temporary()
        others = {f"distributed.comm.tls.{key}": getattr(foreign, name) for key, name in names.items()}
        with dask.config.set(others), pytest.raises(AddressError, match=r"UNKNOWN_CA|certificate verify failed"):
            run_ensemble(scene, tmp_path / "other", scheduler=client.scheduler.address)
    assert content(tmp_path / "out") == content(finished)
    assert not (tmp_path / "other").exists()


def test_workers_that_cannot_load_the_program_are_refused_by_name(scene, tmp_path):
    """Their first task would end them, and only their logs would say why."""
    (tmp_path / "bad" / "stickslip").mkdir(parents=True)
    (tmp_path / "bad" / "stickslip" / "__init__.py").write_text("raise ImportError('half installed')")
    with dask_by_hand(tmp_path, "--nthreads", "1", PYTHONPATH=str(tmp_path / "bad")) as (address, _):
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=500)
        with pytest.raises(
            ScheduleError, match=r"this version .*, got tcp://\S+ with ImportError\('half installed'\)"
        ):
            run_ensemble(scene, tmp_path / "out", scheduler=address)
    assert status(tmp_path / "out").n_done == 0


class _Page(BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass


def test_what_is_no_scheduler_is_refused(monkeypatch):
    monkeypatch.setattr("stickslip.pipeline.running.cluster.CONNECT_TIMEOUT", 1.0)
    silent = socket.create_server(("127.0.0.1", 0))
    with silent, HTTPServer(("127.0.0.1", 0), _Page) as web, cluster.local(1) as client:
        threading.Thread(target=web.serve_forever, daemon=True).start()
        addresses = {
            f"tcp://127.0.0.1:{silent.getsockname()[1]}": "no answer in 1 s",
            f"tcp://127.0.0.1:{web.server_port}": "",
            client.scheduler.address.replace("tls", "tcp"): "",
            "tcp://127.0.0.1:9": "Connection refused",
            "nonsense": "missing port",
            "http://127.0.0.1:8786": "unknown address scheme",
            "": "missing port",
        }
        for address, why in addresses.items():
            with pytest.raises(AddressError, match=f"^scheduler: expected .* got {address!r} .*{why}") as error:
                cluster.check_address(address)
            assert "\n" not in str(error.value)
        web.shutdown()
        names = {"ca-file": "tls_ca_file", "client.cert": "tls_client_cert", "client.key": "tls_client_key"}
        tls = {f"distributed.comm.tls.{key}": getattr(client.security, name) for key, name in names.items()}
        (worker,) = client.run(lambda dask_worker: dask_worker.address).values()
        with dask.config.set(tls), pytest.raises(AddressError, match="a QuietWorker answers there"):
            cluster.check_address(worker)


def test_workers_that_may_not_open_enough_files_are_refused_and_a_soft_limit_is_raised(monkeypatch):
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (30, 30))
    refused = pytest.raises(ScheduleError, match=r"workers: expected a limit of 64 or more open files, .* got 30")
    with refused, cluster.local(2):
        pass
    monkeypatch.undo()
    resource.setrlimit(resource.RLIMIT_NOFILE, (40, limits[1]))  # too few for what is open by now
    try:
        with cluster.local(2) as client:
            client.wait_for_workers(2, timeout=500)
            assert len(list(Path("/proc/self/fd").iterdir())) > 40
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] == 40
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_a_machine_without_loopback_is_told_at_once(monkeypatch):
    def unreachable(*_):
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(socket, "create_connection", unreachable)
    words = r"workers: expected connections .* got none .*unreachable.*; bring"
    with pytest.raises(ScheduleError, match=words), cluster.local(1):
        pass
