"""The command line: options in, a run folder out.

    python train.py                                            policy gradients on the pendulum's swing-up
    python train.py policy-gradient --help                     every option with its unit
    python train.py policy-gradient --task pendulum-explore    another task
    python train.py --config FILE --learners 20                a run's config.yaml or your own; options win
    python train.py --resume RUN                               go on where a run was stopped or killed
    python train.py evaluate RUN                               returns without exploration
    python train.py render RUN                                 a film of a learner
    python train.py plot RUN RUN ...                           learning curves in one picture
    python train.py report RUN                                 draw a run again, on one page
    python train.py tasks                                      what can be learned

Ctrl-C ends a run early and keeps what was learned; a second Ctrl-C aborts at once.
"""

import contextlib
import functools
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torchrl import logger as torchrl_logger

import envs
from torch_gprl.critics import GPActionValue, graph_edges
from torch_gprl.learners import (
    ActorCritic,
    ActorCriticConfig,
    DynamicProgramming,
    DynamicProgrammingConfig,
    PolicyGradient,
    PolicyGradientConfig,
    QLearning,
    QLearningConfig,
    RayCollection,
    WorkerCollection,
)
from torch_gprl.runs import (
    Algorithm,
    Checkpoints,
    CommandLine,
    MetricsWriter,
    Progress,
    RunFailure,
    RunFolder,
    StopRequest,
    UserError,
    check_device,
    check_logger,
    compare_curves,
    evaluate,
    failures_of,
    film,
    foresee,
    foresight_figure,
    learning_curve,
    mistakes_of_the_user,
    read_metrics,
    save_figure,
    save_graph,
    summary,
    tell,
    unread_output_allowed,
    value_on_plane,
    value_surface,
    write_report,
    write_video,
)
from torch_gprl.runs.command_options import (
    EVALUATION_SEED,
    ARun,
    EvaluateOptions,
    PlotOptions,
    RenderOptions,
    ReportOptions,
    ResumeOptions,
    RunOptions,
    TasksOptions,
)

LONGEST_FILM = 300  # frames
JUDGED_EPISODES = 5  # over which a critic's foresight is shown
WORKER_STRIDE = 7_368_787  # keeps the seeds of workers apart; a prime above any count of runs
PICTURES = Path(__file__).parent / "docs" / "tasks.jpg"


class Options(Protocol):
    """What an algorithm is started with."""

    run: RunOptions
    algorithm: Any  # the numbers of the algorithm


