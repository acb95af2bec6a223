"""Frames to an mp4 file, by the ffmpeg that comes with imageio-ffmpeg (no system package needed)."""

from pathlib import Path

import imageio_ffmpeg
from jaxtyping import UInt8
from torch import Tensor


def write_video(path: Path, frames: UInt8[Tensor, "T H W 3"], frames_per_second: int) -> None:
    """Write frames as H.264, which every browser and player shows.

    Args:
        path: the file, ending in `.mp4`.
        frames: red, green and blue, 0 to 255; at least one frame, height and width even.
        frames_per_second: speed of the film.

    Raises:
        ValueError: if there is no frame or a side is odd (H.264 shares colour between pairs of pixels).
    """
    count, height, width, _ = frames.shape
    if count == 0 or height % 2 or width % 2:
        raise ValueError(
            f"a video needs frames of even height and width; got {count} frames of {height} x {width}"
        )
    writer = imageio_ffmpeg.write_frames(
        str(path),
        size=(width, height),
        fps=frames_per_second,
        codec="libx264",
        quality=8,
        macro_block_size=2,
        ffmpeg_log_level="error",
    )
    writer.send(None)
    for frame in frames.cpu().contiguous():
        writer.send(frame.numpy())
    writer.close()
