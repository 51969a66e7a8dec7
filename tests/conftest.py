"""Settings for all tests: no timed asserts (two busy cores make any deadline a lie), one thread for each process."""

import torch
from hypothesis import settings

settings.register_profile("ssmail", deadline=None)
settings.load_profile("ssmail")
torch.set_num_threads(1)
