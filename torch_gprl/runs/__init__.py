"""What a run leaves behind (metrics, checkpoints, pictures, films), and what it shows meanwhile.

Nothing here knows what is learned: these take tensors, arrays and labels.
"""

from torch_gprl.runs.checkpoints import Checkpoints
from torch_gprl.runs.errors import UserError
from torch_gprl.runs.evaluation import evaluate, film
from torch_gprl.runs.figures import Surface, learning_curve, save_figure, value_surface
from torch_gprl.runs.folder import RunFolder
from torch_gprl.runs.intervals import bootstrap_interval
from torch_gprl.runs.metrics import MetricsWriter, read_metrics
from torch_gprl.runs.progress import Progress
from torch_gprl.runs.video import write_video

__all__ = [
    "Checkpoints",
    "MetricsWriter",
    "Progress",
    "RunFolder",
    "Surface",
    "UserError",
    "bootstrap_interval",
    "evaluate",
    "film",
    "learning_curve",
    "read_metrics",
    "save_figure",
    "value_surface",
    "write_video",
]
