"""The processes that share a fleet's work listen to nobody else."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import urllib.error
import urllib.request

import pytest

pytest.importorskip("distributed", reason="needs Dask: pip install 'bayescal[fleet]'")
pytest.importorskip("cryptography", reason="needs keys: pip install 'bayescal[fleet]'")

from distributed import Client

from tests.support.folder_of_strangers import ran, strangers_folder
from tests.support.inside import cluster_of
from tests.support.open_ports import listening, needs_proc


def address_of(client: Client) -> str:
    assert client.scheduler is not None
    return str(client.scheduler.address)


@pytest.mark.nightly
@needs_proc
def test_scheduler_and_workers_listen_on_this_computer_alone() -> None:
    before = listening(os.getpid())
    with cluster_of(1) as client:
        client.submit(abs, -1).result()
        ports = listening(os.getpid()) - before
        assert len(ports) >= 3, "scheduler, worker and its nanny"
        assert {address for address, _ in ports} == {"127.0.0.1"}
        told = client.scheduler_info()
        parts = [told, *told["workers"].values()]
        pages = {part["services"]["dashboard"] for part in parts}
        assert pages <= {port for _, port in ports}
        for port in pages:
            for page in ("status", "info/main/workers.html", "json/counts.json", "api/v1"):
                with pytest.raises(urllib.error.HTTPError, match="404"):
                    urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=1)
        address = address_of(client)
        assert address.startswith("tls://")


def test_workers_run_nothing_of_the_current_folder(tmp_path, monkeypatch) -> None:
    folder = strangers_folder(tmp_path)
    monkeypatch.chdir(folder)
    # which is set for the workers, and put back after the test
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    with cluster_of(1) as client:
        settings = client.submit(importlib.import_module, "arviz_base.rcparams")
        assert client.submit(lambda m: m.rcParams["stats.ci_prob"], settings).result() == 0.89
    assert ran(folder) == ""


STRANGER = """
import sys
from distributed import Client
from distributed.security import Security

address, kind = sys.argv[1:]
try:
    Client(address, timeout=3, security=Security.temporary() if kind == "own keys" else None)
except (OSError, TypeError) as error:
    print("refused:", "TypeError" if isinstance(error, TypeError) else "OSError")
"""


def stranger(address: str, kind: str) -> str:
    """What somebody in a process of his own is told (a client that could not connect is never safe to collect here)."""
    command = [sys.executable, "-c", STRANGER, address, kind]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).stdout


@pytest.mark.nightly
def test_other_users_of_this_computer_are_refused() -> None:
    """One without keys, one who speaks plainly, and one who made keys of his own."""
    with cluster_of(1) as client:
        address = address_of(client)
        assert "refused: TypeError" in stranger(address, "none")
        assert "refused: OSError" in stranger(address.replace("tls://", "tcp://"), "none")
        assert "refused: OSError" in stranger(address, "own keys")
        assert client.submit(abs, -2).result() == 2
