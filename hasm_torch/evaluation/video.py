"""Videos of rollouts, H.264 by PyAV."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]


def caption(frame: Frame, text: str) -> Frame:
    """Write a line of text into the lower left corner of a picture.

    Args:
        frame: (H, W, 3) uint8.
        text: The line.

    Returns:
        (H, W, 3) uint8, a new picture.
    """
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=18)
    left, top, right, bottom = draw.textbbox((12, frame.shape[0] - 34), text, font=font)
    draw.rectangle((left - 6, top - 4, right + 6, bottom + 4), fill=(20, 20, 20))
    draw.text((12, frame.shape[0] - 34), text, font=font, fill=(255, 255, 255))
    return np.asarray(image)


def write_video(path: Path, frames: list[Frame], rate: int) -> None:
    """Write pictures as an H.264 video.

    Args:
        path: MP4 to write.
        frames: (H, W, 3) uint8 each, H and W even.
        rate: Pictures a second.

    Raises:
        ValueError: If there is no picture.
    """
    import av

    if not frames:
        raise ValueError(f"no picture to write into {path}")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "24", "preset": "veryfast"}
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
