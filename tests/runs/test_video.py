"""Films: an mp4 that decodes to the frames that went in."""

import subprocess

import imageio_ffmpeg
import pytest
import torch

from torch_gprl.runs import write_video


def test_a_film_decodes_to_its_frames(tmp_path):
    brightness = torch.tensor([0, 60, 120, 180, 240], dtype=torch.uint8)
    frames = brightness[:, None, None, None].expand(5, 50, 66, 3)
    path = tmp_path / "film.mp4"
    write_video(path, frames, frames_per_second=20)

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True)
    decoded = torch.frombuffer(bytearray(raw.stdout), dtype=torch.uint8).reshape(5, 50, 66, 3).double()
    assert (decoded - frames.double()).abs().max() < 5
    assert b"h264" in raw.stderr
    assert b"20 fps" in raw.stderr


@pytest.mark.parametrize("shape", [(0, 32, 32, 3), (2, 31, 32, 3), (2, 32, 31, 3)])
def test_frames_that_cannot_be_a_film_are_refused(tmp_path, shape):
    with pytest.raises(ValueError, match="even height and width"):
        write_video(tmp_path / "film.mp4", torch.zeros(shape, dtype=torch.uint8), frames_per_second=20)


def test_a_failure_of_ffmpeg_is_told(tmp_path):
    with pytest.raises(RuntimeError, match=r"could not write .*: .*No such file or directory"):
        write_video(tmp_path / "no" / "film.mp4", torch.zeros(2, 32, 32, 3, dtype=torch.uint8), 20)
