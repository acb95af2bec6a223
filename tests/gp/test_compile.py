"""The posterior compiles whole: one graph, the numbers of eager mode, also after more has been learned.

The check is a program of its own: the import hook of these tests wraps every function, and torch.compile
refuses wrapped ones.
"""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROGRAM = """
import torch

from torch_gprl.gp import SparseOnlineGP
from torch_gprl.kernels import SquaredExponential


def check(backend, fresh, shape):
    torch.compiler.reset()
    gp = SparseOnlineGP(SquaredExponential(2, 0.7), 20, 0.1, batch_shape=shape).requires_grad_(False)
    points = torch.randn(7, 2, dtype=torch.float64)
    compiled = torch.compile(gp.posterior, fullgraph=True, backend=backend)

    def learn():
        inputs = torch.randn(30, 2, dtype=torch.float64)
        gp.update(inputs, inputs.sin().sum(-1))

    def change_kernel():
        gp.kernel.lengthscale = 1.3
        gp.rebase()

    for step in (lambda: None, learn, learn, change_kernel, gp.reset, learn):
        step()
        if fresh:  # otherwise the graph renews what is derived from the state
            gp.refresh()
        for one, other in zip(compiled(points), gp.posterior(points), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


torch.manual_seed(0)
for backend in ("eager", "aot_eager"):
    for fresh in (True, False):
        for shape in ((), (3,)):
            check(backend, fresh, shape)
"""


def test_the_compiled_posterior_is_one_graph_and_follows_the_state():
    command = [sys.executable, "-c", PROGRAM]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr[-3000:]