# A critic of all experience, and ten steps of the policy by it for every 200 of the environments.
ALL_ACTION_REPLAY: dict[str, object] = {
    "total_frames": 13_000,
    "rollout_steps": 40,
    "discount": 0.95,
    "estimator": "all-action",
    "targets": "differences",
    "exploration": "fixed",
    "replay": 13_000,
    "solved": 3_000,
    "improvements": 10,
    "average_over": 10,
    "budget": 300,
    "damping": 0.05,
    "noise": 0.03,
    "lengthscale": 0.5,
}
# The same from whole rollouts, where values are rougher: a basis vector for every five steps that are solved,
# and a noise that keeps them from being learned by heart.
ALL_EXPERIENCE: dict[str, object] = {
    "total_frames": 12_000,
    "estimator": "all-action",
    "targets": "differences",
    "replay": 12_000,
    "solved": 3_000,
    "budget": 600,
    "improvements": 4,
    "damping": 0.05,
    "noise": 0.1,
    "lengthscale": 0.5,
}
# A rollout holds whole episodes, and values look ahead as far as the task's steps are short.
POLICY_GRADIENT_PRESETS: dict[str, dict[str, object]] = {
    "Pendulum-v1": ALL_ACTION_REPLAY,
    "pendulum-explore": {"discount": 0.97},
    "atwood": ALL_EXPERIENCE,
    "cartpole-balance": ALL_EXPERIENCE | {"rollout_steps": 500, "discount": 0.99},
    "cartpole-swingup": {"rollout_steps": 250, "total_frames": 300_000},
    "InvertedPendulum-v5": {"rollout_steps": 1000, "discount": 0.99},
    "HalfCheetah-v5": {"rollout_steps": 1000, "total_frames": 1_000_000, "discount": 0.99},
}
ALONE = RunOptions(num_envs=1)  # for learners that count every step
ALGORITHMS = {
    "policy-gradient": Algorithm.offered(
        PolicyGradient, RunOptions(), PolicyGradientConfig(), POLICY_GRADIENT_PRESETS
    ),
    "q-learning": Algorithm.offered(QLearning, ALONE, QLearningConfig()),
    "actor-critic": Algorithm.offered(ActorCritic, ALONE, ActorCriticConfig()),
    "dynamic-programming": Algorithm.offered(DynamicProgramming, ALONE, DynamicProgrammingConfig()),
}
Learner = PolicyGradient | QLearning | ActorCritic | DynamicProgramming


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit code: 0, 1 for a failed run, 2 for an error of the user, 130."""
    torchrl_logger.setLevel("WARNING")  # it tells of buffers on standard output
    try:
        with unread_output_allowed():
            name, options = parse(arguments)
            if name in ALGORITHMS:
                start(name, options)
            else:
                _, command = COMMANDS[name]
                command(options)
    except (UserError, RunFailure) as error:
        print(f"train.py: {error}", file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    except KeyboardInterrupt:
        print("train.py: aborted", file=sys.stderr)
        return 130
    return 0


def parse(arguments: list[str]) -> tuple[str, Any]:
    """The name of an algorithm or a command, and its options."""
    return COMMAND_LINE.parse(arguments)


def start(name: str, options: Options) -> None:
    """Train, evaluate, and leave everything in a new run folder."""
    check_logger(options.run.logger)
    learner = build(name, options)
    share_out(learner, options.run)
    folder = RunFolder(options.run.out) if options.run.out else RunFolder.named(options.run.task, name)
    folder.write_config({"algorithm": name, "run": options.run, "config": options.algorithm})
    tell(f"{name} on {options.run.task}: {options.run.learners} learners, results in {folder.path}")
    with failures_of(learner, folder):
        learn(learner, options.run, folder)
        conclude(learner, options.run, folder)


def resume(options: ResumeOptions) -> None:
    """Take up a run from its checkpoint, or from its start if it has none yet."""
    run = opened(options, trains=True)
    check_logger(run.options.logger)
    tell(f"going on after update {run.learner.updates} in {run.folder.path}")
    with failures_of(run.learner, run.folder):
        learn(run.learner, run.options, run.folder, resumed=True)
        conclude(run.learner, run.options, run.folder)


class Opened(NamedTuple):
    """A run that was started earlier, as it stands at a checkpoint."""

    folder: RunFolder
    options: RunOptions
    learner: Learner


def opened(run: ARun, trains: bool = False) -> Opened:
    """The run of a folder, at an update or as late as there is a checkpoint."""
    folder = RunFolder.opened(run.folder)
    name, settings = COMMAND_LINE.settings_of(folder.config)
    options = parse([name, *settings])[1]
    learner = build(name, options)
    if trains:
        share_out(learner, options.run)
    checkpoints = Checkpoints(folder.checkpoints, learner=learner)
    file = checkpoints.latest() if run.checkpoint is None else checkpoints.at(run.checkpoint)
    if file is not None:
        checkpoints.load(file)
    return Opened(folder, options.run, learner)


def build(name: str, options: Options) -> Learner:
    """The learner with its environment, at the start of a run."""
    check_device(options.run.device)
    torch.set_num_threads(options.run.threads)
    torch.manual_seed(options.run.seed)
    env = make_env(options.run, options.run.num_envs, options.run.seed)
    with mistakes_of_the_user():
        learner = ALGORITHMS[name].learner(env, options.algorithm, seed=options.run.seed)
    if options.run.replay_storage == "disk" and learner.experience is None:
        raise UserError("this learner uses each rollout once and keeps none: leave --replay-storage out")
    return learner


def make_env(options: RunOptions, num_envs: int, seed: int) -> Any:  # noqa: ANN401  (TorchRL's EnvBase and more)
    """The task's environment of batch `[learners, num_envs]`."""
    with mistakes_of_the_user():
        return envs.make(
            options.task,
            learners=options.learners,
            num_envs=num_envs,
            seed=seed,
            device=options.device,
            threads=options.threads,
        )


