"""Frames to an mp4 file, by the ffmpeg that comes with imageio-ffmpeg (no system package needed)."""

import subprocess
from pathlib import Path

import imageio_ffmpeg
from jaxtyping import UInt8
from torch import Tensor

QUALITY = 20  # constant rate factor of H.264: 0 is lossless, 51 the worst


def write_video(path: Path, frames: UInt8[Tensor, "T H W 3"], frames_per_second: float) -> None:
    """Write frames as H.264, which every browser and player shows.

    Args:
        path: the file, ending in `.mp4`; an old one is replaced.
        frames: red, green and blue, 0 to 255; at least one frame, height and width even.
        frames_per_second: speed of the film.

    Raises:
        ValueError: if there is no frame or a side is odd (H.264 shares colour between pairs of pixels).
        RuntimeError: if ffmpeg fails; the message is its own.
    """
    count, height, width, _ = frames.shape
    if count == 0 or height % 2 or width % 2:
        raise ValueError(
            f"a video needs frames of even height and width; got {count} frames of {height} x {width}"
        )
    raw = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {frames_per_second} -i -".split()
    coded = f"-c:v libx264 -crf {QUALITY} -pix_fmt yuv420p -movflags +faststart".split()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *raw, *coded, str(path)]
    done = subprocess.run(command, input=frames.cpu().contiguous().numpy().tobytes(), capture_output=True)
    if done.returncode:
        raise RuntimeError(f"ffmpeg could not write {path}: {done.stderr.decode(errors='replace').strip()}")
