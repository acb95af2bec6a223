"""The command line: options in, a run folder out.

    python train.py                                            policy gradients on the pendulum's swing-up
    python train.py policy-gradient --help                     every option with its unit
    python train.py policy-gradient --task pendulum-explore    another task

Ctrl-C ends a run early and keeps what was learned; a second Ctrl-C aborts at once.
"""

import contextlib
import io
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

import envs
from torch_gprl.learners import PolicyGradient, PolicyGradientConfig
from torch_gprl.runs import (
    Checkpoints,
    MetricsWriter,
    Progress,
    RunFolder,
    Surface,
    UserError,
    bootstrap_interval,
    evaluate,
    film,
    learning_curve,
    read_metrics,
    save_figure,
    value_surface,
    write_video,
)

EVALUATION_SEED = 1_000_000  # the starts of all evaluations, whatever the run's own seed
CHECKPOINT_INTERVAL = 60.0  # s
GRID = 61  # points of the value surface in each direction
POINTS_AT_ONCE = 500  # of the value surface, for each learner: bounds the memory
LONGEST_FILM = 300  # frames
STDERR = 2  # file descriptor
BOX_SIDES, BOX_RULES = "│| ", "─-"  # how tyro draws with UTF-8 and without


@dataclass(frozen=True)
class RunOptions:
    """What to run, where, and where to keep it."""

    task: str = "pendulum-swingup"  # id of the task; a wrong one lists all
    learners: int = 5  # independent learners, trained side by side; the learning curve shows their spread
    num_envs: int = 5  # environments of each learner, stepped together
    seed: int = 0  # of all random numbers; the evaluation has a seed of its own
    threads: int = 1  # processor threads of torch and of the simulator
    device: str = "cpu"  # where policy and critic live: cpu, cuda, cuda:1, ...
    out: Path | None = None  # run folder, new or empty; unless given runs/<task>-<algorithm>-<date>-<time>
    evaluation_episodes: int = 20  # episodes of the final evaluation, for each learner

    def __post_init__(self) -> None:
        """Refuse what no run can start with."""
        for name in ("learners", "num_envs", "threads", "evaluation_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, but is {self.seed}")


@dataclass(frozen=True)
class PolicyGradientOptions:
    """Improve a controller by policy gradients, with advantages from a Gaussian-process critic."""

    run: tyro.conf.OmitArgPrefixes[RunOptions] = field(default_factory=RunOptions)
    algorithm: tyro.conf.OmitArgPrefixes[PolicyGradientConfig] = field(default_factory=PolicyGradientConfig)


class Algorithm(NamedTuple):
    """A way to learn: its options and the class that does it."""

    options: type[PolicyGradientOptions]
    learner: type[PolicyGradient]


ALGORITHMS = {"policy-gradient": Algorithm(PolicyGradientOptions, PolicyGradient)}


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit code: 0, 2 for an error of the user, 130 if aborted."""
    try:
        name, options = parse(arguments)
        run(name, options)
    except UserError as error:
        print(f"train.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("train.py: aborted", file=sys.stderr)
        return 130
    return 0


def parse(arguments: list[str]) -> tuple[str, PolicyGradientOptions]:
    """Turn the command line into an algorithm's name and its options.

    Raises:
        UserError: what tyro would show in a box, on one line.
    """
    named = bool(arguments) and not arguments[0].startswith("-")
    name, *rest = arguments if named else ["policy-gradient", *arguments]
    if name not in ALGORITHMS:
        raise UserError(f"unknown algorithm '{name}'; choose one of {', '.join(ALGORITHMS)}")
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return name, tyro.cli(ALGORITHMS[name].options, args=rest, prog=f"train.py {name}")
    except SystemExit as end:
        if end.code in (0, None):
            raise
        raise UserError(_one_line(complaint.getvalue())) from None


def _one_line(box: str) -> str:
    """The text of tyro's box without the box and its colours: its parts joined by semicolons."""
    parts: list[list[str]] = [[]]
    for line in re.sub(r"\x1b\[[\d;]*m", "", box).splitlines()[1:-1]:
        words = line.strip(BOX_SIDES).split()
        if set("".join(words)) <= set(BOX_RULES):
            parts.append([])
        else:
            parts[-1] += words
    return "; ".join(" ".join(part) for part in parts)


def run(name: str, options: PolicyGradientOptions) -> None:
    """Train, evaluate, and leave everything in the run folder."""
    _check_device(options.run.device)
    torch.set_num_threads(options.run.threads)
    torch.manual_seed(options.run.seed)
    env = make_env(options.run, options.run.num_envs, options.run.seed)
    with _construction_errors():
        learner = ALGORITHMS[name].learner(env, options.algorithm, seed=options.run.seed)
    folder = RunFolder(options.run.out) if options.run.out else RunFolder.named(options.run.task, name)
    folder.write_config({"algorithm": name, "run": options.run, "config": options.algorithm})
    print(
        f"{name} on {options.run.task}: {options.run.learners} learners, results in {folder.path}", flush=True
    )
    train(learner, options, folder)
    returns = evaluate(
        make_env(options.run, options.run.evaluation_episodes, EVALUATION_SEED), learner.policy
    )
    best = int(returns.mean(dim=1).argmax())
    folder.write_evaluation(returns)
    print(summary(returns), flush=True)
    draw(learner, options.run, folder, best)
    print(f"everything is in {folder.path}", flush=True)