def learn(learner: Learner, options: RunOptions, folder: RunFolder, resumed: bool = False) -> None:
    """Train to the end or to the first Ctrl-C, recording every update."""
    if options.replay_storage == "disk" and learner.experience is not None:
        learner.experience.keep_in(folder.experience)
    checkpoints = Checkpoints(folder.checkpoints, learner=learner)
    after = learner.updates if resumed else None
    metrics = MetricsWriter(folder.metrics, folder.curves(options.logger), options.logger, after)
    title = f"{options.task}, {options.learners} learners"
    saved = -math.inf  # s; the first update is saved, so that a failure leaves something to go on from
    with (
        contextlib.closing(metrics),
        contextlib.closing(learner.collection),
        StopRequest() as stop,
        Progress(learner.config.total_frames, title, before=learner.frames) as progress,
    ):
        for values in learner.train():
            metrics.write(learner.updates, learner.frames, values)
            progress.update(learner.frames, values)
            if time.monotonic() - saved > options.checkpoint_interval:
                metrics.sync()
                checkpoints.save(learner.updates)
                saved = time.monotonic()
            if stop.asked:
                break
        checkpoints.save(learner.updates)
    if stop.asked:
        tell(f"stopped after {learner.frames} environment steps per learner")


def share_out(learner: Learner, options: RunOptions) -> None:
    """Let the learner's experience come from as many processes as asked for, once it begins to train."""
    if not options.workers:
        return
    if not isinstance(learner.critic, torch.nn.Module):
        raise UserError("this learner's plan does not travel to other processes; leave --workers out")
    alone = options.collector == "multi-async"  # each worker makes whole rollouts
    share = options.num_envs if alone else options.num_envs // options.workers
    seeds = [options.seed + WORKER_STRIDE * worker for worker in range(options.workers)]
    factories = [functools.partial(make_env, options, share, seed) for seed in seeds]
    given = factories, learner.policy, learner.config.rollout_steps, learner.critic
    with mistakes_of_the_user():
        if options.collector == "ray":
            paths = {"env_vars": {"PYTHONPATH": str(Path(__file__).parent)}}  # where workers find `envs`
            workers = RayCollection(*given, ray_options={"runtime_env": paths})
        else:
            workers = WorkerCollection(*given, asynchronous=alone)
    learner.collection = workers  # pyright: ignore[reportAttributeAccessIssue]


def conclude(learner: Learner, options: RunOptions, folder: RunFolder) -> None:
    """Evaluate what was learned, draw it, and put it all on one page."""
    returns = evaluate(make_env(options, options.evaluation_episodes, EVALUATION_SEED), learner.policy)
    folder.write_evaluation(returns)
    tell(summary(returns))
    draw(learner, options, folder, best=int(returns.mean(dim=1).argmax()))
    write_report(folder)
    tell(f"everything is in {folder.path}")


