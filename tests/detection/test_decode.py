import cv2
import numpy as np
import pytest
import simplejpeg

from pipeline.detection.decode import Pictures, decode_grey, picture_size
from pipeline.errors import DetectionError

GREY = np.add.outer(np.arange(48), 2 * np.arange(64)).astype(np.uint8)
JPEG = simplejpeg.encode_jpeg(GREY[..., None], quality=98, colorspace="GRAY")
PNG = cv2.imencode(".png", GREY)[1].tobytes()


def test_every_encoding_gives_the_picture_upright():
    assert np.abs(decode_grey(JPEG, "jpeg").astype(int) - GREY).max() <= 6
    assert np.array_equal(decode_grey(PNG, "png"), GREY)
    assert np.array_equal(decode_grey(GREY.tobytes(), "raw", 64, 48), GREY)


def test_pictures_of_a_span_have_memory_of_their_own_and_those_of_the_next_have_it_again():
    other = simplejpeg.encode_jpeg(255 - GREY[..., None], quality=98, colorspace="GRAY")
    room = Pictures()
    first, second = (decode_grey(data, "jpeg", room=room) for data in (JPEG, other))
    assert np.array_equal(first, decode_grey(JPEG, "jpeg")) and np.array_equal(
        second, decode_grey(other, "jpeg")
    )
    room.begin()
    again = decode_grey(other, "jpeg", room=room)
    assert np.shares_memory(again, first) and np.array_equal(again, second)
    wide = decode_grey(simplejpeg.encode_jpeg(GREY.T.copy()[..., None], colorspace="GRAY"), "jpeg", room=room)
    assert wide.shape == GREY.T.shape and np.array_equal(again, second)


def test_colour_jpeg_gives_its_luma():
    colour = np.stack([GREY, 255 - GREY, GREY // 2], axis=-1)
    data = simplejpeg.encode_jpeg(colour, quality=98)
    expected = colour @ [0.299, 0.587, 0.114]
    assert np.abs(decode_grey(data, "jpeg") - expected).mean() < 1.5


@pytest.mark.parametrize("data, encoding", [(JPEG, "jpeg"), (PNG, "png"), (GREY.tobytes(), "raw")])
def test_the_size_is_known_before_decoding(data, encoding):
    size = (64, 48) if encoding == "raw" else (0, 0)
    assert picture_size(data, encoding, *size) == (64, 48)


@pytest.mark.parametrize(
    "data, encoding",
    [
        (JPEG[: len(JPEG) // 2], "jpeg"),
        (b"\xff\xd8" + bytes(100), "jpeg"),
        (b"", "jpeg"),
        (PNG[: len(PNG) // 2], "png"),
        (b"", "png"),
        (GREY.tobytes()[:-1], "raw"),
    ],
)
def test_a_corrupt_picture_is_refused_and_never_half_decoded(data, encoding):
    with pytest.raises(DetectionError, match="corrupt"):
        decode_grey(data, encoding, 64, 48)


def test_a_picture_of_absurd_size_is_refused_before_memory_is_taken():
    huge = bytearray(PNG)
    huge[16:24] = (60_000).to_bytes(4, "big") * 2
    with pytest.raises(DetectionError, match="60000 x 60000"):
        decode_grey(bytes(huge), "png")
