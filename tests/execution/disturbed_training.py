"""Real training that something happens to; tests.execution.fake_worker runs it in worker processes."""

import os
import random
import signal
import threading
from collections.abc import Sequence

from ssmail.training.loop import TrainingLoop
from tests.execution.fake_loop import wait_until_asked_to_stop

_draw = random.Random(2)
LAST_EPOCH, DELAY = _draw.randrange(1, 4), _draw.uniform(0, 0.3)


class Killed(TrainingLoop):
    """Dies by SIGKILL in the epoch after LAST_EPOCH, DELAY seconds after its beginning."""

    def run_epoch(self) -> dict[str, float]:
        if self.epoch == LAST_EPOCH:
            threading.Timer(DELAY, os.kill, (os.getpid(), signal.SIGKILL)).start()
        return super().run_epoch()


class KilledTogether(TrainingLoop):
    """Dies as Killed does, with all seeds of its process."""

    @staticmethod
    def run_epochs(loops: "Sequence[TrainingLoop]") -> Sequence[dict[str, float] | Exception]:
        if loops[0].epoch == LAST_EPOCH:
            threading.Timer(DELAY, os.kill, (os.getpid(), signal.SIGKILL)).start()
        return TrainingLoop.run_epochs(loops)


class Interrupted(TrainingLoop):
    """Its parent is sent SIGINT in the first epoch after a resumption."""

    def run_epoch(self) -> dict[str, float]:
        os.kill(os.getppid(), signal.SIGINT)
        wait_until_asked_to_stop()
        return super().run_epoch()
