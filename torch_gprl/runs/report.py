"""A run on one page that needs nothing else: pictures, film and numbers inside one HTML file.

Everything is read from the run's folder; what is missing there is left out of the page.
"""

import base64
import csv
from html import escape
from pathlib import Path

import numpy as np
import yaml
from matplotlib.figure import Figure

from torch_gprl.runs.errors import UserError
from torch_gprl.runs.figures import metric_panels, save_figure
from torch_gprl.runs.folder import RunFolder
from torch_gprl.runs.intervals import bootstrap_interval
from torch_gprl.runs.metrics import read_metrics

PICTURES = {
    "learning_curve.png": ("Learning curve", "Return per episode of exploring policies against experience."),
    "value_surface.png": (
        "Value, uncertainty, basis",
        "The best learner's V(s) = Q(s, f(s)) over a plane of states: posterior mean, standard deviation, "
        "and the basis vectors (circles) that carry both.",
    ),
    "graph.png": ("Graph", "The experience that the critic's kernel measures distances on."),
    "foresight.png": (
        "Calibration",
        "The best learner's predictions along evaluation episodes against the discounted returns that came, "
        "and how often intervals of a given probability held them.",
    ),
    "metrics.png": ("Metrics", "Mean over learners, and the range from the worst to the best."),
}
FILM = "best_learner.mp4"
# Nothing is fetched and nothing runs, whatever the texts of a run hold.
POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
STYLE = """
:root { color-scheme: light dark; --back: #fff; --text: #1c2126; --faint: #5b6670; --line: #d8dee4;
        --card: #f5f7f9; }
@media (prefers-color-scheme: dark) {
  :root { --back: #14181c; --text: #e3e8ec; --faint: #98a4af; --line: #323a42; --card: #1d2329; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 60rem; background: var(--back); color: var(--text);
       font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; margin: 0 0 .25rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .25rem; }
p { margin: .25rem 0 .75rem; color: var(--faint); }
dl.headline { display: grid; grid-template-columns: repeat(auto-fit, minmax(8.5rem, 1fr)); gap: .6rem; }
dl.headline div { background: var(--card); border: 1px solid var(--line); border-radius: .5rem;
                  padding: .6rem .8rem; }
dt { color: var(--faint); font-size: .85rem; } dd { margin: 0; font-size: 1.15rem; font-weight: 600; }
img, video { display: block; width: 100%; height: auto; border: 1px solid var(--line); border-radius: .5rem;
             background: #fff; }
img.small, video { max-width: 36rem; }
.wide { overflow-x: auto; } .wide img { min-width: 38rem; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; }
td { border-top: 1px solid var(--line); padding: .2rem .8rem .2rem 0; vertical-align: top; }
td:first-child { color: var(--faint); width: 13rem; } summary { cursor: pointer; font-weight: 600; }
@media (max-width: 30rem) { td:first-child { width: 45%; } }
"""


def write_report(folder: RunFolder) -> None:
    """Write `report.html` from what the folder holds.

    Raises:
        UserError: if the folder's config or metrics cannot be read.
    """
    config = _config(folder)
    save_figure(_metrics_figure(folder), folder.figures / "metrics.png")
    title = f"{config.get('algorithm', 'run')} on {_section(config, 'run').get('task', '?')}"
    parts = [
        f"<h1>{escape(str(title))}</h1><p>{escape(str(folder.path))}, started "
        f"{escape(str(config.get('started', '?')))}</p>",
        _headline(folder),
        *(_picture(folder.figures / name, *about) for name, about in PICTURES.items()),
        _film(folder.videos / FILM),
        _tables(config),
    ]
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(str(title))}</title><style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )
    unfinished = folder.report.with_suffix(".part")
    unfinished.write_text(page, encoding="utf-8")
    unfinished.replace(folder.report)


def _config(folder: RunFolder) -> dict[str, object]:
    try:
        config = yaml.safe_load(folder.config.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise UserError(f"cannot read {folder.config}: {' '.join(str(error).split())}") from error
    if not isinstance(config, dict):
        raise UserError(f"{folder.config} holds no options")
    return config


def _section(config: dict[str, object], name: str) -> dict[str, object]:
    section = config.get(name)
    return section if isinstance(section, dict) else {}


def _headline(folder: RunFolder) -> str:
    """The few numbers that matter most."""
    recorded = read_metrics(folder.metrics)
    facts = {
        "learners": f"{recorded['return'].shape[1]}",
        "environment steps, each": f"{int(recorded['frames'][-1, 0]):,}" if len(recorded["frames"]) else "0",
    }
    returns = _evaluation(folder.path / "evaluation.csv")
    if returns is not None:
        values = returns if len(returns) > 1 else returns[0]
        means = np.array([np.mean(value) for value in values])
        low, high = bootstrap_interval(means)
        facts = {
            "final return": f"{means.mean():.2f}",
            "95 % interval": f"{low:.2f} to {high:.2f}",
            "worst, best": f"{means.min():.2f}, {means.max():.2f}",
        } | facts
    items = (f"<div><dt>{escape(name)}</dt><dd>{escape(fact)}</dd></div>" for name, fact in facts.items())
    return f'<dl class="headline">{"".join(items)}</dl>'


def _evaluation(path: Path) -> list[list[float]] | None:
    """Returns of the final evaluation, learner by learner."""
    if not path.exists():
        return None
    returns: dict[str, list[float]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            returns.setdefault(row["learner"], []).append(float(row["return"]))
    return list(returns.values()) or None


def _metrics_figure(folder: RunFolder) -> Figure:
    recorded = read_metrics(folder.metrics)
    frames = recorded["frames"][:, 0]
    shown = {name: values for name, values in recorded.items() if name not in ("update", "frames", "return")}
    return metric_panels(frames, shown)


def _picture(path: Path, name: str, about: str) -> str:
    if not path.exists():
        return ""
    small = path.stem in ("learning_curve", "graph")
    kind = ' class="small"' if small else ""
    image = f'<img{kind} alt="{escape(name)}" src="{_data(path, "image/png")}">'
    # Several panels side by side are scrolled on a narrow screen, or nobody could read them.
    shown = image if small else f'<div class="wide">{image}</div>'
    return f"<h2>{escape(name)}</h2><p>{escape(about)}</p>{shown}"


def _film(path: Path) -> str:
    if not path.exists():
        return ""
    return (
        "<h2>Behaviour</h2><p>The best learner without exploration.</p>"
        f'<video controls muted loop playsinline src="{_data(path, "video/mp4")}"></video>'
    )


def _data(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _tables(config: dict[str, object]) -> str:
    """Every option, then what else it takes to repeat the run."""
    options = _section(config, "run") | _section(config, "config")
    record = {name: config[name] for name in ("command", "git_commit") if name in config}
    record |= _section(config, "versions")
    return (
        f"<h2>Options</h2>{_table(options)}"
        f"<h2>Provenance</h2><details><summary>command, commit, versions</summary>{_table(record)}</details>"
    )


def _table(rows: dict[str, object]) -> str:
    cells = (
        f"<tr><td>{escape(str(name))}</td><td>{escape(str(value))}</td></tr>" for name, value in rows.items()
    )
    return f"<table>{''.join(cells)}</table>"
