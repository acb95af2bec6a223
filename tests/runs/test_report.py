"""The report: one page that holds all, fetches nothing, and fits a telephone; looked at by a real browser."""

import html
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch

from torch_gprl.runs import MetricsWriter, RunFolder, UserError, learning_curve, save_figure, write_report
from torch_gprl.runs.video import write_video

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
HOSTILE = '<script>document.title="run"</script><img src=x onerror=alert(1)>'
PHONE = 390  # width in pixels
# What the page says of itself once it is shown: sizes, pictures, film, colours.
PROBE = """
<script>onload = () => {
  const page = document.querySelector('iframe').contentDocument, root = page.documentElement;
  const film = page.querySelector('video');
  const told = JSON.stringify({
    width: root.scrollWidth, pictures: [...page.images].map(i => i.naturalWidth > 100 && i.width > 300),
    film: film.error === null && film.readyState > 0 && film.videoWidth,
    title: page.title, back: getComputedStyle(page.body).backgroundColor,
    scripts: page.scripts.length, options: page.querySelectorAll('td').length});
  document.body.replaceChildren(Object.assign(document.createElement('pre'), {textContent: told}));
}</script>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> RunFolder:
    """A run's folder with everything in it, and a name that would be markup."""
    folder = RunFolder(tmp_path_factory.mktemp("report") / "run")
    config = {"algorithm": "policy-gradient", "run": {"task": HOSTILE}, "config": {"budget": 20}}
    folder.write_config({**config, "long": "x" * 300})
    writer = MetricsWriter(folder.metrics, folder.curves("csv"), "csv")
    for update in (1, 2, 3):
        values = torch.arange(2.0) * update
        writer.write(update, 100 * update, {"return": values, "basis_size": values, "value_error": values})
    writer.close()
    folder.write_evaluation(torch.tensor([[1.0, 3.0], [5.0, 7.0]]))
    frames = np.array([100, 200, 300])
    for name in ("learning_curve", "value_surface", "foresight"):
        save_figure(learning_curve(frames, np.ones((3, 2))), folder.figures / f"{name}.png")
    write_video(folder.videos / "best_learner.mp4", torch.zeros(4, 64, 64, 3, dtype=torch.uint8), 10)
    write_report(folder)
    return folder


def test_the_page_holds_the_result_the_pictures_and_the_options(folder):
    page = folder.report.read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 4
    assert page.count('src="data:video/mp4;base64,') == 1
    assert "<dt>final return</dt><dd>4.00</dd>" in page
    assert "<dt>worst, best</dt><dd>2.00, 6.00</dd>" in page
    assert "<td>budget</td><td>20</td>" in page


def test_nothing_is_fetched_and_no_text_becomes_markup(folder):
    page = folder.report.read_text(encoding="utf-8")
    assert "<script" not in page
    assert html.escape(HOSTILE) in page
    links = re.findall(
        r"""(?:src|href)\s*=\s*["']?([^"'>\s]{0,12})|url\(|@import""", page.replace(html.escape(HOSTILE), "")
    )
    assert {link.split(":")[0] for link in links} == {"data"}


def test_what_is_missing_is_left_out(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.write_config({"algorithm": "q-learning", "run": {"task": "walk"}})
    writer = MetricsWriter(folder.metrics, folder.curves("csv"), "csv")
    writer.write(1, 50, {"return": torch.tensor([float("nan")]), "value": torch.tensor([1.0])})
    writer.close()
    write_report(folder)
    page = folder.report.read_text(encoding="utf-8")
    assert "<title>q-learning on walk</title>" in page
    assert "final return" not in page
    assert "<video" not in page
    assert page.count("<img") == 1  # the metrics


@pytest.mark.parametrize("content", ["- 1", "a: [", "\x00"])
def test_a_config_that_cannot_be_read_is_named(tmp_path, content):
    folder = RunFolder(tmp_path / "run")
    folder.config.write_text(content, encoding="utf-8")
    with pytest.raises(UserError, match=r"config\.yaml"):
        write_report(folder)


@pytest.mark.skipif(BROWSER is None, reason=f"no browser here: none of {', '.join(BROWSERS)}")
@pytest.mark.parametrize("dark", [False, True])
def test_a_browser_shows_all_of_it_on_a_telephone(folder, tmp_path, dark):
    """The page in a frame as wide as a telephone: nothing sticks out, all pictures and the film are shown."""
    page = folder.report.read_text(encoding="utf-8")
    frame = f'<iframe width="{PHONE}" height="800" srcdoc="{html.escape(page)}"></iframe>{PROBE}'
    (tmp_path / "probe.html").write_text(f"<!doctype html><body>{frame}</body>", encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    options += ["--force-dark-mode"] if dark else []
    command = [str(BROWSER), *options, "--dump-dom", (tmp_path / "probe.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    found = json.loads(html.unescape(re.findall("<pre>(.*)</pre>", shown)[0]))
    assert found["width"] <= PHONE
    assert found["pictures"] == [True] * 4
    assert found["film"] == 64
    assert found["title"] == f"policy-gradient on {HOSTILE}"
    assert found["scripts"] == 0
    assert found["options"] >= 4
    assert found["back"] == ("rgb(20, 24, 28)" if dark else "rgb(255, 255, 255)")
