"""A real Ray cluster for tests, whose nodes are processes on loopback addresses, with a CPU each."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from tests.cli.test_cli_killed import children_of
from tests.execution.slurm_cluster import ENDS_WITH_PARENT

_SECONDS = 120.0  # to start in
_MEMORY = ("--object-store-memory", "80000000", "--num-cpus", "1")
Node = subprocess.Popen[bytes]


class RayCluster:
    """A running cluster. `address` is what --launcher-set takes."""

    def __init__(self, nodes: int) -> None:
        pytest.importorskip("ray", reason="ray, of the extra ray, is not installed")
        self.folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))  # short: a socket's path has a limit
        self._environment = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0", "SSMAIL_STALE_SECONDS": "10"}
        self.nodes: list[Node] = []
        port = _free_port()
        self.address = f"127.0.0.1:{port}"
        try:
            head = ("--head", "--port", str(port), "--include-dashboard", "false", "--temp-dir", str(self.folder))
            self._start("127.0.0.1", *head)
            self._wait_for(1)
            for number in range(2, nodes + 1):
                self._start(f"127.0.0.{number}", "--address", self.address)
            self._wait_for(nodes)
        except BaseException:
            self.close()
            raise

    def _start(self, host: str, *words: str) -> None:
        command = (
            *ENDS_WITH_PARENT,
            sys.executable,
            "-m",
            "ray.scripts.scripts",
            "start",
            "--block",
            "--node-ip-address",
            host,
        )
        with (self.folder / f"{host}.log").open("wb") as log:
            self.nodes.append(
                subprocess.Popen(
                    (*command, *_MEMORY, *words),
                    env=self._environment,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
            )

    def _wait_for(self, count: int) -> None:
        code = f"import ray; ray.init('{self.address}', log_to_driver=False, logging_level=40); print(len(ray.nodes()))"
        deadline = time.monotonic() + _SECONDS
        while time.monotonic() < deadline:
            done = subprocess.run(
                (sys.executable, "-c", code), env=self._environment, capture_output=True, text=True, check=False
            )
            if done.stdout.strip() == str(count):
                return
        logs = "\n".join(path.read_text(errors="replace")[-2000:] for path in self.folder.glob("*.log"))
        raise TimeoutError(f"{done.stderr[-2000:]}\n{logs}")

    def kill(self, node: Node) -> None:
        """Kill all processes of a node, as a power failure would."""
        waiting, found = [node.pid], []
        while waiting:
            found.append(waiting.pop())
            waiting += children_of(found[-1])
        for pid in found:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:  # it has just ended
                continue
        node.wait()

    def close(self) -> None:
        """End the cluster and delete its folder."""
        for node in reversed(self.nodes):
            if node.poll() is None:
                self.kill(node)
        shutil.rmtree(self.folder, ignore_errors=True)


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])
