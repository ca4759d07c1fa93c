"""Pictures -> grey values.

JPEG goes straight to its luma plane with simplejpeg (half the time of decoding to colour and converting); OpenCV
reads PNG. A picture says how large it will be before anything is allocated.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np
import simplejpeg

from pipeline.errors import DetectionError

MAX_PIXELS = 100_000_000
BLOCK_BYTES = 32_000_000
"""Of pictures whose memory is asked for at once."""
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


class Pictures:
    """Memory for the pictures of a span, used again for those of the next.

    What is fresh from the system is cleared page by page first: 0.4 ms for a picture of 1280x960 that takes 2.4 ms to
    decode. Pictures lie in blocks, for which numpy asks for large pages: decoding into them takes a tenth less than
    into pictures that lie apart.
    """

    def __init__(self) -> None:
        self._blocks: list[np.ndarray] = []
        self._taken = 0

    def begin(self) -> None:
        """What was taken so far is no longer needed."""
        self._taken = 0

    def take(self, width: int, height: int) -> np.ndarray:
        """Room for a picture, (H, W) uint8 of any values."""
        each = max(BLOCK_BYTES // (width * height), 1)
        if self._blocks and self._blocks[0].shape != (each, height, width):
            self._blocks, self._taken = [], 0
        block, place = divmod(self._taken, each)
        if block == len(self._blocks):
            self._blocks.append(np.empty((each, height, width), np.uint8))
        self._taken += 1
        return self._blocks[block][place]


def decode_grey(
    data: bytes, encoding: str, width: int = 0, height: int = 0, room: Pictures | None = None
) -> np.ndarray:
    """Grey values of a picture.

    Parameters
    ----------
    data : bytes
        JPEG or PNG, or for ``raw`` height x width grey values.
    encoding : str
        ``jpeg``, ``png`` or ``raw``.
    width, height : int
        Pixels, of a raw picture.
    room : Pictures, optional
        Where a JPEG picture is put; without it, or of another encoding, memory of its own.

    Returns
    -------
    (H, W) uint8 array

    Raises
    ------
    DetectionError
        The picture is corrupt, cut off or of an absurd size.
    """
    size = picture_size(data, encoding, width, height)
    try:
        if encoding == "jpeg":
            buffer = None if room is None else room.take(*size)
            return simplejpeg.decode_jpeg(data, colorspace="GRAY", buffer=buffer, strict=True)[..., 0]
        if encoding == "png":
            # Orientation marks are for viewers: calibration and search both speak of pixels as stored.
            flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
            grey = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
            if grey is None or grey.shape != size[::-1]:
                raise DetectionError("corrupt PNG picture")
            return grey
    except (ValueError, cv2.error) as error:
        raise DetectionError(f"corrupt {encoding.upper()} picture ({str(error).strip()[:80]})") from None
    return np.frombuffer(data, np.uint8).reshape(height, width)


def picture_size(data: bytes, encoding: str, width: int = 0, height: int = 0) -> tuple[int, int]:
    """(width, height) of a picture in pixels, from its head; raises DetectionError as `decode_grey` does."""
    if encoding == "jpeg":
        try:
            height, width, _, _ = simplejpeg.decode_jpeg_header(data)
        except ValueError as error:
            raise DetectionError(f"corrupt JPEG picture ({str(error).strip()[:80]})") from None
    elif encoding == "png":
        if not data.startswith(PNG_MAGIC) or len(data) < 24:
            raise DetectionError("corrupt PNG picture (no header)")
        width, height = struct.unpack(">II", data[16:24])
    else:
        assert encoding == "raw", encoding
        if len(data) != width * height:
            raise DetectionError(f"corrupt raw picture ({len(data)} bytes for {width} x {height})")
    if not 0 < width * height <= MAX_PIXELS:
        raise DetectionError(f"a picture of {width} x {height} pixels; at most {MAX_PIXELS:,} are decoded")
    return width, height
