"""Which sockets processes listen on, as the operating system lists them."""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path

import pytest

LISTENING = "0A"  # linux/include/net/tcp_states.h

needs_proc = pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs Linux's /proc")


def family(process: int) -> set[int]:
    """A process and all that it started."""
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:  # ended meanwhile
            continue
    found = {process}
    while more := {p for p, parent in parents.items() if parent in found} - found:
        found |= more
    return found


def _inodes(processes: set[int]) -> set[str]:
    links = [link for p in processes for link in Path(f"/proc/{p}/fd").glob("*")]
    found = set()
    for link in links:
        try:
            target = os.readlink(link)
        except OSError:
            continue
        if target.startswith("socket:["):
            found.add(target[8:-1])
    return found


def _address(text: str) -> str:
    """An address of /proc/net/tcp or tcp6: words of 32 bits, each in the machine's order."""
    words = [int(text[i : i + 8], 16) for i in range(0, len(text), 8)]
    packed = struct.pack(f"={len(words)}I", *words)
    return socket.inet_ntop(socket.AF_INET if len(words) == 1 else socket.AF_INET6, packed)


def listening(process: int) -> set[tuple[str, int]]:
    """(address, port) that a process and those that it started listen on."""
    own, found = _inodes(family(process)), set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == LISTENING and fields[9] in own:
                address, port = fields[1].split(":")
                found.add((_address(address), int(port, 16)))
    return found
