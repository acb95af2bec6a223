"""What holds for every test: checked shapes and types, one thread, a fixed seed."""

import numpy as np
import pytest
import torch
from jaxtyping import install_import_hook

# Has to run before the first import of torch_gprl. It stays out of the library itself: with the hook
# installed torch.compile refuses the functions. The tower lets an int stand where a float is asked for, as
# PEP 484 and pyright do.
install_import_hook("torch_gprl", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seed_every_generator() -> None:
    """Every test starts from the same random numbers, whatever ran before it."""
    torch.manual_seed(0)
    np.random.seed(0)
