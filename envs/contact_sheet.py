"""All tasks in one picture: `python -m envs.contact_sheet --out tasks.png`."""

import argparse
import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import envs

COLUMNS = 6
SIZE = 240  # pixels, of each frame's sides
STEPS = 12  # of random actions before the picture is taken


def contact_sheet() -> Image.Image:
    """A frame of every task with its name, after a few random steps."""
    rows = math.ceil(len(envs.ALL) / COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * SIZE, rows * SIZE), "white")
    for place, task in enumerate(envs.ALL):
        env = envs.make(task, seed=1, threads=1)
        env.rollout(STEPS, break_when_any_done=False)
        frame = Image.fromarray(np.asarray(env.render(width=SIZE, height=SIZE)))
        ImageDraw.Draw(frame).text((6, 4), task, fill="black", stroke_width=2, stroke_fill="white")
        sheet.paste(frame, (place % COLUMNS * SIZE, place // COLUMNS * SIZE))
    return sheet


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("tasks.png"), help="where to write the picture")
    path = parser.parse_args().out
    contact_sheet().save(path)
    print(path)
