"""A real SLURM of one node for tests: munged, slurmctld and slurmd in a folder of their own, on free local ports."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

CPUS = 4  # more than there may be: the tests' jobs wait for each other rather than compute
_PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scancel", "squeue", "sinfo")
_SECONDS = 60.0  # to start in
_CONF = """\
ClusterName=ssmail
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmctldPort={controller_port}
SlurmdPort={node_port}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=1,sched_min_interval=0,batch_sched_delay=0,requeue_delay=1
ReturnToService=2
KillWait=10
JobRequeue=1
MaxArraySize=1001
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
SlurmdSpoolDir={folder}/spool
StateSaveLocation={folder}/state
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


# what a daemon is started by, so that it ends with the tests, even if they are killed
ENDS_WITH_PARENT = ("setpriv", "--pdeathsig", "TERM") if shutil.which("setpriv") else ()


class Cluster:
    """A running SLURM. `environment` is what its commands need, `host` the name of its node."""

    def __init__(self) -> None:
        self._missing = [name for name in _PROGRAMS if _found(name) is None]
        if self._missing or os.getuid() != 0:
            lacks = f"{', '.join(self._missing)} (Debian: apt-get install slurmctld slurmd slurm-client munge)"
            pytest.skip(f"SLURM needs {lacks if self._missing else 'root to be started by a test'}")
        self.folder = Path(tempfile.mkdtemp(prefix="ssmail-slurm-", dir="/tmp"))
        self._daemons: list[subprocess.Popen[bytes]] = []
        self.host = socket.gethostname()
        self.environment = {"SLURM_CONF": str(self.folder / "slurm.conf")}
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        for name in ("spool", "state"):
            (self.folder / name).mkdir()
        host, (first, second) = self.host, _free_ports()
        ports = {"controller_port": first, "node_port": second}
        (self.folder / "slurm.conf").write_text(_CONF.format(host=host, folder=self.folder, cpus=CPUS, **ports))
        key = self.folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        files = (f"--socket={self.folder}/munge.socket", f"--key-file={key}", f"--log-file={self.folder}/munged.log")
        more = (f"--pid-file={self.folder}/munged.pid", f"--seed-file={self.folder}/munged.seed")
        self._daemon("munged", "--foreground", "--force", *files, *more)
        self._wait(lambda: (self.folder / "munge.socket").exists())
        self._daemon("slurmctld", "-D", "-i", "-f", self.folder / "slurm.conf")
        self._daemon("slurmd", "-D", "-f", self.folder / "slurm.conf", "-N", host)
        self._wait(lambda: self.command("sinfo", "--noheader", "--format=%T").strip() == "idle")

    def _daemon(self, name: str, *arguments: object) -> None:
        with (self.folder / f"{name}.out").open("ab") as log:
            command = [*ENDS_WITH_PARENT, str(_found(name)), *map(str, arguments)]
            env = {**os.environ, **self.environment}
            self._daemons.append(subprocess.Popen(command, stdout=log, stderr=log, env=env, start_new_session=True))

    def _wait(self, is_so: Callable[[], bool]) -> None:
        deadline = time.monotonic() + _SECONDS
        while time.monotonic() < deadline:
            if is_so():
                return
            time.sleep(0.2)
        logs = [f"{path.name}:\n{path.read_text(errors='replace')[-1500:]}" for path in self.folder.glob("*.*o*g")]
        raise TimeoutError("\n".join(logs))

    def command(self, *words: str) -> str:
        """Return what a command of SLURM prints, or nothing if it fails."""
        env = {**os.environ, **self.environment}
        return subprocess.run(words, env=env, capture_output=True, text=True, check=False).stdout

    def close(self) -> None:
        """End all jobs and daemons, and delete the folder."""
        if len(self._daemons) == 3:
            self.command("scancel", "--full", "--signal=KILL", "--user=root")
            self.command("scancel", "--user=root")
        for daemon in reversed(self._daemons):
            daemon.send_signal(signal.SIGTERM)
            try:
                daemon.wait(20)
            except subprocess.TimeoutExpired:
                daemon.kill()
                daemon.wait()
        shutil.rmtree(self.folder, ignore_errors=True)


def _found(name: str) -> str | None:
    return shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin")


def _free_ports() -> tuple[int, int]:
    with socket.socket() as first, socket.socket() as second:
        first.bind(("127.0.0.1", 0))
        second.bind(("127.0.0.1", 0))
        return first.getsockname()[1], second.getsockname()[1]
