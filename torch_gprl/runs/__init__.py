"""What a run leaves behind (metrics, checkpoints, pictures, films), and what it shows meanwhile.

Nothing here knows what is learned: these take tensors, arrays and labels.
"""

from torch_gprl.runs.checkpoints import Checkpoints
from torch_gprl.runs.command_line import Algorithm, CommandLine
from torch_gprl.runs.curves import LoggerName, check_logger
from torch_gprl.runs.errors import UserError, check_device, mistakes_of_the_user
from torch_gprl.runs.evaluation import evaluate, film, summary
from torch_gprl.runs.failures import RunFailure, failures_of
from torch_gprl.runs.figures import Surface, compare_curves, learning_curve, save_figure, value_surface
from torch_gprl.runs.folder import RunFolder
from torch_gprl.runs.foresight import foresee, foresight_figure
from torch_gprl.runs.graph_figure import graph_figure, save_graph
from torch_gprl.runs.intervals import bootstrap_interval
from torch_gprl.runs.metrics import MetricsWriter, read_metrics
from torch_gprl.runs.output import tell, unread_output_allowed
from torch_gprl.runs.progress import Progress
from torch_gprl.runs.report import write_report
from torch_gprl.runs.stopping import StopRequest
from torch_gprl.runs.surfaces import value_on_plane
from torch_gprl.runs.video import write_video

__all__ = [
    "Algorithm",
    "Checkpoints",
    "CommandLine",
    "LoggerName",
    "MetricsWriter",
    "Progress",
    "RunFailure",
    "RunFolder",
    "StopRequest",
    "Surface",
    "UserError",
    "bootstrap_interval",
    "check_device",
    "check_logger",
    "compare_curves",
    "evaluate",
    "failures_of",
    "film",
    "foresee",
    "foresight_figure",
    "graph_figure",
    "learning_curve",
    "mistakes_of_the_user",
    "read_metrics",
    "save_figure",
    "save_graph",
    "summary",
    "tell",
    "unread_output_allowed",
    "value_on_plane",
    "value_surface",
    "write_report",
    "write_video",
]
