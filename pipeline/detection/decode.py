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
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


def decode_grey(data: bytes, encoding: str, width: int = 0, height: int = 0) -> np.ndarray:
    """Grey values of a picture.

    Parameters
    ----------
    data : bytes
        JPEG or PNG, or for ``raw`` height x width grey values.
    encoding : str
        ``jpeg``, ``png`` or ``raw``.
    width, height : int
        Pixels, of a raw picture.

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
            return simplejpeg.decode_jpeg(data, colorspace="GRAY", strict=True)[..., 0]
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