def make_env(options: RunOptions, num_envs: int, seed: int) -> Any:  # noqa: ANN401  (TorchRL's EnvBase and more)
    """The task's environment of batch `[learners, num_envs]`."""
    with _construction_errors():
        return envs.make(
            options.task,
            learners=options.learners,
            num_envs=num_envs,
            seed=seed,
            device=options.device,
            threads=options.threads,
        )


def _check_device(name: str) -> None:
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"device '{name}' cannot be used: {reason}; --device cpu always can") from error


@contextlib.contextmanager
def _construction_errors() -> Iterator[None]:
    """Options that only the task or the algorithm can judge are the user's to mend, too."""
    try:
        yield
    except (ValueError, KeyError) as error:
        raise UserError(" ".join(str(error.args[0] if error.args else error).split())) from error


def train(learner: PolicyGradient, options: PolicyGradientOptions, folder: RunFolder) -> None:
    """Train to the end or to the first Ctrl-C, recording every update."""
    checkpoints = Checkpoints(folder.checkpoints, learner=learner)
    metrics = MetricsWriter(folder.metrics, folder.tensorboard)
    title = f"{options.run.task}, {options.run.learners} learners"
    last_saved = time.monotonic()
    with (
        contextlib.closing(metrics),
        StopRequest() as stop,
        Progress(options.algorithm.total_frames, title) as progress,
    ):
        for values in learner.train():
            metrics.write(learner.updates, learner.frames, values)
            progress.update(learner.frames, values)
            if time.monotonic() - last_saved > CHECKPOINT_INTERVAL:
                checkpoints.save(learner.updates)
                last_saved = time.monotonic()
            if stop.asked:
                break
    checkpoints.save(learner.updates)
    if stop.asked:
        print(f"stopped after {learner.frames} environment steps per learner", flush=True)


class StopRequest:
    """Within it the first Ctrl-C (or SIGTERM) only sets `asked`; the second Ctrl-C interrupts as usual."""

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> "StopRequest":
        self._before = {kind: signal.signal(kind, self._ask) for kind in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for kind, handler in self._before.items():
            signal.signal(kind, handler)

    def _ask(self, kind: int, frame: FrameType | None) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        # print may be what was interrupted, and does not bear a second call inside the first.
        os.write(STDERR, b"\nfinishing this update; Ctrl-C again aborts\n")


def summary(returns: Tensor) -> str:
    """The final result in one line; over learners, or over episodes if there is one learner.

    Args:
        returns: `[learners, episodes]`.
    """
    learners, episodes = returns.shape
    values = (returns.mean(dim=1) if learners > 1 else returns[0]).cpu().numpy()
    over = f"{learners} learners, {episodes} episodes each" if learners > 1 else f"{episodes} episodes"
    low, high = bootstrap_interval(values)
    return (
        f"final return {values.mean():.2f}, 95 % interval [{low:.2f}, {high:.2f}], "
        f"worst {values.min():.2f}, best {values.max():.2f}, over {over}"
    )


def draw(learner: PolicyGradient, options: RunOptions, folder: RunFolder, best: int) -> None:
    """Draw the learning curve, and the best learner's value function and behaviour."""
    recorded = read_metrics(folder.metrics)
    curve = learning_curve(recorded["frames"][:, 0], recorded["return"], title=options.task)
    save_figure(curve, folder.figures / "learning_curve.png")
    env = make_env(options, num_envs=1, seed=EVALUATION_SEED)
    if env.plane is not None:
        surface = value_on_plane(learner, env.plane, best)
        save_figure(
            value_surface(surface, f"{options.task}, best learner"), folder.figures / "value_surface.png"
        )
    frames = film(env, learner.policy, best, LONGEST_FILM)
    write_video(folder.videos / "best_learner.mp4", frames, round(1 / env.task.control_step))


def value_on_plane(learner: PolicyGradient, plane: envs.Plane, best: int) -> Surface:
    """One learner's posterior of V(s) = Q(s, f(s)) on a grid of the task's picture plane."""
    critic, gp = learner.critic, learner.critic.gp
    learners = len(gp.size)
    x, y = (torch.linspace(low, high, GRID) for low, high in zip(plane.low, plane.high, strict=True))
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2).to(gp.basis.device)
    observations = plane.to_observation(points).float()
    means, variances = [], []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for some in observations.split(POINTS_AT_ONCE):
            states = TensorDict(
                {"observation": some.expand(learners, -1, -1)}, batch_size=(learners, len(some))
            )
            value = critic.value(states["observation"], learner.policy(states)["action"])
            means.append(value.mean[best])
            variances.append(value.variance[best])
    basis = gp.basis[best, : int(gp.size[best])] * critic.input_scale[best] + critic.input_loc[best]
    observed = basis[:, : observations.shape[-1]]
    return Surface(
        x=x.double().numpy(),
        y=y.double().numpy(),
        mean=torch.cat(means).double().cpu().numpy().reshape(GRID, GRID),
        stddev=torch.cat(variances).double().sqrt().cpu().numpy().reshape(GRID, GRID),
        basis=plane.from_observation(observed).double().cpu().numpy(),
        labels=plane.labels,
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