def draw(learner: Learner, options: RunOptions, folder: RunFolder, best: int) -> None:
    """Draw the learning curve, and the best learner's value function, foresight and behaviour."""
    recorded = read_metrics(folder.metrics)
    curve = learning_curve(recorded["frames"][:, 0], recorded["return"], title=options.task)
    save_figure(curve, folder.figures / "learning_curve.png")
    env = make_env(options, num_envs=1, seed=EVALUATION_SEED)
    critic, title = learner.critic, f"{options.task}, best learner"
    judges = hasattr(critic, "basis_points")  # a neural critic has no opinion of its own errors
    if env.plane is not None and judges:
        surface = value_on_plane(critic, learner.policy, env.plane, best, options.learners)
        save_figure(value_surface(surface, title), folder.figures / "value_surface.png")
        if isinstance(critic, GPActionValue):
            save_graph(graph_edges(critic, best), surface, env.plane, folder.figures / "graph.png", title)
    if judges:
        starts = make_env(options, JUDGED_EPISODES, EVALUATION_SEED)
        foresight = foresee(starts, learner.policy, critic, learner.config.discount, best)
        save_figure(foresight_figure(foresight, title), folder.figures / "foresight.png")
    frames = film(env, learner.policy, best, LONGEST_FILM)
    write_video(folder.videos / "best_learner.mp4", frames, round(1 / env.task.control_step))


def evaluate_run(options: EvaluateOptions) -> None:
    """Print the returns of every learner, and the summary."""
    run = opened(options)
    returns = evaluate(make_env(run.options, options.episodes, options.seed), run.learner.policy)
    for learner, value in enumerate(returns.mean(dim=1).tolist()):
        tell(f"learner {learner}: mean return {value:.2f}")
    tell(f"after update {run.learner.updates}: {summary(returns)}")


def render(options: RenderOptions) -> None:
    """Write a film of one learner."""
    run = opened(options)
    learner = options.learner
    if learner is None:
        returns = evaluate(make_env(run.options, 20, EVALUATION_SEED), run.learner.policy)
        learner = int(returns.mean(dim=1).argmax())
    if not 0 <= learner < run.options.learners:
        raise UserError(f"learner must lie between 0 and {run.options.learners - 1}, but is {learner}")
    path = options.out or run.folder.videos / f"learner-{learner}.mp4"
    env = make_env(run.options, num_envs=1, seed=options.seed)
    write_video(path, film(env, run.learner.policy, learner, LONGEST_FILM), round(1 / env.task.control_step))
    tell(path)


def plot(options: PlotOptions) -> None:
    """Draw the learning curves of several runs into one picture."""
    if not options.folders:
        raise UserError("plot needs the folder of a run, or of several")
    curves, names = {}, [path.name for path in options.folders]
    for path in options.folders:
        recorded = read_metrics(RunFolder.opened(path).metrics)
        if options.metric not in recorded:
            raise UserError(f"{path} has no metric '{options.metric}'; choose one of {', '.join(recorded)}")
        name = path.name if names.count(path.name) == 1 else str(path)
        curves[name] = recorded["frames"][:, 0], recorded[options.metric]
    save_figure(compare_curves(curves, options.metric), options.out)
    tell(options.out)


def report(options: ReportOptions) -> None:
    """Evaluate and draw a run again."""
    run = opened(options)
    conclude(run.learner, run.options, run.folder)


def list_tasks(options: TasksOptions) -> None:
    """Print the tasks, a line each, and where they are pictured."""
    for task in envs.ALL.values():
        about = (type(task).__doc__ or "").splitlines()[0]
        tell(f"{task.id:26s}{about} {task.horizon} steps of {task.control_step:g} s")
    tell(f"pictures: {PICTURES}")


COMMANDS: dict[str, tuple[type, Callable[[Any], None]]] = {
    "resume": (ResumeOptions, resume),
    "evaluate": (EvaluateOptions, evaluate_run),
    "render": (RenderOptions, render),
    "plot": (PlotOptions, plot),
    "report": (ReportOptions, report),
    "tasks": (TasksOptions, list_tasks),
}
COMMAND_LINE = CommandLine(
    __doc__ or "", ALGORITHMS, {name: options for name, (options, _) in COMMANDS.items()}
)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
