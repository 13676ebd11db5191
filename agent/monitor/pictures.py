"""What a picture says of itself in its first bytes: PNG or JPEG, and its size. Nothing is decoded here.

PNG: "Portable Network Graphics (PNG) Specification", third edition, W3C, sections 5.2, 5.3 and 11.2.1. JPEG: ITU-T
T.81, annex B.1.1 and B.2. The browser of each viewer decodes the picture, so the number of points is limited.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

LONGEST_SIDE = 12_000  # points; a plan of A0 at 250 dpi
MOST_POINTS = 50_000_000  # 200 MB in the memory of a browser, at four bytes each
_PNG = b"\x89PNG\r\n\x1a\n"
_BIT_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}  # by colour type
_SIZE_OF_IHDR = 13
# T.81, table B.1: frames (SOF) hold the size; the codes between them are tables (DHT, JPG, DAC).
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})  # TEM and RST: no length follows
_LAST = frozenset({0xD9, 0xDA})  # end of image and start of scan: a frame comes before


class PictureError(ValueError):
    """The bytes are no picture that the page shows. The message says why, and what can be shown."""


@dataclass(frozen=True, slots=True)
class ImageKind:
    """Type of the content, and size in points."""

    media_type: str
    width: int
    height: int


def picture_of(data: bytes) -> ImageKind:
    """What the header of a PNG or JPEG says. Raises PictureError for all else, and where it has too many points."""
    if data.startswith(_PNG):
        found = _png(data)
    elif data.startswith(b"\xff\xd8\xff"):
        found = _jpeg(data)
    else:
        raise PictureError("not a PNG or JPEG picture; save it as one of the two")
    if not (found.width and found.height):
        raise PictureError("the header of the picture states no size; save it again")
    if max(found.width, found.height) > LONGEST_SIDE or found.width * found.height > MOST_POINTS:
        raise PictureError(
            f"the picture has {found.width} x {found.height} points; at most {LONGEST_SIDE} on a side and "
            f"{MOST_POINTS // 10**6} million in all are shown; make it smaller"
        )
    return found


def _png(data: bytes) -> ImageKind:
    header = data[len(_PNG) : len(_PNG) + 8 + _SIZE_OF_IHDR + 4]
    content, crc = header[4:-4], header[-4:]
    if len(header) < 25 or header[:4] != _SIZE_OF_IHDR.to_bytes(4, "big") or content[:4] != b"IHDR":
        raise PictureError("a PNG without its header; save it again")
    depth, colour, compression, filtering, interlace = content[12:]
    known = depth in _BIT_DEPTHS.get(colour, ()) and (compression, filtering) == (0, 0) and interlace < 2
    if zlib.crc32(content) != int.from_bytes(crc, "big") or not known:
        raise PictureError("the header of the PNG is damaged; save it again")
    return ImageKind("image/png", int.from_bytes(content[4:8], "big"), int.from_bytes(content[8:12], "big"))


def _jpeg(data: bytes) -> ImageKind:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            break
        code = data[at + 1]
        if code == 0xFF or code in _ALONE:  # T.81 B.1.1.2: any number of 0xFF may come before a marker
            at += 1 if code == 0xFF else 2
            continue
        if code in _LAST:
            break
        if code in _FRAMES:
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            return ImageKind("image/jpeg", width, height)
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if length < 2:
            break
        at += 2 + length
    raise PictureError("a JPEG without a frame header; save it again")
