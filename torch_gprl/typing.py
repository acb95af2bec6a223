"""Shape letters: what each name in a jaxtyping annotation means, in one place.

| letter | meaning |
|---|---|
| `*batch` | leading dimensions of independent problems; the first is usually `learners` |
| `*#batch` | the same, where sizes of one broadcast |
| `N`, `M` | numbers of points: rows, and columns where two sets meet |
| `D` | input dimensions |
| `B` | basis vectors in the buffers of a sparse GP: its budget |
| `learners`, `envs`, `T` | independent runs in one program, environments of one run, time |

The aliases below name the shapes that every kernel and every GP shares. Where sizes of one broadcast, an
argument says `*#batch`; a result has the broadcast batch, which an annotation can only write as `...`.
"""

from jaxtyping import Float
from torch import Tensor

Inputs = Float[Tensor, "*#batch N D"]
OtherInputs = Float[Tensor, "*#batch M D"]
Targets = Float[Tensor, "*#batch N"]
CrossMatrix = Float[Tensor, "... N M"]
PerPoint = Float[Tensor, "... N"]
SquareMatrix = Float[Tensor, "*batch N N"]
